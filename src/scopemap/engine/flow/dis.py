"""Dense inverse search flow (Kroeger et al., ECCV 2016) of OpenCV: light, no weights."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.flow.estimator import FlowEstimator, FlowPair

_MEDIUM = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM


class DisFlow(FlowEstimator):
    """OpenCV's DIS flow on grey values, preset "medium"."""

    name = "dis"
    enough_px = 160

    def __init__(self) -> None:
        self._dis = cv2.DISOpticalFlow.create(_MEDIUM)
        # Flow that begins near the truth needs fewer steps; what checks, or is small, fewer patches; what is
        # small fewer refinements: of all, they made a phantom's poses a sixth worse, of what checks, they lost a
        # place seen again. A coarser finest scale lets wrong matches pass: poses from frame to frame a sixth worse.
        self._near, self._check, self._small = (cv2.DISOpticalFlow.create(_MEDIUM) for _ in range(3))
        for dis in (self._near, self._check, self._small):
            dis.setGradientDescentIterations(12)
        self._check.setPatchStride(5)
        self._small.setPatchStride(5)
        self._small.setVariationalRefinementIterations(3)

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px, of two (H, W, 3) uint8 images of one size."""
        return _computed(self._dis, rgb_from, rgb_to)

    def estimate_small(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow of images that are nearly alike, by fewer patches."""
        return _computed(self._small, rgb_from, rgb_to)

    def estimate_checked(self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: FlowPair | None = None) -> FlowPair:
        """Return the flow there, and back by fewer patches; the coarsest scale begins at `start`."""
        there, back = (None, None) if start is None else start
        return _computed(self._near, rgb_from, rgb_to, there), _computed(self._check, rgb_to, rgb_from, back)

    def provenance(self) -> dict[str, str]:
        """Return the name and OpenCV's version."""
        return {"flow": self.name, "opencv": cv2.__version__}


def _computed(
    dis: cv2.DISOpticalFlow, rgb_from: np.ndarray, rgb_to: np.ndarray, start: np.ndarray | None = None
) -> np.ndarray:
    grey_from, grey_to = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (rgb_from, rgb_to))
    # OpenCV writes the result over the start.
    flow = np.zeros((*grey_from.shape, 2), np.float32) if start is None else start.astype(np.float32)
    return np.asarray(dis.calc(grey_from, grey_to, flow), np.float32)
