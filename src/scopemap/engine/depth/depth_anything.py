"""Depth Anything V2 (Yang et al., NeurIPS 2024) through `transformers`: relative disparity of a single image."""

from __future__ import annotations

import numpy as np

from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.pretrained import MM_PER_M, PretrainedNetwork, load_pretrained
from scopemap.engine.frame import Frame


class DepthAnything(PretrainedNetwork):
    """A Depth Anything network as a depth estimator: relative models give disparity, metric ones depth."""

    name = "depth-anything"

    @classmethod
    def from_folder_or_hub(cls, model: str = "", device: str = "auto") -> DepthAnything:
        """Return the estimator with weights `model` (folder, pulled hub id, "": pinned Small), or `WeightsError`."""
        network, processor, origin = load_pretrained("DepthAnythingForDepthEstimation", model, cls.name)
        return cls(network, processor, device=device, origin=origin)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return disparity >= 0 of the frame's size (metric models: depth, mm); every pixel has a value."""
        # Bicubic enlargement undershoots zero at strong edges.
        values = np.maximum(self._values(self._answer(frame.rgb), frame), 0.0)
        if self._network.config.depth_estimation_type == "metric":
            return DepthEstimate(values * MM_PER_M, "depth")
        return DepthEstimate(values, "disparity")
