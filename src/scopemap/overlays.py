"""Text, logos and panels burned into the picture: what stays as it is, with sharp edges, while all else moves."""

from __future__ import annotations

import cv2
import numpy as np

# Red tissue is dark in green: there white and black writing both stand out.
_CHANNEL = 1
# Whether the camera has moved is seen in a small copy without its local mean, in so many parts of it, levels of 255.
_SMALL_SIDE_PX, _LOCAL_PX, _PARTS = 60, 9, (8, 6)
_TEXTURE, _MOVED, _LEAST_PARTS, _MOVED_SHARE = 1.0, 0.4, 12, 0.7
_LEAST_COUNT, _MEMORY, _LOOK_EVERY = 12, 40, 4
# What is an edge, levels of 255; which share of it may change, on average and in one image: coding changes it a little.
_EDGE, _STILL_SHARE, _NOW_SHARE = 40, 0.1, 0.25
_RIM_PX, _CLOSING_PX, _GROW_PX, _LEAST_PX, _LARGEST_SHARE = 2, 5, 2, 6, 0.25


class OverlayFinder:
    """Learns from one image after the other, all of one size, which edges the camera's motion does not move.

    It keeps a running mean of the image and of how far each pixel is from it. Images count once the texture has changed
    in most parts of the field since the last that counted: tissue that rests before a resting camera is no overlay.
    Nothing is found before 12 of them; what was seen more than 40 ago fades. Overlays that one can see through, or
    whose own content changes all the time, are not found.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last: np.ndarray = np.zeros((0, 0), np.float32)
        self._mean, self._change = self._last, self._last
        self._found: np.ndarray | None = None

    def __call__(self, rgb: np.ndarray, field: np.ndarray, beside: np.ndarray | None = None) -> np.ndarray | None:
        """Return where overlays are, (H, W) bool; None where there are none, or too little has moved so far.

        rgb : (H, W, 3) uint8. field : (H, W) bool, where tissue is seen, and overlays are looked for; its outermost
        pixels are left out, as its rim stays. beside : (H, W) bool, where overlays are looked for, too.
        """
        level = cv2.extractChannel(rgb, _CHANNEL)
        detail = _small_detail(level, field)
        if self._mean.shape != level.shape:
            self.count, self._found = 1, None
            self._last, self._mean, self._change = detail, level.astype(np.float32), np.zeros(level.shape, np.float32)
        elif _has_moved(self._last, detail):
            self._last = detail
            self._learn(level)
            if self.count >= _LEAST_COUNT and self.count % _LOOK_EVERY == 0:
                self._found = self._overlays(level, field if beside is None else field | beside)
        return self._found

    def _learn(self, level: np.ndarray) -> None:
        self.count += 1
        weight = 1 / min(self.count, _MEMORY)
        cv2.accumulateWeighted(cv2.absdiff(level.astype(np.float32), self._mean), self._change, weight)
        cv2.accumulateWeighted(level, self._mean, weight)

    def _overlays(self, level: np.ndarray, field: np.ndarray) -> np.ndarray | None:
        contrast = cv2.morphologyEx(self._mean, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
        still = (contrast >= _EDGE) & (self._change <= _STILL_SHARE * contrast)
        # What has just gone, a menu, must not be kept by the memory.
        still &= cv2.absdiff(level.astype(np.float32), self._mean) <= _NOW_SHARE * contrast
        rim = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)
        inside = cv2.erode(field.astype(np.uint8), rim, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        still &= inside > 0
        return _grown(still) if np.count_nonzero(still) >= _LEAST_PX else None


def _small_detail(level: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return a small copy less its local mean, float32, 0 outside the field: what stays of it when the light changes.

    The mean is taken inside the field alone: else its rim would be detail, and stay.
    """
    factor = max(1, min(level.shape) // _SMALL_SIDE_PX)
    height, width = (side // factor for side in level.shape)
    # A whole factor is several times as fast as any.
    whole = level[: height * factor, : width * factor]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    inside = field[factor // 2 :: factor, factor // 2 :: factor][:height, :width].astype(np.float32)
    weight = cv2.blur(inside, (_LOCAL_PX, _LOCAL_PX))
    mean = cv2.blur(small * inside, (_LOCAL_PX, _LOCAL_PX)) / np.maximum(weight, 1e-3)
    return np.asarray((small - mean) * inside)


def _has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether most parts that had texture show another one; an overlay fills few parts."""
    texture, change = _in_parts(before), _in_parts(now - before)
    textured = texture >= _TEXTURE
    parts = np.count_nonzero(textured)
    if parts < _LEAST_PARTS:
        # A black picture is not waited for to come back.
        return bool(np.count_nonzero(_in_parts(now) >= _TEXTURE) >= _LEAST_PARTS)
    return bool(np.count_nonzero(change[textured] >= _MOVED * texture[textured]) >= _MOVED_SHARE * parts)


def _in_parts(detail: np.ndarray) -> np.ndarray:
    return cv2.resize(np.abs(detail), _PARTS, interpolation=cv2.INTER_AREA)


def _grown(still: np.ndarray) -> np.ndarray | None:
    """Return edges (H, W) bool with the gaps between them, what they enclose, and a margin; specks are left out."""
    closed = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_CLOSING_PX, _CLOSING_PX), np.uint8))
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = np.zeros_like(closed)
    for contour in contours:
        x, y, width, height = cv2.boundingRect(contour)
        box = np.s_[y : y + height, x : x + width]
        if np.count_nonzero(still[box]) < _LEAST_PX:
            continue
        found[box] = np.maximum(found[box], closed[box])
        if cv2.contourArea(contour) <= _LARGEST_SHARE * still.size:
            cv2.drawContours(found, [contour], -1, 1, cv2.FILLED)
    grown = cv2.dilate(found, np.ones((2 * _GROW_PX + 1, 2 * _GROW_PX + 1), np.uint8)) > 0
    return grown if grown.any() else None
