"""Tracks lost frames backwards, after the last frame: from where the camera was found again, or a map began."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.mapping.mapper import Mapper
from scopemap.engine.preprocessing import without_depth
from scopemap.engine.tracking.track import FrameTracker, Track, TrackedFrames

BACKWARDS = "tracked backwards"
"""Reason of the track of such a frame."""
_OVERLAP = 3  # successive frames of an earlier map that must be tracked, and give the same motion between the maps
_MAX_DIFFERENCE = (0.1, 0.2)  # between these motions: rad, share of the depth


class MapMerge(NamedTuple):
    """That a map leads back to an earlier one, whose frames it is tracked in.

    map, earlier_map : their numbers. start, last : numbers of the frame that the map was found from, and of one of the
    earlier map. T_earlier_own : (4, 4), from the world of the map to that of the earlier one.
    """

    map: int
    earlier_map: int
    start: int
    last: int
    T_earlier_own: np.ndarray


class BackwardTracker:
    """Tracks the lost frames of a run backwards.

    frames : all of the run, as tracked. store : has those that were not skipped. new_tracker : returns a tracker that
    has seen no frame. most_lost : frames in a row that may be lost.
    """

    def __init__(
        self, frames: TrackedFrames, store: FrameStore, new_tracker: Callable[[], FrameTracker], most_lost: int
    ) -> None:
        self._frames, self._store, self._new_tracker, self._most_lost = frames, store, new_tracker, most_lost
        # What is found changes these.
        self._lost, self._map, self._poses = frames.lost.copy(), frames.map.copy(), frames.T_world_camera.copy()

    def found(self, mapper: Mapper) -> list[Track | MapMerge]:
        """Return the tracks of frames that were lost, and the maps that lead back to earlier ones; a mapper takes both.

        They are in the order in which they are found: a map that is merged is part of the earlier one in all that
        follows.
        """
        all_found = []
        for start in range(1, len(self._lost)):
            if self._lost[start - 1] and not self._lost[start]:
                for found in self._found_from(start):
                    all_found.append(found)
                    if isinstance(found, Track):
                        mapper.add_found(found)
                    else:
                        mapper.join(found.start, found.last, found.T_earlier_own)
        return all_found

    def _found_from(self, start: int) -> Iterator[Track | MapMerge]:
        """Yield what is found from the frame in the row `start`, before which frames are lost."""
        overlap: list[tuple[int, np.ndarray]] = []
        for row, track in self._tracked_from(start):
            if not self._lost[row]:
                overlap.append((row, self._poses[row] @ inverse(track.T_world_camera)))
                continue
            overlap.clear()
            self._lost[row], self._map[row], self._poses[row] = False, track.map, track.T_world_camera
            yield track
        number = int(self._frames.index[start])
        depth_mm = self._store.median_depth_mm({number}) or float("inf")
        if len(overlap) == _OVERLAP and _agree([T for _, T in overlap], depth_mm):
            last, T_earlier_own = overlap[0]
            merge = MapMerge(
                int(self._map[start]), int(self._map[last]), number, int(self._frames.index[last]), T_earlier_own
            )
            for own in np.flatnonzero(~self._lost & (self._map == merge.map)):
                self._map[own], self._poses[own] = merge.earlier_map, T_earlier_own @ self._poses[own]
            yield merge

    def _tracked_from(self, start: int) -> Iterator[tuple[int, Track]]:
        """Yield rows before `start`, last first, as far as they can be followed, and tracks in its map's world.

        The last rows may be of an earlier map, in which the frames were tracked already.
        """
        tracker = self._new_tracker()
        # The tracker's world is the first frame's camera.
        first = replace(self._store.frame(int(self._frames.index[start])), T_world_camera=np.eye(4))
        initial = tracker.track(first)
        if initial.status == "lost" or not tracker.update(first, initial.decision, measured=False):
            return
        failed = overlap = 0
        for row in range(start - 1, -1, -1):
            was_tracked = not self._lost[row]
            if overlap == _OVERLAP or (was_tracked and self._map[row] == self._map[start]):
                return
            # One that was skipped is lost again.
            index = int(self._frames.index[row])
            frame = self._store.frame(index) if index in self._store else replace(without_depth(first), index=index)
            track = tracker.track(replace(frame, T_world_camera=None))
            failed = failed + 1 if track.status == "lost" else 0
            # A new map would have nothing to do with the first frame.
            if track.map or failed > self._most_lost or (failed and was_tracked):
                return
            if failed:
                continue
            tracker.update(replace(frame, T_world_camera=track.T_world_camera), track.decision, measured=False)
            overlap += was_tracked
            yield row, self._in_map_of(start, row, track)

    def _in_map_of(self, start: int, row: int, track: Track) -> Track:
        """Return a track relative to the frame in the row `start` as that of the frame in a row, in the same map."""
        return replace(
            track,
            reason=BACKWARDS,
            T_world_camera=self._poses[start] @ track.T_world_camera,
            keyframe=int(self._frames.index[start]),
            map=int(self._map[start]),
            motion=float(self._frames.motion[row]),
            quality=float(self._frames.quality[row]),
        )


def _agree(motions: list[np.ndarray], depth_mm: float) -> bool:
    """Whether motions (4, 4) between two worlds are alike."""
    off = [inverse(motions[0]) @ T for T in motions[1:]]
    turn = max(float(rotation_angle_rad(T[:3, :3])) for T in off)
    shift = max(float(np.linalg.norm(T[:3, 3])) for T in off) / depth_mm
    return turn < _MAX_DIFFERENCE[0] and shift < _MAX_DIFFERENCE[1]
