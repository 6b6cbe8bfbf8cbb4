"""Loops: keyframes that show what one long before has shown, told by their features and held to geometry."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from scopemap.config import MappingSettings
from scopemap.frame import Frame
from scopemap.tracking.features import Features, detect_features, relative_pose_pnp

_STRONGEST = 64  # features by which candidates are chosen
_ALIKE = 0.8  # cosine of descriptors from which on they speak for a candidate
_CANDIDATES = 3
_STICKS_PX = 2.0
# A camera that dwells would tie everything to the same few keyframes, and adjusting these together takes their square.
_REST, _MOST_LOOPS, _MOST_PAIRS = 5, 20, 60  # keyframes between loops to one keyframe, loops to it, points of a loop


@dataclass(frozen=True)
class Loop:
    """Two keyframes, long after each other or of two maps, that show the same place.

    Attributes
    ----------
    past, new : their numbers. T_new_past : (4, 4), mm of the past one's depth. log_ratio : ln of the new one's depth
    over what the past one's depth and this motion make of it. pixels_past, pixels_new : (M, 2) of the features that
    agree. log_depth_past, log_depth_new : (M,) ln of their depth, NaN = unknown.
    """

    past: int
    new: int
    T_new_past: np.ndarray
    log_ratio: float
    pixels_past: np.ndarray
    pixels_new: np.ndarray
    log_depth_past: np.ndarray
    log_depth_new: np.ndarray


class LoopFinder:
    """Takes keyframes one by one and tells which of those long before, and of other maps, show the same place.

    Candidates are those whose strongest features look most like the new one's; only what PnP can place from at least
    `settings.min_loop_inliers` of them is a loop.
    """

    def __init__(self, settings: MappingSettings) -> None:
        self.settings = settings
        self._known: list[Features] = []
        self._map_of: list[int] = []
        self._closed: defaultdict[int, list[int]] = defaultdict(list)

    def add(self, keyframe: Frame, map_number: int = 0) -> list[Loop]:
        """Return the loops that a keyframe with depth closes, those into other maps among them."""
        new = detect_features(keyframe)
        loops = []
        for past in self._candidates(new, map_number):
            known = self._known[past]
            located = relative_pose_pnp(known, new, keyframe.camera, self.settings.min_loop_inliers)
            if located is None or (self._map_of[past] != map_number and self._sticks(known, new, located.pairs)):
                continue
            one, other = located.pairs[:: -(-len(located.pairs) // _MOST_PAIRS)].T
            moved = known.points_mm[one] @ located.T_current_reference[2, :3] + located.T_current_reference[2, 3]
            with np.errstate(invalid="ignore", divide="ignore"):
                z_past, z_new = np.log(known.points_mm[one, 2]), np.log(new.points_mm[other, 2])
                ratio = z_new - np.log(moved)
            if np.isfinite(ratio).sum() < min(self.settings.min_loop_inliers, _MOST_PAIRS) // 2:
                continue
            self._closed[past].append(len(self._known))
            loops.append(
                Loop(
                    past,
                    len(self._known),
                    located.T_current_reference,
                    float(np.nanmedian(ratio)),
                    known.pixels[one],
                    new.pixels[other],
                    z_past,
                    z_new,
                )
            )
        # Half of the precision tells descriptors apart as well, in half of the memory.
        self._known.append(replace(new, descriptors=new.descriptors.astype(np.float16)))
        self._map_of.append(map_number)
        return loops

    def _candidates(self, new: Features, map_number: int) -> list[int]:
        """Numbers of the keyframes that look most alike, of this map and of others.

        Those that flow links to anyhow, the last ones of this map, are left out.
        """
        map_of, strongest = np.array(self._map_of, dtype=int), new.descriptors[:_STRONGEST]
        own, elsewhere = np.flatnonzero(map_of == map_number), np.flatnonzero(map_of != map_number)
        likely: list[int] = []
        for some in (own[: max(len(own) - max(self.settings.gaps), 0)], elsewhere):
            votes = np.array([self._votes(strongest, self._known[k]) for k in some])
            ranked = [int(some[k]) for k in np.argsort(-votes, kind="stable") if votes[k] > 0]
            likely += [k for k in ranked if self._may_close(k)][:_CANDIDATES]
        return likely

    def _sticks(self, past: Features, new: Features, pairs: np.ndarray) -> bool:
        """Whether too few features are elsewhere in the picture: dirt on the lens looks alike in unrelated places."""
        way_px = np.linalg.norm(new.pixels[pairs[:, 1]] - past.pixels[pairs[:, 0]], axis=1)
        return int((way_px > _STICKS_PX).sum()) < self.settings.min_loop_inliers

    @staticmethod
    def _votes(strongest: np.ndarray, known: Features) -> float:
        """How much a keyframe looks like one with these descriptors."""
        alike = strongest @ known.descriptors[:_STRONGEST].T.astype(np.float32)
        return float(np.maximum(alike.max(1) - _ALIKE, 0).sum()) if alike.size else 0.0

    def _may_close(self, past: int) -> bool:
        closed = self._closed[past]
        return len(closed) < _MOST_LOOPS and (not closed or len(self._known) - closed[-1] >= _REST)
