"""ScopeNet behind the `DepthEstimator` contract: the weights that come with the package, or others of the same network.

The network estimates ln of the distance along the ray and ln of the Laplace scale b of its
error. Depth is distance times the z of the unit ray. A Laplace distribution has the standard deviation sqrt(2) b; of a
logarithm it is, to first order, the relative one of distance, and so of depth.
"""

from __future__ import annotations

import math
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from scopemap.cameras.camera import PinholeCamera
from scopemap.depth.estimate import DepthEstimate
from scopemap.depth.scopenet.network import ScopeNet
from scopemap.depth.scopenet.planes import input_planes
from scopemap.errors import WeightsError
from scopemap.frame import Frame
from scopemap.io import weights
from scopemap.io.device import choose_device

WEIGHTS_NAME = "scopenet.safetensors"
_AS_THEY_COME = "that come with the package"


class ScopeNetDepth:
    """Depth estimator around a ScopeNet.

    network : is changed: its batch normalisation goes into its convolutions.
    device : "auto", "cpu" or "cuda".
    rays_known : whether the frames' camera is calibrated. False: the network gets no ray directions, as in
        part of its training; depth is still distance times the z of the assumed camera's ray.
    origin : where the weights came from, for the provenance.
    """

    name = "scopenet"

    def __init__(
        self, network: ScopeNet, *, device: str = "auto", rays_known: bool = True, origin: dict[str, str] | None = None
    ) -> None:
        self._device = choose_device(device)
        # At 320 x 256 this memory format halves the time on 2 cores; folding saves a quarter on one.
        self._network = folded(network.eval().to(self._device)).to(memory_format=torch.channels_last)
        self._rays_known = rays_known
        self._origin = origin or {}

    @classmethod
    def from_file(cls, model: str = "", device: str = "auto", *, rays_known: bool = True) -> ScopeNetDepth:
        """Return the estimator with the weights in `model`, a .safetensors file; "" = those of the package.

        Raises `WeightsError` where the file is missing, cannot be read, or does not fit the network.
        """
        with resources.as_file(resources.files(__package__) / WEIGHTS_NAME) as embedded:
            file = Path(model).expanduser() if model else embedded
            network = load_network(file)
            origin = {"model": model or _AS_THEY_COME, f"sha256 {file.name}": weights.sha256_of(file)}
        return cls(network, device=device, rays_known=rays_known, origin=origin)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return depth, mm, of the frame's size, with its standard deviation, mm; every pixel has both.

        The mask is an input plane; depth of masked pixels is extrapolated from their surroundings.
        """
        unit_rays = _unit_rays(frame.camera)
        planes = input_planes(frame.rgb, unit_rays if self._rays_known else None, frame.valid)
        with torch.inference_mode():
            log_distance, log_spread = self._network(self._batch(planes))[0].cpu().numpy()
        depth_mm = np.exp(log_distance) * unit_rays[..., 2]
        sigma_mm = depth_mm * np.float32(math.sqrt(2.0)) * np.exp(log_spread)
        return DepthEstimate(depth_mm, "depth", sigma=sigma_mm)

    def provenance(self) -> dict[str, str]:
        """Return the name, the weights with their hash, and whether the rays were given."""
        return {"depth": self.name, **self._origin, "rays": "known" if self._rays_known else "assumed"}

    def _batch(self, planes: np.ndarray) -> Tensor:
        return torch.from_numpy(planes)[None].to(self._device, memory_format=torch.channels_last)


def load_network(file: Path) -> ScopeNet:
    """Return the shipped architecture with the weights (float16 or float32) in a .safetensors file.

    Raises `WeightsError` where the file is missing, cannot be read, or does not fit the network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not file.is_file():
        raise WeightsError(_missing(file))
    try:
        state = load_file(file)
    except (OSError, SafetensorError) as error:
        raise WeightsError(f"cannot load ScopeNet from {file}: {error}. Name another file in depth.model") from error
    network = ScopeNet()
    amiss = _amiss(network.state_dict(), state)
    if amiss:
        raise WeightsError(f"the weights in {file} do not fit ScopeNet: {amiss}. Name another file in depth.model")
    network.load_state_dict(state, strict=False)
    return network


def folded(network: ScopeNet) -> ScopeNet:
    """Return the network, which must be in evaluation mode, with each batch normalisation folded into its convolution.

    Jacob et al., CVPR 2018, section 3.2: the same function, two passes over memory fewer per convolution.
    """
    for part in network.modules():
        if isinstance(part, nn.Sequential):
            for index in range(len(part) - 1):
                first, second = part[index], part[index + 1]
                if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                    part[index], part[index + 1] = fuse_conv_bn_eval(first, second), nn.Identity()
    return network


def _missing(file: Path) -> str:
    if file.name == WEIGHTS_NAME and file.parent == Path(__file__).parent:
        return (
            f"loading ScopeNet: this installation lacks {file}, which the package comes with; install it again, name a "
            ".safetensors file in depth.model, or choose depth.backend=shading"
        )
    return f"loading ScopeNet: depth.model names {file}, which is no file; it must be a .safetensors file"


def _amiss(wanted: dict[str, Tensor], found: dict[str, Tensor]) -> str:
    """Say how a state differs from what the network wants, "" if it fits; the counters of training are not needed."""
    needed = {name for name in wanted if not name.endswith("num_batches_tracked")}
    faults = {
        "missing": needed - set(found),
        "unknown": set(found) - set(wanted),
        "of another shape": {name for name in needed & set(found) if found[name].shape != wanted[name].shape},
        "not finite": {name for name in needed & set(found) if not torch.isfinite(found[name]).all()},
    }
    return "; ".join(f"{len(names)} {kind} ({min(names)} ...)" for kind, names in faults.items() if names)


@lru_cache(maxsize=2)
def _unit_rays(camera: PinholeCamera) -> np.ndarray:
    """Directions of the pixels' rays, (H, W, 3) float32, of length 1."""
    return camera.rays / np.linalg.norm(camera.rays, axis=-1, keepdims=True)
