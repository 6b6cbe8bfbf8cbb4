"""Loops: keyframes that show what one long before has shown, told by their landmarks and held to geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.config import BackendSettings
from scopemap.frame import Frame
from scopemap.geometry.landmarks import Landmarks, find_landmarks, locate

_STRONGEST = 64  # landmarks by which candidates are chosen
_ALIKE = 0.8  # cosine of descriptors from which on they speak for a candidate
_CANDIDATES = 3


@dataclass(frozen=True)
class Loop:
    """Two keyframes that show the same place.

    Attributes
    ----------
    past, new : their numbers. T_new_past : (4, 4), mm of the past one's depth. log_ratio : ln of the new one's depth
    over what the past one's depth and this motion make of it. pixels_past, pixels_new : (M, 2) of the landmarks that
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
    """Takes keyframes one by one and tells which of those long before show the same place.

    Candidates are those whose strongest landmarks look most like the new one's; only what PnP can place from at least
    `settings.loop_landmarks` of them is a loop.
    """

    def __init__(self, settings: BackendSettings) -> None:
        self.settings = settings
        self._known: list[Landmarks] = []

    def add(self, keyframe: Frame) -> list[Loop]:
        """Return the loops that a keyframe with depth closes."""
        new = find_landmarks(keyframe)
        loops = []
        for past in self._candidates(new):
            known = self._known[past]
            located = locate(known, new, keyframe.camera, self.settings.loop_landmarks)
            if located is None:
                continue
            one, other = located.pairs.T
            moved = known.points_mm[one] @ located.T_current_reference[2, :3] + located.T_current_reference[2, 3]
            with np.errstate(invalid="ignore", divide="ignore"):
                z_past, z_new = np.log(known.points_mm[one, 2]), np.log(new.points_mm[other, 2])
                ratio = z_new - np.log(moved)
            if np.isfinite(ratio).sum() < self.settings.loop_landmarks // 2:
                continue
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
        self._known.append(new)
        return loops

    def _candidates(self, new: Landmarks) -> list[int]:
        """Numbers of the keyframes, all before those that flow links to anyhow, that look most alike."""
        long_before, strongest = len(self._known) - max(self.settings.gaps), new.descriptors[:_STRONGEST]
        votes = []
        for known in self._known[: max(long_before, 0)]:
            alike = strongest @ known.descriptors[:_STRONGEST].T
            votes.append(float(np.maximum(alike.max(1) - _ALIKE, 0).sum()) if alike.size else 0.0)
        return [int(k) for k in np.argsort(-np.array(votes), kind="stable")[:_CANDIDATES] if votes[k] > 0]
