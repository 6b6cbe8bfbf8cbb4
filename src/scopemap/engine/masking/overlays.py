"""Overlays burned into the picture (text, logos, panels): sharp edges that stay in place while the scene moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np

# The green channel: red tissue is dark there, so both white and black text have contrast.
_CHANNEL = 1
# Camera motion is detected in a small copy without its local mean, divided into parts; grey levels of 255.
_SMALL_SIDE_PX = 60  # by hand
_LOCAL_PX = 9  # by hand: of the local mean
_PARTS = (8, 6)  # by hand: columns and rows of parts
_TEXTURE = 1.0  # by hand: grey levels by which a part with texture varies
_ALIKE = 0.94  # by hand: correlation below which a part has moved
_MIN_PARTS = 12  # by hand: with texture
_MOVED_SHARE = 0.7  # by hand: of these that must have moved
_MIN_COUNT = 12  # by hand: moving frames before overlays are sought
_MEMORY = 40  # by hand: moving frames over which changes are averaged
_LOOK_EVERY = 4  # by hand: moving frames between two searches
# Edge threshold, grey levels; share of an edge that may change on average and in one image (video coding changes it).
_EDGE = 40  # by hand
_STILL_SHARE = 0.1  # by hand
_NOW_SHARE = 0.25  # by hand
_RIM_PX = 2  # by hand: the rim of the field of view is static, too
_CLOSING_PX = 5  # by hand: gaps in the edges of letters that are closed
_GROW_PX = 2  # by hand: an overlay is widened by it
_MIN_PX = 6  # by hand: of an overlay's edges
_MAX_SHARE = 0.25  # by hand: of the picture, that an overlay fills
# The surroundings of a static edge must change (grey levels after noise removal) or be uniform, nearly all of them.
_CALM_PX = 5  # by hand
_NEAR_PX = 4  # by hand: what is so near to an edge belongs to it
_FAR_PX = 8  # by hand: what is so near surrounds it
_CHANGED = 1.5  # by hand
_PLAIN = 2.0  # by hand
_AROUND_SHARE = 0.7  # by hand: nearly all
# An overlay has disappeared where this share of its edge pixels differs (half of them belong to the surroundings).
_GONE_SHARE = 0.25  # by hand


@dataclass(frozen=True)
class _Found:
    """Overlays of the last detection.

    mask : (H, W) bool. labels : (H, W) int32, its components, from 1. edges : (N,) flat indices of static edge pixels.
    level, limit : (N,) float32, their mean level and the tolerated deviation. of : (N,) component.
    """

    mask: np.ndarray
    labels: np.ndarray
    edges: np.ndarray
    level: np.ndarray
    limit: np.ndarray
    of: np.ndarray

    def shown(self, level: np.ndarray) -> np.ndarray | None:
        """Return the overlays present in this image, (H, W) bool: a menu may disappear while the camera is at rest."""
        differs = np.abs(level.ravel()[self.edges] - self.level) > self.limit
        if not differs.any():
            return self.mask
        shown = self.mask & (np.bincount(self.of, differs) <= _GONE_SHARE * np.bincount(self.of))[self.labels]
        return shown if shown.any() else None


class OverlayFinder:
    """Detects static edges in a sequence of images of one size while the camera moves.

    It keeps a running mean of the image and of the deviation from it, over 40 images; nothing is found before 12. An
    image is used once the texture has changed in most parts of the field since the last one used. A static edge is an
    overlay only where its surroundings are not static, so tissue at rest is not masked. Transparent overlays, and
    overlays whose content changes all the time, are not found.
    """

    def __init__(self) -> None:
        self.count, self._found = 0, cast(_Found | None, None)
        self._last = np.zeros((0, 0), np.float32)
        self._mean, self._change, self._calm_change = self._last, self._last, self._last

    def __call__(self, rgb: np.ndarray, field: np.ndarray, outside: np.ndarray | None = None) -> np.ndarray | None:
        """Return the overlays, (H, W) bool; None where there are none, or the camera has moved too little so far.

        rgb : (H, W, 3) uint8. field : (H, W) bool, field of view, searched without its static rim.
        outside : (H, W) bool, searched too.
        """
        level = cv2.extractChannel(rgb, _CHANNEL)
        detail = _small_detail(level, field)
        if self._mean.shape != level.shape:
            self.count, self._found = 1, None
            self._last, self._mean = detail, level.astype(np.float32)
            self._change, self._calm_change = np.zeros_like(self._mean), np.zeros_like(self._mean)
        elif _has_moved(self._last, detail):
            self._last = detail
            self._learn(level)
            if self.count >= _MIN_COUNT and self.count % _LOOK_EVERY == 0:
                self._found = self._overlays(level, field if outside is None else field | outside)
        return None if self._found is None else self._found.shown(level)

    def record(self) -> dict[str, Any]:
        """Return what was learnt from all images so far, for `resume`: numbers and arrays by name."""
        means = {"mean": self._mean, "change": self._change, "calm_change": self._calm_change}
        copies = {name: values.copy() for name, values in means.items()}  # they go on changing
        found = None if self._found is None else vars(self._found)
        return {"count": self.count, "last": self._last, "found": found} | copies

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record."""
        self.count, self._last, self._mean = record["count"], record["last"], record["mean"]
        self._change, self._calm_change = record["change"], record["calm_change"]
        self._found = None if record["found"] is None else _Found(**record["found"])

    def _learn(self, level: np.ndarray) -> None:
        self.count += 1
        weight = 1 / min(self.count, _MEMORY)
        now = level.astype(np.float32)
        # Changes of exposure are not changes of content.
        steady = now * (cv2.mean(self._mean)[0] / max(cv2.mean(level)[0], 1.0))
        calm = cv2.blur(steady - self._mean, (_CALM_PX, _CALM_PX))
        cv2.accumulateWeighted(np.abs(calm), self._calm_change, weight)
        cv2.accumulateWeighted(cv2.absdiff(now, self._mean), self._change, weight)
        cv2.accumulateWeighted(now, self._mean, weight)

    def _overlays(self, level: np.ndarray, field: np.ndarray) -> _Found | None:
        contrast = cv2.morphologyEx(self._mean, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
        still = (contrast >= _EDGE) & (self._change <= _STILL_SHARE * contrast)
        # An overlay that has just disappeared must not persist in the running mean.
        still &= cv2.absdiff(level.astype(np.float32), self._mean) <= _NOW_SHARE * contrast
        still &= cv2.erode(field.astype(np.uint8), _square(_RIM_PX), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
        if np.count_nonzero(still) < _MIN_PX:
            return None
        still &= _stands_alone(still, (self._calm_change >= _CHANGED) | (contrast <= _PLAIN))
        mask = _grown(still)
        if not mask.any():
            return None
        _, labels = cv2.connectedComponents(mask.astype(np.uint8))
        edges = np.flatnonzero(still & mask)
        mean, limit = self._mean.ravel()[edges], _NOW_SHARE * contrast.ravel()[edges]
        return _Found(mask, labels, edges, mean, limit, labels.ravel()[edges])


def _small_detail(level: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return a small copy minus its local mean inside the field, float32, 0 outside."""
    factor = max(1, min(level.shape) // _SMALL_SIDE_PX)
    height, width = (side // factor for side in level.shape)
    # An integer factor is several times faster.
    whole = level[: height * factor, : width * factor]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    inside = field[factor // 2 :: factor, factor // 2 :: factor][:height, :width].astype(np.float32)
    weight = cv2.blur(inside, (_LOCAL_PX, _LOCAL_PX))
    mean = cv2.blur(small * inside, (_LOCAL_PX, _LOCAL_PX)) / np.maximum(weight, 1e-3)
    return np.asarray((small - mean) * inside)


def _has_moved(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether the texture of most parts has changed, by correlation, which is independent of illumination."""
    textured, textured_before = (_in_parts(np.abs(image)) >= _TEXTURE for image in (now, before))
    if textured_before.sum() < _MIN_PARTS:
        # After a black picture the next textured one counts.
        return bool(textured.sum() >= _MIN_PARTS)
    textured &= textured_before
    power = np.sqrt(_in_parts(before * before) * _in_parts(now * now))
    moved = textured & (_in_parts(before * now) < _ALIKE * power)
    return bool(textured.sum() >= _MIN_PARTS and moved.sum() >= _MOVED_SHARE * textured.sum())


def _in_parts(values: np.ndarray) -> np.ndarray:
    return cv2.resize(values, _PARTS, interpolation=cv2.INTER_AREA)


def _stands_alone(still: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the static edges, (H, W) bool, whose surroundings are nearly all `other` (moving or uniform), bool."""
    near = cv2.dilate(_closed(still), _square(_NEAR_PX))
    count, labels = cv2.connectedComponents(near)
    # The largest label within the radius: a pixel between two groups counts for one of them.
    around = cv2.dilate(labels.astype(np.float32), _square(_FAR_PX)).astype(np.int32)
    around[near > 0] = 0
    pixels = np.bincount(around.ravel(), minlength=count)
    alone = np.bincount(around.ravel(), other.ravel(), minlength=count) >= _AROUND_SHARE * pixels
    return alone[labels]


def _square(radius_px: int) -> np.ndarray:
    return np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)


def _closed(still: np.ndarray) -> np.ndarray:
    return cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((_CLOSING_PX, _CLOSING_PX), np.uint8))


def _grown(still: np.ndarray) -> np.ndarray:
    """Return edges (H, W) bool with gaps closed, holes filled and a margin; specks are removed."""
    closed = _closed(still)
    contours, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = np.zeros_like(closed)
    for contour in contours:
        x, y, width, height = cv2.boundingRect(contour)
        box = np.s_[y : y + height, x : x + width]
        if np.count_nonzero(still[box]) < _MIN_PX:
            continue
        found[box] = np.maximum(found[box], closed[box])
        if cv2.contourArea(contour) <= _MAX_SHARE * still.size:
            cv2.drawContours(found, [contour], -1, 1, cv2.FILLED)
    return cv2.dilate(found, _square(_GROW_PX)) > 0
