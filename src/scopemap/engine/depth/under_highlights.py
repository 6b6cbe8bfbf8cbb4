"""Depth under small highlights, from what is around them: a highlight moves with the lamp, not with the tissue.

Networks take it for relief, and flow follows it, so that what is triangulated there is wrong.

Measured against stereo and a phantom's true depth by `python -m scopemap_bench.scripts.highlights`.
"""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.depth.guided import filled
from scopemap.engine.masking.masker import disc

_LARGEST = 0.02  # by hand: share of the picture up to which a highlight is small
_RADIUS_PX = 3  # by hand: of what is looked at around a pixel
# Share of the picture's width by which a highlight is widened. By trial, of 0, 1/160, 1/80, 1/40: errors under
# highlights against stereo were 4.1, 3.5, 3.5, 4.0 % (Hamlyn) and 5.3, 5.0, 5.0, 5.1 % (EndoNeRF).
_RIM = 1 / 160


def small_highlights(highlights: np.ndarray) -> np.ndarray:
    """Return the highlights, (H, W) bool, that are small and do not touch the image's border."""
    _, regions, stats, _ = cv2.connectedComponentsWithStats(highlights.astype(np.uint8))
    small = stats[:, cv2.CC_STAT_AREA] <= _LARGEST * highlights.size
    small[0] = False
    for border in (regions[0], regions[-1], regions[:, 0], regions[:, -1]):
        small[np.unique(border)] = False
    found: np.ndarray = small[regions]
    return found


def depth_under_highlights(depth_mm: np.ndarray, highlights: np.ndarray | None) -> np.ndarray:
    """Return depth whose logarithm under small highlights and their rims continues that around them (Bertalmio et al.,
    "Navier-Stokes, fluid dynamics, and image and video inpainting", CVPR 2001).

    depth_mm : (H, W) float32, NaN = unknown; where it is, it stays so. highlights : (H', W') bool of the same view at
    any size, None: not looked for.
    """
    if highlights is None or not highlights.any():
        return depth_mm
    height, width = depth_mm.shape
    shares = cv2.resize(small_highlights(highlights).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    rim_px = max(1, round(_RIM * width))
    under = cv2.dilate((shares > 0).astype(np.uint8), disc(rim_px)) > 0
    known = depth_mm > 0
    if not (under & known).any() or not (~under & known).any():
        return depth_mm
    log_depth = np.log(np.where(known, depth_mm, np.float32(1)))
    if not known.all():
        # Unknown pixels beside a highlight count as the known ones that are nearest.
        log_depth = np.nan_to_num(filled(log_depth, known & ~under, 2 * _RADIUS_PX))
    continued = cv2.inpaint(log_depth, under.astype(np.uint8), _RADIUS_PX, cv2.INPAINT_NS)
    return np.where(under & known, np.exp(continued), depth_mm)
