"""No flow at all: the previous image is taken as it is."""

from __future__ import annotations

import numpy as np

from scopemap.flow.estimator import FlowEstimator


class NoFlow(FlowEstimator):
    """Zero flow everywhere."""

    name = "none"

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return (H, W, 2) float32 zeros."""
        return np.zeros((*rgb_from.shape[:2], 2), np.float32)

    def provenance(self) -> dict[str, str]:
        """Return the name."""
        return {"flow": self.name}
