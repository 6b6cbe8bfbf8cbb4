"""Text, logos and icons burned into the picture, inside the field of view or beside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.inspection.clip import VideoFinding
from scopemap.inspection.frame_measures import InspectedFrame
from scopemap.masking.masker import hull_of_largest
from scopemap.masking.overlays import OverlayFinder

_MARGIN_SHARE, _NEAR_PX, _BLACK_PX = 0.02, 3, 9
_JOIN_SHARE = 0.02
_LEAST_TIMES, _LEAST_TIMES_SHARE = 12, 0.05
_LEAST_BOX_PX = 3


@dataclass(frozen=True)
class Overlay:
    """One overlay: left, top, right, bottom as shares of width and height; whether it is in the field of view."""

    box: tuple[float, float, float, float]
    in_field: bool


class OverlayWatcher:
    """Finds overlays with the finder of the runs, in the field of view and outside, but not at its rim."""

    def __init__(self) -> None:
        self._finder = OverlayFinder()
        self._times = np.zeros((0, 0), np.int32)
        self._looked = 0
        self._field = np.zeros((0, 0), bool)

    def add(self, item: InspectedFrame) -> None:
        """Add the next frame."""
        # A field that moves has its rim inside of all that was ever lit.
        rim = _rim(item.field) | _rim(hull_of_largest(item.lit)) | (_beside_black(item.lit) & item.field)
        found = self._finder(item.small, item.field, ~rim & ~item.field)
        if self._times.shape != rim.shape:
            self._times, self._looked = np.zeros(rim.shape, np.int32), 0
        self._field = item.field
        self._looked += 1
        if found is not None:
            self._times += found & ~rim

    def overlays(self) -> list[Overlay]:
        """Return the overlays that were there for at least 12 frames and 5 % of them."""
        if not self._times.size:
            return []
        height, width = self._times.shape
        there = (self._times >= max(_LEAST_TIMES, _LEAST_TIMES_SHARE * self._looked)).astype(np.uint8)
        # Letters of a word, and words of a line, belong together.
        side = 2 * round(_JOIN_SHARE * width) + 1
        joined = cv2.morphologyEx(there, cv2.MORPH_CLOSE, np.ones((3, side), np.uint8))
        _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
        found = []
        for label, (x, y, w, h, _) in enumerate(stats[1:].tolist(), start=1):
            if min(w, h) >= _LEAST_BOX_PX:
                box = x / width, y / height, (x + w) / width, (y + h) / height
                found.append(Overlay(box, bool(self._field[labels == label].mean() > 0.5)))
        return sorted(found, key=lambda one: one.box)

    def findings(self) -> list[VideoFinding]:
        """Return the overlays in and beside the field of view, and the warning about patients' names."""
        overlays, found = self.overlays(), []
        inside, outside = ([one for one in overlays if one.in_field is where] for where in (True, False))
        if inside:
            message = f"{len(inside)} overlay(s) in the field of view (text, logos): {_places(inside)}"
            advice = "runs leave them out; where they miss some, give masks: --set mask.files=FOLDER"
            found.append(VideoFinding("warning", "overlay", message, advice))
        if outside:
            message = f"{len(outside)} overlay(s) beside the field of view (text, logos): {_places(outside)}"
            found.append(VideoFinding("info", "overlay-outside", message))
        if overlays:
            message = "burned-in text may name a patient: look before you pass the video or pictures of it on"
            found.append(VideoFinding("info", "overlay-privacy", message))
        return found


def _rim(field: np.ndarray) -> np.ndarray:
    """Return where the rim of a field is, which stays as overlays do: (H, W) bool, most of it outside."""
    margin = round(_MARGIN_SHARE * max(field.shape))
    level = np.pad(field.astype(np.uint8), margin, mode="edge")
    out = cv2.dilate(level, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    near = cv2.erode(level, np.ones((2 * _NEAR_PX + 1, 2 * _NEAR_PX + 1), np.uint8))
    return ((out > 0) & (near == 0))[margin:-margin, margin:-margin]


def _beside_black(lit: np.ndarray) -> np.ndarray:
    """Return where large black areas are, and near them, (H, W) bool: an inset and a circle make one hull."""
    large = cv2.morphologyEx((~lit).astype(np.uint8), cv2.MORPH_OPEN, np.ones((_BLACK_PX, _BLACK_PX), np.uint8))
    return cv2.dilate(large, np.ones((2 * _BLACK_PX + 1, 2 * _BLACK_PX + 1), np.uint8)) > 0


def _places(overlays: list[Overlay]) -> str:
    middles = ((np.mean(one.box[::2]), np.mean(one.box[1::2])) for one in overlays[:4])
    named = ", ".join(f"at {x:.0%} of the width and {y:.0%} of the height" for x, y in middles)
    return named + (", ..." if len(overlays) > 4 else "")
