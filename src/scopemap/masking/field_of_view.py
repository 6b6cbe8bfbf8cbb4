"""The field of view: what the endoscope lights inside the black surround, learnt from the frames seen so far."""

from __future__ import annotations

import cv2
import numpy as np

_LEAST_SHARE = 0.05


class FieldOfView:
    """The convex hull (circle, octagon and rectangle are convex) of the largest area that was lit in any frame so far.

    Dark tissue in the lumen is thus not taken for the surround. border_px : by which the hull is shrunk, from pixels
    that the rectification could not fill too, but not from the image's own edge.
    """

    def __init__(self, border_px: int) -> None:
        self._border_px = border_px
        self._lit: np.ndarray | None = None
        self._field: np.ndarray | None = None

    def __call__(self, lit: np.ndarray, rectified: np.ndarray) -> np.ndarray:
        """Return the field of view, (H, W) bool, and learn from this frame.

        lit : (H, W) bool, as `masking.is_lit` has it. rectified : (H, W) bool, which pixels show anything.
        """
        # Single bright pixels are noise of the coding in the black surround.
        lit = cv2.morphologyEx((lit & rectified).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
        known = self._lit
        if known is not None and self._field is not None and known.shape == lit.shape:
            if not (lit & ~known).any():
                return self._field
            lit |= known
        self._lit = lit
        side = 2 * self._border_px + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        self._field = cv2.erode((hull_of_largest(lit) & rectified).astype(np.uint8), disc).astype(bool)
        return self._field


def hull_of_largest(lit: np.ndarray) -> np.ndarray:
    """Return the convex hull, (H, W) bool, of the largest component; all of the image where that is hardly anything."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
    areas = stats[1:, cv2.CC_STAT_AREA]
    if areas.size == 0 or areas.max() < _LEAST_SHARE * lit.size:
        return np.ones_like(lit)
    component = (labels == 1 + int(np.argmax(areas))).astype(np.uint8)
    contours, _ = cv2.findContours(component, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(contours))
    return cv2.fillConvexPoly(np.zeros_like(component), hull, 1).astype(bool)
