"""Text, logos and icons burned into the picture, and pictures in the picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from scopemap.apps.inspect.clip import VideoFinding, segments_of
from scopemap.apps.inspect.field_shape import ShareBox, shares_of
from scopemap.apps.inspect.frame_measures import InspectedFrame
from scopemap.engine.masking.masker import hull_of_largest
from scopemap.engine.masking.overlays import OverlayFinder

_MARGIN_SHARE = 0.02
_NEAR_PX = 3
_BLACK_PX = 9
_JOIN_SHARE = 0.02
_LEAST_BOX_PX = 3
_LEAST_TIMES = 12
_LEAST_TIMES_SHARE = 0.05
# A static edge is this much stronger, on average, than the image beside it.
_RIDGE = 1.6
_RIDGE_LEVELS = 4.0
_BESIDE_PX = 9
_LEAST_SIDE = 0.08
_LARGEST_SHARE = 0.45
_COVERED = 0.85
_LEAST_CHANGE = 2.0
_LEAST_PICTURES = 12
_MOST_LINES = 12
_MOVED_SHARE = 0.004


@dataclass(frozen=True)
class Overlay:
    """One overlay, and whether it is in the field of view."""

    box: ShareBox
    in_field: bool


class OverlayWatcher:
    """Finds overlays with the finder of the runs, in the field of view and outside, but not at its rim."""

    def __init__(self) -> None:
        self._finder = OverlayFinder()
        # Grows to (h, w) with the first frame; all frames of a video have one size.
        self._times = np.zeros((1, 1), np.int32)
        self._looked = 0
        self._field = np.zeros((0, 0), bool)

    def add(self, item: InspectedFrame) -> None:
        """Add the next frame."""
        # Large black areas and what is near them: an inset and a circle make one hull.
        black = cv2.morphologyEx((~item.lit).astype(np.uint8), cv2.MORPH_OPEN, _square(_BLACK_PX))
        beside_black = cv2.dilate(black, _square(2 * _BLACK_PX + 1)) > 0
        # A field that moves has its rim inside of all that was ever lit.
        rim = _rim(item.field) | _rim(hull_of_largest(item.lit)) | (beside_black & item.field)
        found = self._finder(item.small, item.field, ~rim & ~item.field)
        self._times = self._times + (np.zeros_like(rim) if found is None else found & ~rim)
        self._field, self._looked = item.field, self._looked + 1

    def overlays(self) -> list[Overlay]:
        """Return the overlays that were there for at least 12 frames and 5 % of them."""
        there = (self._times >= max(_LEAST_TIMES, _LEAST_TIMES_SHARE * self._looked)).astype(np.uint8)
        # Letters of a word, and words of a line, belong together.
        side = 2 * round(_JOIN_SHARE * self._times.shape[1]) + 1
        joined = cv2.morphologyEx(there, cv2.MORPH_CLOSE, np.ones((3, side), np.uint8))
        _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
        found = [
            Overlay(shares_of((x, y, w, h), self._times.shape), bool(self._field[labels == label].mean() > 0.5))
            for label, (x, y, w, h, _) in enumerate(stats[1:].tolist(), start=1)
            if min(w, h) >= _LEAST_BOX_PX
        ]
        return sorted(found, key=lambda one: one.box)

    def findings(self) -> Iterator[VideoFinding]:
        """Yield the overlays in the field of view, and the warning about patients' names in all of them."""
        overlays = self.overlays()
        inside = [one for one in overlays if one.in_field]
        if inside:
            kinds = "text, logos or an instrument that rests"
            message = f"{len(inside)} overlay(s) in the field of view ({kinds}): {_places(inside)}"
            advice = "runs leave them out; where they miss some, give masks: --set mask.files=FOLDER"
            yield VideoFinding("warning", "overlay", message, advice)
        if overlays:
            message = f"burned-in text may name a patient: {_places(overlays)}"
            advice = "look before you pass the video or pictures of it on; --redact X,Y,WIDTH,HEIGHT blackens a box, px"
            yield VideoFinding("info", "overlay-privacy", message, advice)


def _square(side_px: int) -> np.ndarray:
    return np.ones((side_px, side_px), np.uint8)


def _rim(field: np.ndarray) -> np.ndarray:
    """Return where the rim of a field is, which stays as overlays do: (H, W) bool, most of it outside."""
    margin = round(_MARGIN_SHARE * max(field.shape))
    level = np.pad(field.astype(np.uint8), margin, mode="edge")
    out, near = cv2.dilate(level, _square(2 * margin + 1)), cv2.erode(level, _square(2 * _NEAR_PX + 1))
    return ((out > 0) & (near == 0))[margin:-margin, margin:-margin]


