"""RAFT (Teed and Deng, ECCV 2020) in torchvision, with torchvision's weights or the authors' own."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from scopemap.engine.errors import WeightsError, check_shape
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.models import weights
from scopemap.engine.models.device import choose_device, need_packages

if TYPE_CHECKING:
    import torch

Size = Literal["small", "large"]
CHECKPOINTS: dict[Size, tuple[str, ...]] = {
    "small": ("raft-small", "raft-small-authors"),
    "large": ("raft-large", "raft-things"),
}
PACKAGES = ("torch", "torchvision")
_STRIDE_PX = 8  # RAFT's: both sides are multiples (Teed and Deng 2020)
_MIN_SIDE_PX = 128  # guard: its pyramid of four levels needs so many px

# The authors' names to torchvision's, applied one after the other.
_RENAMES = (
    (r"^module\.", ""),
    (r"^fnet\.", "feature_encoder."),
    (r"^cnet\.", "context_encoder."),
    (r"(_encoder)\.conv1\.", r"\1.convnormrelu.0."),
    (r"(_encoder)\.norm1\.", r"\1.convnormrelu.1."),
    (r"(_encoder)\.conv2\.", r"\1.conv."),
    # norm3 of a residual block is its down-sampling norm under a second name; bottleneck blocks have no norm weights.
    (r"(layer\d\.\d)\.norm3\.", r"\1.downsample.1."),
    (r"(layer\d\.\d)\.conv(\d)\.", r"\1.convnormrelu\2.0."),
    (r"(layer\d\.\d)\.norm(\d)\.", r"\1.convnormrelu\2.1."),
    (r"^update_block\.encoder\.convc(\d)\.", r"update_block.motion_encoder.convcorr\1.0."),
    (r"^update_block\.encoder\.convf(\d)\.", r"update_block.motion_encoder.convflow\1.0."),
    (r"^update_block\.encoder\.conv\.", "update_block.motion_encoder.conv.0."),
    (r"^update_block\.gru\.conv([zrq])(\d)\.", r"update_block.recurrent_block.convgru\2.conv\1."),
    (r"^update_block\.gru\.conv([zrq])\.", r"update_block.recurrent_block.convgru1.conv\1."),
    (r"^update_block\.mask\.0\.", "mask_predictor.convrelu.0."),
    (r"^update_block\.mask\.2\.", "mask_predictor.conv."),
)


class RaftFlow(FlowEstimator):
    """torchvision's RAFT, small or large.

    Parameters: `iterations` refinement steps; `checkpoint` a file of weights (default: the first of `CHECKPOINTS[size]`
    that is there). Raises `WeightsError` if there is none or if it does not fit the network exactly.
    """

    def __init__(
        self, size: Size = "small", *, iterations: int = 12, device: str = "auto", checkpoint: Path | None = None
    ) -> None:
        self.name = f"raft-{size}"
        need_packages(f"the flow {self.name}", *PACKAGES)
        import torch
        from torchvision.models import optical_flow

        self.iterations = iterations
        self._checkpoint = checkpoint or weights.locate(*CHECKPOINTS[size])
        self._device = choose_device(device)
        network = optical_flow.raft_small() if size == "small" else optical_flow.raft_large()
        try:
            network.load_state_dict(
                torchvision_names(torch.load(self._checkpoint, map_location="cpu", weights_only=True))
            )
        except RuntimeError as error:
            raise WeightsError(f"{self._checkpoint} does not hold the weights of {self.name}: {error}") from None
        # The correlation volume has H^2 W^2 / 1024 floats, 2 GB at 1350x1080 px, and torchvision's own has a copy.
        network.corr_block._compute_corr_volume = _correlations
        self._network = network.to(self._device).eval()

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px, of two (H, W, 3) uint8 images of one size."""
        import torch

        height, width = rgb_from.shape[:2]
        check_shape("rgb_to", rgb_to, rgb_from.shape)
        with torch.inference_mode():
            flows = self._network(self._tensor(rgb_from), self._tensor(rgb_to), num_flow_updates=self.iterations)
        self._network.corr_block.corr_pyramid = []  # held until the next pair else
        return flows[-1][0, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()

    def provenance(self) -> dict[str, str]:
        """Return the name, the refinement steps, and the weights' file and SHA-256."""
        return {
            "flow": self.name,
            "iterations": str(self.iterations),
            "weights": self._checkpoint.name,
            "sha256": weights.sha256_of(self._checkpoint),
        }

    def _tensor(self, rgb: np.ndarray) -> torch.Tensor:
        """Return (1, 3, H', W') float32 in -1..1 with the right and lower border repeated up to a size RAFT takes."""
        import torch

        check_shape("image for RAFT", rgb, (None, None, 3))
        padding = [*((0, _padded(side) - side) for side in rgb.shape[:2]), (0, 0)]
        padded = torch.from_numpy(np.pad(rgb, padding, mode="edge")[None])
        return padded.to(self._device).permute(0, 3, 1, 2).float() / 127.5 - 1.0


def torchvision_names(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return RAFT's parameters under torchvision's names; `WeightsError` if two norms of the authors' differ."""
    import torch

    renamed: dict[str, torch.Tensor] = {}
    authors = any(re.match(r"(module\.)?fnet\.", name) for name in state)
    for name, tensor in state.items():
        new = name
        for pattern, replacement in _RENAMES if authors else ():
            new = re.sub(pattern, replacement, new)
        if new in renamed and not torch.equal(renamed[new], tensor):
            raise WeightsError(f"RAFT checkpoint: '{name}' and another name of '{new}' hold different values")
        renamed[new] = tensor
    return renamed


def _correlations(features_from: torch.Tensor, features_to: torch.Tensor) -> torch.Tensor:
    """Return the correlation of all pairs of pixels, (B, H, W, 1, H, W), of features (B, C, H, W), over sqrt(C)."""
    import torch

    count, channels, height, width = features_from.shape
    scaled = features_from.flatten(2).transpose(1, 2) / math.sqrt(channels)
    return torch.matmul(scaled, features_to.flatten(2)).view(count, height, width, 1, height, width)


def _padded(side_px: int) -> int:
    return max(_MIN_SIDE_PX, -(-side_px // _STRIDE_PX) * _STRIDE_PX)
