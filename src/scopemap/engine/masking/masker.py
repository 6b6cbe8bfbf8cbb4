"""Which pixels show usable tissue: field of view, highlights, exposure, overlays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import cv2
import numpy as np

from scopemap.engine.config import MaskSettings
from scopemap.engine.frame import Frame, is_constant, percentiles_uint8
from scopemap.engine.masking.overlays import OverlayFinder
from scopemap.engine.notices import Notice

# The local level that a highlight stands out from is taken over this share of the image's longer side.
_NEIGHBOURHOOD_SHARE = 0.09  # by hand
_DARKEST_HIGHLIGHT = 70  # by hand: grey level of a highlight's darkest channel, at least
_DARK_LEVEL = 12  # by hand: grey level up to which a pixel counts as under-exposed
# Level at which the second-brightest channel is saturated, and how far a highlight's darkest channel stands out.
BRIGHT_LEVEL = 240  # by hand
_HIGHLIGHT_RATIO = 1.5  # by hand
# A highlight is widened, and the field of view shrunk, by so much: their rims are blurred.
_HIGHLIGHT_GROW_PX = 2  # by hand
BORDER_PX = 3  # by hand
# Width of the mean that leaves little of a sensor's noise.
_CALM_WIDTH_PX = 5  # by hand
_MIN_FIELD_SHARE = 0.05  # by hand: of the picture; less is no field of view
# Instruments: a region counts where this share of the picture is likelier than `_SEED`, and reaches as far as pixels
# are likelier than `_REACH`, or than `_HELD` near instruments of the frame before.
_SEED = 0.5  # by hand
_REACH = 0.04  # chosen on pictures of training scenes (docs/models/scopenet.md)
_HELD = 0.02  # by hand
_LEAST_SHARE = 0.0004  # by hand
# How near that is, and how wide the blurred rim is, as shares of the picture's longer side.
_NEAR_SHARE = 0.02  # by hand
_RIM_SHARE = 0.008  # by hand


class FieldOfView:
    """The convex hull (circle, octagon and rectangle are convex) of the largest area that was lit in any frame so far.

    Dark tissue in the lumen is thus not taken for the surround. The hull is shrunk by `BORDER_PX`, and keeps
    as far from pixels that the rectification could not fill, but not from the image's own edge.
    """

    lit: np.ndarray | None = None
    """What was lit in any frame so far, (H, W) bool; None before the first."""
    _field: np.ndarray | None = None

    def __call__(self, lit: np.ndarray, rectified: np.ndarray) -> np.ndarray:
        """Return the field of view, (H, W) bool, and learn from this frame; lit, rectified : (H, W) bool."""
        # Single bright pixels are noise of the coding in the black surround.
        lit = cv2.morphologyEx((lit & rectified).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        known = self.lit
        if known is not None and known.shape == lit.shape:
            if self._field is not None and not (lit & ~known).any():
                return self._field
            lit |= known
        self.lit = lit
        self._field = cv2.erode((hull_of_largest(lit) & rectified).astype(np.uint8), disc(BORDER_PX)).astype(bool)
        return self._field


def hull_of_largest(lit: np.ndarray) -> np.ndarray:
    """Return the convex hull, (H, W) bool, of the largest component; all of the image where that is tiny."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
    areas = stats[1:, cv2.CC_STAT_AREA]
    if areas.size == 0 or areas.max() < _MIN_FIELD_SHARE * lit.size:
        return np.ones_like(lit)
    component = (labels == 1 + int(np.argmax(areas))).astype(np.uint8)
    contours, _ = cv2.findContours(component, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(contours))
    return cv2.fillConvexPoly(np.zeros_like(component), hull, 1).astype(bool)


class StoredMasks(Protocol):
    """Masks of pixels that show no tissue, made by others: `mask_files.MaskFiles`."""

    @property
    def notices(self) -> list[Notice]:
        """Notices about the masks read so far."""
        ...

    def covered(self, index: int) -> np.ndarray | None:
        """Return the masked pixels of a frame, (H, W) bool; None without a mask."""
        ...

    def provenance(self) -> dict[str, str]:
        """Return the origin of the masks."""
        ...


