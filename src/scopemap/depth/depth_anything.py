"""Depth Anything V2 (Yang et al., NeurIPS 2024) through `transformers`: relative disparity of a single image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from scopemap.depth.estimate import DepthEstimate
from scopemap.depth.pretrained import load_pretrained
from scopemap.frame import Frame
from scopemap.io.device import choose_device, need_packages

if TYPE_CHECKING:
    from transformers import DepthAnythingForDepthEstimation, DPTImageProcessor

MM_PER_M = 1000.0


class DepthAnything:
    """A Depth Anything network and its image processor behind the `DepthEstimator` contract.

    The relative models give disparity; the metric ones, which go by the same class, give depth.
    """

    name = "depth-anything"

    def __init__(
        self,
        network: DepthAnythingForDepthEstimation,
        processor: DPTImageProcessor,
        *,
        device: str = "auto",
        origin: dict[str, str] | None = None,
    ) -> None:
        self._device = choose_device(device)
        untyped: Any = network
        self._network = untyped.to(self._device).eval()
        self._processor: Any = processor
        self._origin = origin or {}
        self._metric = network.config.depth_estimation_type == "metric"

    @classmethod
    def from_folder_or_hub(cls, model: str = "", device: str = "auto") -> DepthAnything:
        """Return the estimator with the weights `model`: a local folder, a pulled hub id, or "" = the pinned Small.

        Never downloads. Raises `WeightsError` with the name to pull.
        """
        need_packages(f"depth by {cls.name}", "torch", "torchvision", "transformers", "safetensors")
        from transformers import DepthAnythingForDepthEstimation

        network, processor, origin = load_pretrained(DepthAnythingForDepthEstimation, model or cls.name)
        return cls(network, processor, device=device, origin=origin)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return disparity >= 0 of the frame's size (metric models: depth, mm); every pixel has a value."""
        import torch

        inputs = self._processor(images=frame.rgb, input_data_format="channels_last", return_tensors="pt")
        with torch.inference_mode():
            outputs = self._network(inputs["pixel_values"].to(self._device))
        size = (frame.camera.height, frame.camera.width)
        result = self._processor.post_process_depth_estimation(outputs, target_sizes=[size])[0]
        # Bicubic enlargement undershoots zero at strong edges.
        values = np.maximum(result["predicted_depth"].float().cpu().numpy(), 0.0)
        return DepthEstimate(values * MM_PER_M, "depth") if self._metric else DepthEstimate(values, "disparity")

    def provenance(self) -> dict[str, str]:
        """Return the name, the model, its commit if it was pulled, and the hashes of its weights."""
        return {"depth": self.name, **self._origin}
