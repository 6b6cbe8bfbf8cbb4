"""Flow in both directions between two frames, with the forward-backward consistency check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.errors import check_shape
from scopemap.flow.estimator import FlowEstimator
from scopemap.geometry.warp import pull


@dataclass(frozen=True)
class Flow:
    """Optical flow between the previous and the current frame.

    Attributes
    ----------
    to_previous : (H, W, 2) float32, px: pixel p of the current frame is seen at p + to_previous(p) in the previous.
    to_current : (H, W, 2) float32, px: from the previous frame to the current.
    consistent : (H, W) bool on the current frame's grid: True where the forward-backward error is small.
    """

    to_previous: np.ndarray
    to_current: np.ndarray
    consistent: np.ndarray


def pair_flow(
    estimator: FlowEstimator, rgb_previous: np.ndarray, rgb_current: np.ndarray, consistency_px: float
) -> Flow:
    """Return the forward and backward flow between two (H, W, 3) uint8 frames, with their consistency check.

    consistency_px : largest forward-backward error.
    """
    check_shape("rgb_previous", rgb_previous, (None, None, 3))
    check_shape("rgb_current", rgb_current, rgb_previous.shape)
    to_current, to_previous = estimator.estimate_both(rgb_previous, rgb_current)
    return Flow(to_previous, to_current, agree(to_previous, to_current, consistency_px))


def agree(forth: np.ndarray, back: np.ndarray, consistency_px: float) -> np.ndarray:
    """Return (H, W) bool: True where the flow `forth` (H, W, 2) stays in the image and is consistent with `back`."""
    error_px = np.linalg.norm(forth + pull(back, forth), axis=-1)
    return error_px <= consistency_px
