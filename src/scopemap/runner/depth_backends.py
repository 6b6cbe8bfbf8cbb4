"""Creates the depth estimator and the metric anchor that the settings name; `NETWORKS` is the table of estimators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.engine.cameras.rectification import Rectifier, StereoPair
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.estimate import DepthEstimator
from scopemap.engine.depth.shading import ShadingDepth
from scopemap.engine.errors import CalibrationError, SettingsError

if TYPE_CHECKING:
    from scopemap.input.depth_files import FilesOfInput

_FILES = "files:"


@dataclass(frozen=True)
class _Asked:
    """What a run asks an estimator of one picture for: as the arguments of `create_depth`."""

    settings: DepthSettings
    device: str
    calibrated: bool
    averaged: bool


@dataclass(frozen=True)
class DepthNetwork:
    """An estimator of depth from one picture, a row of `NETWORKS`.

    create : returns it; networks take seconds to import, so they are imported here. has_weights : whether it needs
    files of weights, which `engine/models/checkpoints.toml` has by its name, and the packages of the extra `networks`.
    seconds, gigabytes : of one core for a picture of any size, and of memory; those of the others count as the run's.
    """

    create: Callable[[_Asked], DepthEstimator]
    has_weights: bool = False
    seconds: float = 0.0
    gigabytes: float = 0.0


def create_depth(
    settings: DepthSettings,
    rectifier: Rectifier,
    device: str,
    of_input: FilesOfInput | None = None,
    *,
    calibrated: bool = True,
    averaged: bool = False,
    pair: StereoPair | CalibrationError | None = None,
) -> DepthEstimator:
    """Return the estimator that `settings.backend` names: one of `NETWORKS`, stereo, files:FOLDER.

    rectifier : from the camera that depth files show the view of to the working camera.
    device : "auto", "cpu" or "cuda".
    of_input : what the input knows of depth files.
    calibrated : whether the frames' camera is known; False: ScopeNet gets no ray directions (wrong ones mislead it).
    averaged : whether ScopeNet may take three times as long, and err less.
    pair : the cameras of both views that the frames carry, or why they are not known; None where they carry one.

    Raises `SettingsError` for another name, `WeightsError` or `InputError` where weights or files are missing,
    `CalibrationError` where the cameras of both views are not known.
    """
    if (pair is None) != (settings.backend != "stereo"):
        found = f"{'one view' if pair is None else 'two views'} and depth.backend={settings.backend}"
        raise SettingsError(f"two views (--stereo use) and depth.backend=stereo go together, found {found}")
    if isinstance(pair, CalibrationError):
        raise pair
    if pair is not None:
        from scopemap.engine.depth.stereo import StereoDepth

        return StereoDepth(pair, rectifier.target)
    folder = files_folder(settings)
    if folder is not None:
        from scopemap.input.depth_files import FilesDepth

        return FilesDepth(folder, rectifier, settings, of_input)
    if (network := NETWORKS.get(settings.backend)) is None:
        raise SettingsError(f"unknown depth '{settings.backend}': choose {', '.join(NETWORKS)} or files:FOLDER")
    return network.create(_Asked(settings, device, calibrated, averaged))


def needs_weights(backend: str) -> bool:
    """Return whether depth of this name comes from a network that needs files of weights."""
    network = NETWORKS.get(backend)
    return network is not None and network.has_weights


def files_folder(settings: DepthSettings) -> Path | None:
    """Return the folder that depth files come from, None where depth comes from elsewhere."""
    return Path(settings.backend.removeprefix(_FILES)) if settings.backend.startswith(_FILES) else None


def create_anchor(settings: DepthSettings, device: str) -> AnchoredDepth:
    """Return the metric anchor of a sequence, with its reference estimator.

    Raises `SettingsError` where the range is missing or impossible, `WeightsError` where Depth Pro is chosen and
    its weights are missing.
    """
    if settings.anchor == "depth-pro" and settings.backend != "depth-pro":
        return AnchoredDepth(settings, _pretrained_depth_pro(settings.anchor_model, settings, device))
    return AnchoredDepth(settings, ShadingDepth(settings))


def _scopenet(asked: _Asked) -> DepthEstimator:
    from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth

    return ScopeNetDepth(
        asked.settings.model, rays_known=asked.calibrated, averaged=asked.averaged, device=asked.device
    )


def _depth_anything(asked: _Asked) -> DepthEstimator:
    from scopemap.engine.depth.depth_anything import DepthAnything

    return DepthAnything.from_folder_or_hub(asked.settings.model, asked.device)


def _depth_pro(asked: _Asked) -> DepthEstimator:
    return _pretrained_depth_pro(asked.settings.model, asked.settings, asked.device)


def _pretrained_depth_pro(model: str, settings: DepthSettings, device: str) -> DepthEstimator:
    from scopemap.engine.depth.depth_pro import DepthPro

    return DepthPro.from_folder_or_hub(model, device, use_known_focal=settings.depth_pro_focal == "camera")


NETWORKS: dict[str, DepthNetwork] = {
    "scopenet": DepthNetwork(_scopenet),
    "shading": DepthNetwork(lambda asked: ShadingDepth(asked.settings)),
    "depth-anything": DepthNetwork(_depth_anything, has_weights=True, seconds=2.2, gigabytes=0.4),
    # Estimated by the size of its weights.
    "depth-pro": DepthNetwork(_depth_pro, has_weights=True, seconds=200.0, gigabytes=6.0),
}
"""What `depth.backend` may name besides files and two views. Times and memory: measured at 400x320 to 1350x1080 px."""
