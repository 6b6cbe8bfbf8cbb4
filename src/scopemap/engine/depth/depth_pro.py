"""Depth Pro (Bochkovskii et al., ICLR 2025) through `transformers`: metric depth and focal length of a single image."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.pretrained import MM_PER_M, PretrainedNetwork, load_pretrained
from scopemap.engine.errors import WeightsError
from scopemap.engine.frame import Frame

if TYPE_CHECKING:
    import torch
    from transformers import DepthProForDepthEstimation, DepthProImageProcessor


class DepthPro(PretrainedNetwork):
    """A Depth Pro network: depth is f / (W c), c canonical inverse depth, f and W in px (paper, section 3.2).

    `use_known_focal` takes f from the frame's camera, False from the network.
    """

    name = "depth-pro"

    def __init__(
        self,
        network: DepthProForDepthEstimation,
        processor: DepthProImageProcessor,
        *,
        device: str = "auto",
        use_known_focal: bool = True,
        origin: dict[str, str] | None = None,
    ) -> None:
        if not (use_known_focal or network.config.use_fov_model):
            raise WeightsError(
                "this Depth Pro model finds no focal length: name another, or leave depth.method=network-focal out"
            )
        super().__init__(network, processor, device=device, origin=origin)
        self.use_known_focal = use_known_focal
        self._last: tuple[np.ndarray, Any, torch.Tensor | None] | None = None

    @classmethod
    def from_folder_or_hub(cls, model: str = "", device: str = "auto", *, use_known_focal: bool = True) -> DepthPro:
        """Return the estimator with weights `model` (folder, pulled hub id, "": Apple's own), or `WeightsError`."""
        network, processor, origin = load_pretrained("DepthProForDepthEstimation", model, cls.name)
        return cls(network, processor, device=device, use_known_focal=use_known_focal, origin=origin)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return depth, mm, of the frame's size, and the focal length that the network found (None if it cannot).

        Every pixel has a value; what the network holds for infinitely far is 1e7 mm. The image estimated last is not
        passed through the network again: a run reads the focal length of frame 1 first, and its depth afterwards.
        """
        import torch

        if self._last is None or not np.array_equal(self._last[0], frame.rgb):
            outputs = self._answer(frame.rgb)
            self._last = frame.rgb.copy(), outputs, outputs.field_of_view
        _, outputs, found_deg = self._last
        outputs.field_of_view = found_deg
        width = frame.camera.width
        if self.use_known_focal:
            known_deg = 2.0 * math.degrees(math.atan(0.5 * width / frame.camera.fx))
            outputs.field_of_view = torch.tensor([known_deg], device=self._device)
        focal_px = None if found_deg is None else 0.5 * width / math.tan(0.5 * math.radians(float(found_deg)))
        return DepthEstimate(self._values(outputs, frame) * MM_PER_M, "depth", focal_px)

    def release(self) -> None:
        """Free the memory of the network and of its last answer; nothing can be estimated any more."""
        super().release()
        self._last = None

    def provenance(self) -> dict[str, str]:
        """Return the name, whose focal length scaled the depth, the model, its commit and its weights' hashes."""
        return {"depth": self.name, "focal": "camera" if self.use_known_focal else "network", **self._origin}
