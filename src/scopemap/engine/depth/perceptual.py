"""Perceptual distance between two images: LPIPS with AlexNet (Zhang et al., CVPR 2018), or structural similarity."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.depth.estimate import PerceptualDistance, PerceptualResult
from scopemap.engine.errors import SettingsError, WeightsError, check_shape
from scopemap.engine.geometry.similarity import structural_similarity
from scopemap.engine.models import weights
from scopemap.engine.models.device import choose_device, need_packages

CHECKPOINTS = ("alexnet", "alexnet-features")
PACKAGES = ("torch", "torchvision", "lpips")

# lpips cuts torchvision's features at the ReLUs; each slice keeps the number a layer had among the features.
_SLICE_OF_LAYER = {"0": "slice1", "3": "slice2", "6": "slice3", "8": "slice4", "10": "slice5"}


def create_perceptual(name: str, device: str = "auto") -> PerceptualDistance:
    """Return the distance "lpips" or "structure"; raises `SettingsError`, and `WeightsError` for missing weights."""
    match name:
        case "lpips":
            return LpipsAlex(device=device)
        case "structure":
            return StructureDistance()
    raise SettingsError(f"unknown perceptual distance '{name}': choose one of lpips, structure")


class StructureDistance:
    """One minus the structural similarity of the grey values in 7 x 7 px, clipped to 0..1."""

    name = "structure"

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        """Compare two (H, W, 3) uint8 images of one size, 7 px or more on each side."""
        check_shape("rgb_a", rgb_a, (None, None, 3))
        check_shape("rgb_b", rgb_b, rgb_a.shape)
        grey_a, grey_b = (cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (rgb_a, rgb_b))
        distance = np.clip(1.0 - structural_similarity(grey_a, grey_b), 0.0, 1.0).astype(np.float32)
        return PerceptualResult(distance, float(distance.mean(dtype=np.float64)))

    def provenance(self) -> dict[str, str]:
        """Return the name."""
        return {"perceptual": self.name}


class LpipsAlex:
    """LPIPS(AlexNet), version 0.1, per pixel (equation 3 of arXiv 2508.11282).

    checkpoint : a file with torchvision's names, or `WeightsError`.
    """

    name = "lpips"

    def __init__(self, *, device: str = "auto", checkpoint: Path | None = None) -> None:
        need_packages("LPIPS", *PACKAGES)
        import lpips
        import torch

        self._checkpoint = checkpoint or weights.locate(*CHECKPOINTS)
        self._device = choose_device(device)
        with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
            # lpips calls torchvision by an argument that torchvision has renamed, and draws weights we replace.
            warnings.simplefilter("ignore", UserWarning)
            network = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)
        state = torch.load(self._checkpoint, map_location="cpu", weights_only=True)
        try:
            network.net.load_state_dict(
                {_slice_name(n): t for n, t in state.items() if re.match(r"features\.\d+\.", n)}
            )
        except RuntimeError as error:
            raise WeightsError(f"{self._checkpoint} does not hold AlexNet's convolutions: {error}") from None
        self._network = network.to(self._device).eval()

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        """Compare two (H, W, 3) uint8 images of one size, 32 px or more on each side; the score is the map's mean."""
        import torch

        check_shape("rgb_a", rgb_a, (None, None, 3))
        check_shape("rgb_b", rgb_b, rgb_a.shape)
        images = torch.from_numpy(np.stack([rgb_a, rgb_b])).to(self._device)
        images = images.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        with torch.inference_mode():
            distance = self._network(images[:1], images[1:])[0, 0].cpu().numpy()
        return PerceptualResult(distance, float(distance.mean(dtype=np.float64)))

    def provenance(self) -> dict[str, str]:
        """Return the name, and the backbone's file and SHA-256."""
        return {
            "perceptual": self.name,
            "weights": self._checkpoint.name,
            "sha256": weights.sha256_of(self._checkpoint),
        }


def _slice_name(name: str) -> str:
    """Return the name of `features.N.weight` among lpips' slices."""
    layer = name.split(".")[1]
    return name.replace("features", _SLICE_OF_LAYER.get(layer, "unknown"), 1)
