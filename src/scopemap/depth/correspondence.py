"""Dense correspondence of each frame with the previous one: optical flow, its consistency, perceptual distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap.config import MapisSettings
from scopemap.depth.estimate import PerceptualDistance
from scopemap.flow.estimator import FlowEstimator, pair_flow
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
    """Matches masked images, in order, with the previous one."""

    def __init__(self, settings: MapisSettings, flow: FlowEstimator, perceptual: PerceptualDistance) -> None:
        self._settings, self._flow, self._perceptual = settings, flow, perceptual
        self._previous: tuple[np.ndarray, np.ndarray] | None = None

    def match(self, rgb: np.ndarray, valid: np.ndarray, *, wanted: bool = True) -> DenseCorrespondence | None:
        """Return the correspondence of an image (H, W, 3) uint8 with valid pixels (H, W) to the previous one.

        None for the first image and where it is not `wanted`.
        """
        previous, self._previous = self._previous, (rgb, valid)
        if previous is None or not wanted:
            return None
        rgb_previous, valid_previous = previous
        flow = pair_flow(self._flow, rgb_previous, rgb, self._settings.advanced.consistency_px)
        # Masked pixels of either image show no tissue.
        seen = pull(valid_previous.astype(np.float32), flow.to_previous) > 0.5
        compared = pull(rgb_previous, flow.to_previous) if self._settings.paper.compare_warped else rgb_previous
        distance = self._perceptual.compare(compared, rgb)
        values = np.full_like(distance.map, distance.score) if self._settings.paper.perceptual_score else distance.map
        consistent = flow.consistent & seen & valid
        return DenseCorrespondence(flow.to_previous, consistent, values, float(valid.mean()))