class Masker:
    """Narrows `Frame.valid` to usable tissue, in the field of view of all frames so far and outside of mask `files`."""

    _instruments: np.ndarray | None = None

    def __init__(self, settings: MaskSettings, files: StoredMasks | None = None) -> None:
        self.settings, self._files = settings, files
        self._field, self._from_file = FieldOfView(), False
        self._overlays = None if settings.has("no-overlays") else OverlayFinder()

    def record(self) -> dict[str, Any]:
        """Return what all frames so far have shown, for `resume`: numbers and arrays by name."""
        overlays = None if self._overlays is None else self._overlays.record()
        return {"lit": self._field.lit, "overlays": overlays}

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record. Masks of frames that are not read again are read by `pass_over`."""
        self._field.lit = record["lit"]
        if self._overlays is not None:
            self._overlays.resume(record["overlays"])

    def pass_over(self, index: int) -> None:
        """Take the number of a frame that was masked before the run was resumed: its mask file counts."""
        if self._files is not None:
            self._files.covered(index)

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame with `valid` False also outside the field of view, at highlights, overlays, bad exposure.

        Under-exposed is a pixel whose brightest channel, or the mean around it, is at most `_DARK_LEVEL`; over-exposed
        one whose second brightest channel reaches `BRIGHT_LEVEL`: red alone clips on sound tissue.
        """
        darkest, middle = darker_channels(frame.rgb)
        clipped = middle >= BRIGHT_LEVEL
        lit = is_lit(frame.rgb)
        valid = frame.valid if self.settings.has("no-exposure") else frame.valid & lit & ~clipped
        field = frame.valid if self.settings.has("no-field-of-view") else self._field(lit, frame.valid)
        highlights = np.zeros_like(valid)
        if not self.settings.has("no-highlights"):
            bright = clipped | specular(darkest, field)
            highlights = frame.valid & field & (cv2.dilate(bright.astype(np.uint8), disc(_HIGHLIGHT_GROW_PX)) > 0)
            valid &= ~highlights
        overlays = None if self._overlays is None else self._overlays(frame.rgb, field)
        files = None if self._files is None else self._files.covered(frame.index)
        self._from_file = files is not None
        for covered in (overlays, files):
            if covered is not None:
                valid, highlights = valid & ~covered, highlights & ~covered
        if is_constant(frame.rgb):
            valid = np.zeros_like(valid)
        return replace(frame, valid=valid & field, highlights=highlights)

    def instruments(self, probability: np.ndarray | None) -> np.ndarray | None:
        """Return the last frame's instruments, widened and held, (H, W) bool, by (H, W) 0..1; None: not looked for."""
        if probability is None or self.settings.instruments != "auto" or self._from_file:
            self._instruments = None
            return None
        side, before = max(probability.shape), self._instruments
        least = np.full(probability.shape, _REACH, np.float32)
        if before is not None and before.shape == probability.shape and before.any():
            least[cv2.dilate(before.astype(np.uint8), disc(round(_NEAR_SHARE * side))) > 0] = _HELD
        count, regions = cv2.connectedComponents((probability > least).astype(np.uint8))
        seeds = np.bincount(regions[probability > _SEED], minlength=count)
        kept = seeds >= _LEAST_SHARE * probability.size
        kept[0] = False
        self._instruments = kept[regions]
        if not kept.any():
            return self._instruments
        return cv2.dilate(self._instruments.astype(np.uint8), disc(max(round(_RIM_SHARE * side), 1))) > 0


def without_instruments(frame: Frame, instruments: np.ndarray) -> Frame:
    """Return the frame with its instruments, (h, w) bool of any size, where no pixel is usable and no highlight is."""
    size = frame.camera.width, frame.camera.height
    found = cv2.resize(instruments.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    highlights = None if frame.highlights is None else frame.highlights & ~found
    return replace(frame, valid=frame.valid & ~found, highlights=highlights, instruments=found)


def specular(darkest: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return specular highlights, (H, W) bool.

    Tissue is red, a mirror image of the lamp is white: the darkest channel, (H, W) uint8, is 1.5 times as bright as its
    local median in `field`, (H, W) bool.
    """
    if not field.any():
        return np.zeros_like(field)
    surroundings = _local_median(
        np.where(field, darkest, percentiles_uint8(darkest[field], [50.0])[0]).astype(np.uint8)
    )
    return (darkest > _HIGHLIGHT_RATIO * surroundings) & (darkest > _DARKEST_HIGHLIGHT)


def is_lit(rgb: np.ndarray) -> np.ndarray:
    """Return which pixels of an image (H, W, 3) uint8 are brighter than `_DARK_LEVEL`, and so is the mean around."""
    calm = cv2.blur(rgb, (_CALM_WIDTH_PX, _CALM_WIDTH_PX))
    brightest = [cv2.max(cv2.max(r, g), b) for r, g, b in map(cv2.split, (rgb, calm))]
    return cv2.min(*brightest) > _DARK_LEVEL


def darker_channels(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the darkest and the middle channel of each pixel, (H, W) uint8 each."""
    r, g, b = cv2.split(rgb)
    low, high = cv2.min(r, g), cv2.max(r, g)
    return cv2.min(low, b), cv2.max(low, cv2.min(high, b))


def _local_median(level: np.ndarray) -> np.ndarray:
    """Return the median (H, W) uint8 around each pixel of `level` (H, W) uint8, computed at a quarter of the size."""
    height, width = level.shape
    small = cv2.resize(level, (max(1, width // 4), max(1, height // 4)), interpolation=cv2.INTER_AREA)
    side = max(3, round(_NEIGHBOURHOOD_SHARE * max(small.shape)) | 1)
    return cv2.resize(cv2.medianBlur(small, side), (width, height), interpolation=cv2.INTER_LINEAR)


def disc(radius_px: int) -> np.ndarray:
    """Return the structuring element of a disc, uint8."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))
