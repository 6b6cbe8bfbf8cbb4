"""Tracks lost frames backwards, after the last frame: from where the camera was found again, or a map began."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.pipeline import Pipeline
from scopemap.engine.preprocessing import without_depth
from scopemap.engine.tracking.track import Track
from scopemap.result.frame_table import FrameTable

BACKWARDS = "tracked backwards"
"""Reason of the track of such a frame."""
_OVERLAP = 3  # successive frames of an earlier map that must be tracked, and give the same motion between the maps
_MAX_DIFFERENCE = (0.1, 0.2)  # between these motions: rad, share of the depth


def track_backwards(pipeline: Pipeline, frames: FrameTable) -> None:
    """Track lost frames backwards; the table of all frames as tracked, and the pipeline's mapper, take the changes.

    Nothing is done where frames are fused at once, where no back end adjusts poses or merges maps, or where poses are
    smoothed, or lost cameras not looked for.
    """
    config, rows = pipeline.config, frames.rows
    looked_for = config.tracking.relocalisation_keyframes > 0 and config.smoothing.method == "none"
    merges = pipeline.mapper.adjusts and config.mapping.min_loop_inliers > 0
    if not (looked_for and pipeline.fusion.at_end and merges):
        return
    for place in range(1, len(rows)):
        start = rows[place]
        if start["status"] == "lost" or rows[place - 1]["status"] != "lost":
            continue
        links = []
        for before, track in _tracked_from(pipeline, start, rows[:place][::-1]):
            if rows[before]["status"] != "lost":
                links.append((rows[before], rows[before]["T_world_camera"] @ inverse(track.T_world_camera)))
                continue
            links.clear()
            frames.put(before, track.row)
            pipeline.mapper.add_found(track)
        if len(links) == _OVERLAP and _agree([T for _, T in links], _depth_mm(pipeline, int(start["index"]))):
            last, T_earlier_own = links[0]
            pipeline.mapper.join(int(start["index"]), int(last["index"]), T_earlier_own)
            _join(frames, place, int(last["map"]), T_earlier_own)


def _join(frames: FrameTable, place: int, earlier_map: int, T_earlier_own: np.ndarray) -> None:
    """Put the frames of the map that begins at a place into the earlier map that it leads back to."""
    for one in np.flatnonzero(frames.tracked & (frames["map"] == frames["map"][place])):
        frames.put(int(one), {"map": earlier_map, "T_world_camera": T_earlier_own @ frames["T_world_camera"][one]})
    frames.put(place, {"status": "ok", "reason": "relocalised", "relocalised": True})


def _tracked_from(pipeline: Pipeline, start: np.void, earlier: np.ndarray) -> Iterator[tuple[int, Track]]:
    """Yield tracks in the world of `start` of earlier rows, last first, as far as they can be followed; and places."""
    tracker, store = pipeline.odometry.new_tracker(), pipeline.fusion.store
    if tracker is None:
        return
    # The tracker's world is the first frame's camera.
    first = replace(store.frame(int(start["index"])), T_world_camera=np.eye(4))
    if tracker.track(first).status == "lost" or not tracker.insert_keyframe(first, measured=False):
        return
    failed = overlap = 0
    for place, before in enumerate(earlier, 1):
        was_tracked = before["status"] != "lost"
        if overlap == _OVERLAP or (was_tracked and before["map"] == start["map"]):
            return
        # One that was skipped is lost again.
        index = int(before["index"])
        frame = store.frame(index) if index in store else replace(without_depth(first), index=index)
        track = tracker.track(replace(frame, T_world_camera=None))
        failed = failed + 1 if track.status == "lost" else 0
        # A new map would have nothing to do with the first frame.
        if track.map or failed > pipeline.config.tracking.new_map_after or (failed and was_tracked):
            return
        if failed:
            continue
        tracked = replace(frame, T_world_camera=track.T_world_camera)
        if not (tracker.needs_keyframe() and tracker.insert_keyframe(tracked, measured=False)):
            tracker.remember(tracked)
        overlap += was_tracked
        found = replace(
            track,
            reason=BACKWARDS,
            T_world_camera=start["T_world_camera"] @ track.T_world_camera,
            keyframe=int(start["index"]),
            map=int(start["map"]),
            motion=float(before["motion"]),
            quality=float(before["quality"]),
        )
        yield len(earlier) - place, found


def _agree(motions: list[np.ndarray], depth_mm: float) -> bool:
    """Whether motions (4, 4) between two worlds are alike."""
    off = [inverse(motions[0]) @ T for T in motions[1:]]
    turn = max(float(rotation_angle_rad(T[:3, :3])) for T in off)
    shift = max(float(np.linalg.norm(T[:3, 3])) for T in off) / depth_mm
    return turn < _MAX_DIFFERENCE[0] and shift < _MAX_DIFFERENCE[1]


def _depth_mm(pipeline: Pipeline, index: int) -> float:
    return pipeline.fusion.store.median_depth_mm({index}) or float("inf")
