"""Dense inverse search flow (Kroeger et al., ECCV 2016) of OpenCV: light, no weights."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.flow.estimator import FlowEstimator


class DisFlow(FlowEstimator):
    """OpenCV's DIS flow on grey values, preset "medium".

    smooth : False leaves the variational refinement out and goes down to whole pixels: noisier, but near tissue keeps
    its parallax.
    """

    name = "dis"

    def __init__(self, *, smooth: bool = True) -> None:
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        if not smooth:
            self._dis.setFinestScale(0)
            self._dis.setVariationalRefinementIterations(0)

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px, of two (H, W, 3) uint8 images of one size."""
        return self._estimate(rgb_from, rgb_to, np.zeros((*rgb_from.shape[:2], 2), np.float32))

    def estimate_both_from(
        self, rgb_a: np.ndarray, rgb_b: np.ndarray, start: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the flows a to b and b to a; the coarsest scale begins at `start`."""
        return self._estimate(rgb_a, rgb_b, start[0]), self._estimate(rgb_b, rgb_a, start[1])

    def _estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: np.ndarray) -> np.ndarray:
        grey_from, grey_to = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (rgb_from, rgb_to))
        return np.asarray(self._dis.calc(grey_from, grey_to, start.astype(np.float32)), np.float32)

    def provenance(self) -> dict[str, str]:
        """Return the name and OpenCV's version."""
        return {"flow": self.name, "opencv": cv2.__version__}