def _places(overlays: list[Overlay]) -> str:
    middles = ((np.mean(one.box[::2]), np.mean(one.box[1::2])) for one in overlays[:4])
    named = ", ".join(f"at {x:.0%} of the width and {y:.0%} of the height" for x, y in middles)
    return named + (", ..." if len(overlays) > 4 else "")


class InsetWatcher:
    """Accumulates the edges of all frames in which something moves."""

    def __init__(self) -> None:
        self._count = 0
        self._last: np.ndarray | None = None
        self._across = self._down = self._change = np.zeros((1, 1), np.float32)
        self._field: np.ndarray = np.zeros((0, 0), bool)

    def add(self, item: InspectedFrame) -> None:
        """Add the next frame."""
        grey = cv2.cvtColor(item.small, cv2.COLOR_RGB2GRAY).astype(np.float32)
        if self._last is None:
            self._last = grey
        if item.measures.blank or item.measures.motion < _MOVED_SHARE:
            return
        self._count += 1
        self._across = self._across + np.abs(np.diff(grey, axis=1, prepend=grey[:, :1]))
        self._down = self._down + np.abs(np.diff(grey, axis=0, prepend=grey[:1]))
        self._change = self._change + cv2.absdiff(grey, self._last)
        self._last, self._field = grey, item.field

    def boxes(self) -> list[ShareBox]:
        """Return the insets."""
        if self._count < _LEAST_PICTURES:
            return []
        height, width = self._across.shape
        upright = _lines(self._across / self._count, round(_LEAST_SIDE * height))
        level = _lines((self._down / self._count).T, round(_LEAST_SIDE * width)).T
        columns, rows = {0, width, *_strongest(upright.sum(0))}, {0, height, *_strongest(level.sum(1))}
        across, down = list(combinations(sorted(columns), 2)), list(combinations(sorted(rows), 2))
        boxes = [(left, top, right, bottom) for left, right in across for top, bottom in down]
        found = [(a, b, c - a, d - b) for a, b, c, d in boxes if self._is_inset((a, b, c, d), upright, level)]
        # The largest first, and none that overlaps one before it.
        kept = cv2.dnn.NMSBoxes(found, [float(w * h) for _, _, w, h in found], 0.0, 0.0)
        return [shares_of(found[number], upright.shape) for number in kept]

    def findings(self) -> Iterator[VideoFinding]:
        """Yield a finding where there is an inset."""
        places = [f"{a:.0%}-{c:.0%} of the width, {b:.0%}-{d:.0%} of the height" for a, b, c, d in self.boxes()]
        if places:
            message = f"picture in picture: {', '.join(places)} shows something else"
            advice = (
                "leave it out: --masks FOLDER of this command writes a mask, --set mask.files=FOLDER of a run reads it"
            )
            yield VideoFinding("warning", "inset", message, advice)

    def _is_inset(self, box: tuple[int, int, int, int], upright: np.ndarray, level: np.ndarray) -> bool:
        """Return whether static edges are around a box (left, top, right, bottom) in which the picture changes."""
        left, top, right, bottom = box
        height, width = upright.shape
        if (right - left) < _LEAST_SIDE * width or (bottom - top) < _LEAST_SIDE * height:
            return False
        if (right - left) * (bottom - top) > _LARGEST_SHARE * width * height:
            return False
        sides = [upright[top:bottom, x].mean() for x in (left, right) if 0 < x < width]
        sides += [level[y, left:right].mean() for y in (top, bottom) if 0 < y < height]
        if len(sides) < 2 or min(sides) < _COVERED:
            return False
        inner = np.s_[top + 2 : bottom - 2, left + 2 : right - 2]
        changes = self._change[inner].mean() / self._count >= _LEAST_CHANGE
        # Black bars at the picture's edge have straight sides, too, but show nothing.
        return bool(changes and self._field[inner].mean() > 0.5)


def _lines(strength: np.ndarray, least_px: int) -> np.ndarray:
    """Return static upright edges, (H, W) bool, each at least `least_px` long and widened by a pixel."""
    beside = cv2.blur(strength, (_BESIDE_PX, 1))
    ridge = (strength > _RIDGE * (beside * _BESIDE_PX - strength) / (_BESIDE_PX - 1)) & (strength > _RIDGE_LEVELS)
    closed = cv2.morphologyEx(ridge.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 1), np.uint8))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((max(3, least_px), 1), np.uint8))
    return cv2.dilate(opened, np.ones((1, 3), np.uint8)) > 0


def _strongest(lengths: np.ndarray) -> list[int]:
    """Return the middles of the longest groups of lines."""
    groups = [(int(lengths[a : b + 1].max()), round((a + b) / 2)) for a, b in segments_of(lengths > 0)]
    return [middle for _, middle in sorted(groups, reverse=True)[:_MOST_LINES]]
