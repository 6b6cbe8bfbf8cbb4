"""Corners of a frame, and where flow finds them in another: few points, but such as hold on to the tissue itself.

Shading moves with the lamp and pulls flow along where tissue has no texture; corners stay where they are.
"""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.frame import Frame

_CORNER_BLOCK_PX = 5
_BORDER_PX = 3


def corners(frame: Frame, cell_px: int) -> np.ndarray:
    """Return pixels (n, 2) int x, y: the most corner-like one with depth of each cell of `cell_px` x `cell_px`.

    The strength is the smaller eigenvalue of the structure tensor (Shi and Tomasi, CVPR 1994). Every whole cell with
    usable tissue gives one, however weak, unless it is quite flat: where corners are few, edges and shades are better
    than nothing.
    """
    assert frame.depth_mm is not None
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    # On brightness relative to its surround: far tissue is dark, not featureless.
    level = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 8.0) + 8.0
    strength = cv2.cornerMinEigenVal(grey / level, _CORNER_BLOCK_PX)
    usable = frame.valid & (frame.depth_mm > 0) & np.isfinite(frame.depth_mm)
    # A patch that touches a mask's edge has a corner that is not the tissue's.
    usable = cv2.erode(usable.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8), borderValue=0) > 0
    strength = np.where(usable, strength, -1.0)
    height, width = (side // cell_px * cell_px for side in strength.shape)
    cells: np.ndarray = strength[:height, :width].reshape(height // cell_px, cell_px, width // cell_px, cell_px)
    cells = cells.transpose(0, 2, 1, 3).reshape(-1, cell_px * cell_px)
    best = cells.argmax(1)
    row, column = np.divmod(np.arange(len(cells)), width // cell_px)
    places = np.column_stack([column * cell_px + best % cell_px, row * cell_px + best // cell_px])
    return places[cells.max(1) > 0]


def followed(
    places: np.ndarray, flows: tuple[np.ndarray, np.ndarray], valid: np.ndarray, consistency_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which corners (m,) int are found in another frame, and where, (m, 2) float64 px.

    places : (n, 2) int x, y. flows : (H, W, 2) px to the other frame, and back. valid : (H, W) bool, its usable pixels.
    consistency_px : largest distance between a corner and where there and back again leads.
    """
    start = places.astype(np.float32)
    pixel = start + flows[0][places[:, 1], places[:, 0]]
    returned = pixel + sampled_at(flows[1], pixel)
    height, width = valid.shape
    nearest = np.clip(np.rint(pixel).astype(int), 0, [width - 1, height - 1])
    inside = ((pixel >= 0) & (pixel <= [width - 1, height - 1])).all(1)
    good = inside & valid[nearest[:, 1], nearest[:, 0]]
    good &= np.linalg.norm(returned - start, axis=1) <= consistency_px
    number = np.flatnonzero(good)
    return number, pixel[number].astype(np.float64)


def sampled_at(flow: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return the flow (n, 2) at pixels (n, 2), bilinear; NaN outside.

    Not OpenCV's remap, which refuses none and very many.
    """
    height, width = flow.shape[:2]
    inside = ((pixel >= 0) & (pixel <= [width - 1, height - 1])).all(axis=1, keepdims=True)
    place = np.where(inside, pixel, 0.0)
    corner = np.clip(np.floor(place).astype(int), 0, [width - 2, height - 2])
    x, y = corner.T
    a, b = (place - corner).T[..., None]
    top = (1 - a) * flow[y, x] + a * flow[y, x + 1]
    bottom = (1 - a) * flow[y + 1, x] + a * flow[y + 1, x + 1]
    return np.where(inside, (1 - b) * top + b * bottom, np.nan)
