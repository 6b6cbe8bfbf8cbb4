"""The table of depth estimators. Nothing is loaded of one that is not created: the help of commands reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scopemap.engine.config import DepthSettings
    from scopemap.engine.depth.estimate import DepthEstimator


@dataclass(frozen=True)
class DepthRequest:
    """What a run asks an estimator of one picture for: as the arguments of `create_depth`."""

    settings: DepthSettings
    device: str
    calibrated: bool
    averaged: bool


@dataclass(frozen=True)
class DepthNetwork:
    """An estimator of depth from one picture, a row of `NETWORKS`.

    create : returns it; imports it. words : about it, in the help of `--depth`. has_weights : whether it needs files of
    weights, which `engine/models/checkpoints.toml` has by its name, and all packages of the extra `networks`. seconds,
    gigabytes : of one core for a picture of any size, and of memory. A run is told of those of networks with weights;
    `scopemap bench --dry-run` counts them all.
    """

    create: Callable[[DepthRequest], DepthEstimator]
    words: str = ""
    has_weights: bool = False
    seconds: float = 0.0
    gigabytes: float = 0.0


def needs_weights(backend: str) -> bool:
    """Return whether depth of this name comes from a network that needs files of weights."""
    network = NETWORKS.get(backend)
    return network is not None and network.has_weights


def networks_in_words() -> str:
    """Return the names of the estimators, with what there is to say of them."""
    return ", ".join(f"{name} ({one.words})" if one.words else name for name, one in NETWORKS.items())


def pretrained_depth_pro(model: str, settings: DepthSettings, device: str) -> DepthEstimator:
    """Return Depth Pro, `model` : hub id or folder, "": the default; raises `WeightsError` without its weights."""
    from scopemap.engine.depth.depth_pro import DepthPro

    return DepthPro.from_folder_or_hub(model, device, use_known_focal=settings.depth_pro_focal == "camera")


def _scopenet(request: DepthRequest) -> DepthEstimator:
    from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth

    model, device = request.settings.model, request.device
    return ScopeNetDepth(model, rays_known=request.calibrated, averaged=request.averaged, device=device)


def _shading(request: DepthRequest) -> DepthEstimator:
    from scopemap.engine.depth.shading import ShadingDepth

    return ShadingDepth(request.settings)


def _depth_anything(request: DepthRequest) -> DepthEstimator:
    from scopemap.engine.depth.depth_anything import DepthAnything

    return DepthAnything.from_folder_or_hub(request.settings.model, request.device)


def _depth_pro(request: DepthRequest) -> DepthEstimator:
    return pretrained_depth_pro(request.settings.model, request.settings, request.device)


NETWORKS = {
    "scopenet": DepthNetwork(_scopenet, "default", seconds=0.1),
    "shading": DepthNetwork(_shading),
    "depth-anything": DepthNetwork(_depth_anything, has_weights=True, seconds=2.2, gigabytes=0.4),
    # Estimated by the size of its weights.
    "depth-pro": DepthNetwork(_depth_pro, has_weights=True, seconds=200.0, gigabytes=6.0),
}
"""What `depth.backend` may name besides files and two views. Times and memory: measured at 400x320 to 1350x1080 px."""
