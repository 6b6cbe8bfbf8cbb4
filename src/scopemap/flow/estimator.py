"""The protocol of optical flow estimators, and flow in both directions with its forward-backward consistency check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scopemap.errors import check_shape
from scopemap.geometry.warp import pull


class FlowEstimator(Protocol):
    """Optical flow between two images: pixel p of the first is seen at p + flow(p) in the second."""

    name: str

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px (x, y), of two (H, W, 3) uint8 images of one size."""
        ...

    def estimate_both(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flows a to b and b to a; an estimator that can share work between them overrides this."""
        return self.estimate(rgb_a, rgb_b), self.estimate(rgb_b, rgb_a)

    def estimate_both_from(
        self, rgb_a: np.ndarray, rgb_b: np.ndarray, start: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the flows a to b and b to a, searched from `start`; an estimator that has no start ignores it."""
        return self.estimate_both(rgb_a, rgb_b)

    def provenance(self) -> dict[str, str]:
        """Return what the result depends on, as text: names, versions, hashes."""
        ...


class NoFlow(FlowEstimator):
    """Zero flow everywhere: the previous image is taken as it is."""

    name = "none"

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return (H, W, 2) float32 zeros."""
        return np.zeros((*rgb_from.shape[:2], 2), np.float32)

    def provenance(self) -> dict[str, str]:
        """Return the name."""
        return {"flow": self.name}


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
