"""The protocol of optical flow estimators."""

from __future__ import annotations

from typing import Protocol

import numpy as np


class FlowEstimator(Protocol):
    """Optical flow between two images: pixel p of the first is seen at p + flow(p) in the second."""

    name: str

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px (x, y), of two (H, W, 3) uint8 images of one size."""
        ...

    def estimate_both(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flows a to b and b to a; an estimator that can share work between them overrides this."""
        return self.estimate(rgb_a, rgb_b), self.estimate(rgb_b, rgb_a)

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
