"""Dense correspondence of each frame with the previous one: optical flow, its consistency, perceptual distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.config import MapisSettings
from scopemap.depth.estimate import PerceptualDistance
from scopemap.flow.consistency import pair_flow
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Frame
from scopemap.geometry.warp import pull


@dataclass(frozen=True)
class DenseCorrespondence:
    """Dense correspondence of a frame with the previous one.

    Attributes
    ----------
    to_previous : (H, W, 2) float32 px, from the current frame. consistent : (H, W) bool, flow check passed.
    distance : (H, W) float32 perceptual distance of the two images, 0 = alike; constant for a single score.
    usable_share : share of the current image that shows tissue.
    """

    to_previous: np.ndarray
    consistent: np.ndarray
    distance: np.ndarray
    usable_share: float = 1.0


class DenseMatcher:
    """Matches masked frames, in order, with the previous one."""

    def __init__(self, settings: MapisSettings, flow: FlowEstimator, perceptual: PerceptualDistance) -> None:
        self._settings, self._flow, self._perceptual = settings, flow, perceptual
        self._previous: Frame | None = None

    def match(self, frame: Frame, *, wanted: bool = True) -> DenseCorrespondence | None:
        """Return the correspondence; None for the first frame and where it is not `wanted`."""
        previous, self._previous = self._previous, frame
        if previous is None or not wanted:
            return None
        flow = pair_flow(self._flow, previous.rgb, frame.rgb, self._settings.advanced.consistency_px)
        # Masked pixels of either frame show no tissue.
        seen = pull(previous.valid.astype(np.float32), flow.to_previous) > 0.5
        rgb = pull(previous.rgb, flow.to_previous) if self._settings.paper.compare_warped else previous.rgb
        distance = self._perceptual.compare(rgb, frame.rgb)
        values = np.full_like(distance.map, distance.score) if self._settings.paper.perceptual_score else distance.map
        consistent = flow.consistent & seen & frame.valid
        return DenseCorrespondence(flow.to_previous, consistent, values, float(frame.valid.mean()))
