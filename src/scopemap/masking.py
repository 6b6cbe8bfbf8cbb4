"""Which pixels show usable tissue: field of view, highlights, exposure."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from scopemap.config import MaskSettings
from scopemap.frame import Frame
from scopemap.mask_files import MaskFiles

# The local level that a highlight stands out from is taken over this share of the image's longer side.
_NEIGHBOURHOOD_SHARE = 0.09
_DARKEST_HIGHLIGHT = 70
_CONSTANT_RANGE = 4
# Widths of the means that leave little of a sensor's noise: for one image as a whole, and for one pixel.
_NOISE_WIDTH_PX = 9
_CALM_WIDTH_PX = 5
_LEAST_FIELD_SHARE = 0.05


def is_constant(rgb: np.ndarray) -> bool:
    """Return whether an image (H, W, 3) uint8 shows nothing: black, or one even colour up to noise."""
    calm = cv2.blur(rgb, (_NOISE_WIDTH_PX, _NOISE_WIDTH_PX))
    low, high = np.percentile(cv2.cvtColor(calm, cv2.COLOR_RGB2GRAY), [0.5, 99.5])
    return bool(high - low <= _CONSTANT_RANGE)


class Masker:
    """Narrows `Frame.valid` to usable tissue; the field of view is learnt from the frames it has seen so far.

    files : masks of what is known to be no tissue, or None.
    """

    def __init__(self, settings: MaskSettings, files: MaskFiles | None = None) -> None:
        self.settings, self._files = settings, files
        self._lit: np.ndarray | None = None
        self._field: np.ndarray | None = None

    def __call__(self, frame: Frame) -> Frame:
        """Return the frame with `valid` False also outside the field of view, at highlights, at bad exposure, by files.

        Under-exposed is a pixel whose brightest channel is at most `dark_level`, its own or the mean around it: noise
        lifts single pixels of a black image. Over-exposed is one whose second brightest channel reaches
        `bright_level`: red alone clips on sound tissue, and leaves two channels to see by.
        """
        darkest, middle, brightest = _sorted_channels(frame.rgb)
        clipped = middle >= self.settings.bright_level
        calm = cv2.blur(frame.rgb, (_CALM_WIDTH_PX, _CALM_WIDTH_PX)).max(-1)
        lit = np.minimum(brightest, calm) > self.settings.dark_level
        valid = frame.valid & lit & ~clipped
        field = frame.valid
        if self.settings.field_of_view:
            field = self._field_of_view(lit, frame.valid)
        if self.settings.highlights:
            valid &= ~_grown(clipped | self._highlights(darkest, field), self.settings.highlight_grow_px)
        covered = None if self._files is None else self._files.covered(frame.index)
        if covered is not None:
            valid &= ~covered
        return replace(frame, valid=valid & field)

    def _field_of_view(self, lit: np.ndarray, rectified: np.ndarray) -> np.ndarray:
        """Return the field of view, (H, W) bool, and learn from this frame.

        It is the convex hull (circle, octagon and rectangle are convex) of the largest connected area that was lit in
        any frame so far, so that dark tissue in the lumen is not taken for the surround. It is shrunk by `border_px`,
        from pixels that the rectification could not fill too, but not from the image's own edge.
        """
        # Single bright pixels are noise of the coding in the black surround.
        lit = cv2.morphologyEx((lit & rectified).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        known = self._lit
        if known is not None and self._field is not None and known.shape == lit.shape:
            if not (lit & ~known).any():
                return self._field
            lit |= known
        self._lit = lit
        self._field = _shrunk(_hull_of_largest(lit) & rectified, self.settings.border_px)
        return self._field

    def _highlights(self, whiteness: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return specular highlights, (H, W) bool.

        Tissue is red, a mirror image of the lamp is white: its darkest channel (`whiteness`) stands out from the local
        median. The surround takes no part: it would make a highlight of the rim.
        """
        if not field.any():
            return np.zeros_like(field)
        surroundings = _local_median(np.where(field, whiteness, np.median(whiteness[field])).astype(np.uint8))
        return (whiteness > self.settings.highlight_ratio * surroundings) & (whiteness > _DARKEST_HIGHLIGHT)


def _sorted_channels(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return darkest, middle and brightest channel of each pixel, (H, W) uint8 each."""
    r, g, b = cv2.split(rgb)
    low, high = cv2.min(r, g), cv2.max(r, g)
    return cv2.min(low, b), cv2.max(low, cv2.min(high, b)), cv2.max(high, b)


def _hull_of_largest(lit: np.ndarray) -> np.ndarray:
    """Return the convex hull of the largest component; everything where that is too small to be a field of view."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
    areas = stats[1:, cv2.CC_STAT_AREA]
    if areas.size == 0 or areas.max() < _LEAST_FIELD_SHARE * lit.size:
        return np.ones_like(lit)
    component = (labels == 1 + int(np.argmax(areas))).astype(np.uint8)
    contours, _ = cv2.findContours(component, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(contours))
    return cv2.fillConvexPoly(np.zeros_like(component), hull, 1).astype(bool)


def _local_median(level: np.ndarray) -> np.ndarray:
    """Return the median (H, W) uint8 around each pixel of `level` (H, W) uint8, computed at a quarter of the size."""
    height, width = level.shape
    small = cv2.resize(level, (max(1, width // 4), max(1, height // 4)), interpolation=cv2.INTER_AREA)
    side = max(3, round(_NEIGHBOURHOOD_SHARE * max(small.shape)) | 1)
    return cv2.resize(cv2.medianBlur(small, side), (width, height), interpolation=cv2.INTER_LINEAR)


def _disc(radius_px: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))


def _grown(mask: np.ndarray, radius_px: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), _disc(radius_px)).astype(bool)


def _shrunk(mask: np.ndarray, radius_px: int) -> np.ndarray:
    return cv2.erode(mask.astype(np.uint8), _disc(radius_px)).astype(bool)
