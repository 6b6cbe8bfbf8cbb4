"""RAFT (Teed and Deng, ECCV 2020) in torchvision, with torchvision's weights or the authors' own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from scopemap.errors import WeightsError, check_shape
from scopemap.flow.estimator import FlowEstimator
from scopemap.io import weights
from scopemap.io.device import choose_device, need_packages

if TYPE_CHECKING:
    import torch

Size = Literal["small", "large"]
CHECKPOINTS: dict[Size, tuple[str, ...]] = {
    "small": ("raft-small", "raft-small-authors"),
    "large": ("raft-large", "raft-things"),
}
_STRIDE_PX = 8
_MIN_SIDE_PX = 128

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
        need_packages(f"the flow {self.name}", "torch", "torchvision")
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
        self._network = network.to(self._device).eval()

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px, of two (H, W, 3) uint8 images of one size."""
        return self._estimate([rgb_from], [rgb_to])[0]

    def estimate_both(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flows a to b and b to a, computed as one batch."""
        a_to_b, b_to_a = self._estimate([rgb_a, rgb_b], [rgb_b, rgb_a])
        return a_to_b, b_to_a

    def provenance(self) -> dict[str, str]:
        """Return the name, the refinement steps, and the weights' file and SHA-256."""
        return {
            "flow": self.name,
            "iterations": str(self.iterations),
            "weights": self._checkpoint.name,
            "sha256": weights.sha256_of(self._checkpoint),
        }

    def _estimate(self, rgb_from: list[np.ndarray], rgb_to: list[np.ndarray]) -> np.ndarray:
        import torch

        height, width = rgb_from[0].shape[:2]
        with torch.inference_mode():
            flows = self._network(self._tensor(rgb_from), self._tensor(rgb_to), num_flow_updates=self.iterations)
        return flows[-1][:, :, :height, :width].permute(0, 2, 3, 1).contiguous().cpu().numpy()

    def _tensor(self, images: list[np.ndarray]) -> torch.Tensor:
        """Return (B, 3, H', W') float32 in -1..1 with the right and lower border repeated up to a size RAFT takes."""
        import torch

        height, width = images[0].shape[:2]
        for image in images:
            check_shape("image for RAFT", image, (height, width, 3))
        padding = [(0, _padded(height) - height), (0, _padded(width) - width), (0, 0)]
        batch = np.stack([np.pad(image, padding, mode="edge") for image in images])
        return torch.from_numpy(batch).to(self._device).permute(0, 3, 1, 2).float() / 127.5 - 1.0


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


def _padded(side_px: int) -> int:
    return max(_MIN_SIDE_PX, -(-side_px // _STRIDE_PX) * _STRIDE_PX)
