"""Tracks lost frames backwards, after the last frame: from where the camera was found again, or a map began.

A camera that was lost in a turn or at a wall is often found only when the view is wide again; the frames before that
show what the found one shows, and are tracked from there, in its world. They move with it when keyframes are adjusted.
Where they lead back into an earlier map, the camera has been found in that map, and the two become one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.pipeline import Pipeline
from scopemap.tracking.track import Track

BACKWARDS = "tracked backwards"
"""Reason of the track of such a frame."""
_OVERLAP = 3  # successive frames of an earlier map that must be tracked, and give the same motion between the maps
_MAX_DIFFERENCE = (0.1, 0.2)  # between these motions: rad, share of the depth


def track_backwards(pipeline: Pipeline, tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks of all frames after going back; the pipeline's store and mapper take the changes, too.

    tracks : as tracked, in order. Nothing is done where frames are fused at once, where no back end adjusts poses, or
    where these are smoothed, or lost cameras not looked for.
    """
    config, now, order = pipeline.config, {track.index: track for track in tracks}, [track.index for track in tracks]
    looked_for = config.tracking.relocalisation_keyframes > 0 and config.smoothing.method == "none"
    if not (looked_for and pipeline.fusion.at_end and pipeline.mapper.adjusts):
        return list(tracks)
    for place in range(1, len(order)):
        start = now[order[place]]
        if start.status == "lost" or now[order[place - 1]].status != "lost":
            continue
        links = []
        for before, track in _tracked_from(pipeline, start, [now[index] for index in reversed(order[:place])]):
            if before.status != "lost":
                links.append((before, before.T_world_camera @ inverse(track.T_world_camera)))
                continue
            links.clear()
            now[track.index] = track
            pipeline.mapper.add_found(track)
        if len(links) == _OVERLAP and _agree([T for _, T in links], _depth_mm(pipeline, start.index)):
            last, T_earlier_own = links[0]
            pipeline.mapper.join(start, last, T_earlier_own)
            now |= {index: _moved(track, start, last, T_earlier_own) for index, track in now.items()}
    changed = [after for before, after in zip(tracks, now.values(), strict=True) if after is not before]
    pipeline.fusion.store.locate({track.index: track.T_world_camera for track in changed})
    return list(now.values())


def _tracked_from(pipeline: Pipeline, start: Track, earlier: list[Track]) -> Iterator[tuple[Track, Track]]:
    """Yield earlier tracks, last first, with the tracks in the world of `start`, as far as frames can be followed.

    It ends with some frames of an earlier map, or where frames of the same one come.
    """
    tracker, store = pipeline.odometry.new_tracker(), pipeline.fusion.store
    if tracker is None:
        return
    # The tracker's world is the first frame's camera.
    first = replace(store.frame(start.index), T_world_camera=np.eye(4))
    if tracker.track(first).status == "lost" or not tracker.insert_keyframe(first, measured=False):
        return
    failed = overlap = 0
    for before in earlier:
        if overlap == _OVERLAP or (before.status != "lost" and before.map == start.map):
            return
        frame = replace(store.frame(before.index), T_world_camera=None)
        track = tracker.track(frame)
        failed = failed + 1 if track.status == "lost" else 0
        # A new map would have nothing to do with the first frame.
        if track.map or failed > pipeline.config.tracking.new_map_after or (failed and before.status != "lost"):
            return
        if failed:
            continue
        tracked = replace(frame, T_world_camera=track.T_world_camera)
        if not (tracker.needs_keyframe() and tracker.insert_keyframe(tracked, measured=False)):
            tracker.remember(tracked)
        overlap += before.status != "lost"
        track = replace(track, T_world_camera=start.T_world_camera @ track.T_world_camera, motion=before.motion)
        found = replace(track, reason=BACKWARDS, keyframe=start.index, map=start.map, quality=before.quality)
        yield before, found


def _agree(motions: list[np.ndarray], depth_mm: float) -> bool:
    """Whether motions (4, 4) between two worlds are alike."""
    off = [inverse(motions[0]) @ T for T in motions[1:]]
    turn = max(float(rotation_angle_rad(T[:3, :3])) for T in off)
    shift = max(float(np.linalg.norm(T[:3, 3])) for T in off) / depth_mm
    return turn < _MAX_DIFFERENCE[0] and shift < _MAX_DIFFERENCE[1]


def _depth_mm(pipeline: Pipeline, index: int) -> float:
    return pipeline.fusion.store.median_depth_mm({index}) or float("inf")


def _moved(track: Track, start: Track, last: Track, T_earlier_own: np.ndarray) -> Track:
    """Return a track in the world of the earlier map where it is in the map that joins it."""
    if track.map != start.map or track.status == "lost":
        return track
    moved = replace(track, map=last.map, T_world_camera=T_earlier_own @ track.T_world_camera)
    return replace(moved, status="ok", reason="relocalised", relocalised=True) if track.index == start.index else moved
