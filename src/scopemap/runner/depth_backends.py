"""Creates the depth estimator and the metric anchor that the settings name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.engine.cameras.rectification import Rectifier, StereoPair
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.estimate import DepthEstimator
from scopemap.engine.depth.shading import ShadingDepth
from scopemap.engine.errors import CalibrationError, SettingsError
from scopemap.runner.depth_networks import NETWORKS, DepthRequest, pretrained_depth_pro

if TYPE_CHECKING:
    from scopemap.input.depth_files import FilesOfInput

_FILES = "files:"


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
    return network.create(DepthRequest(settings, device, calibrated, averaged))


def files_folder(settings: DepthSettings) -> Path | None:
    """Return the folder that depth files come from, None where depth comes from elsewhere."""
    return Path(settings.backend.removeprefix(_FILES)) if settings.backend.startswith(_FILES) else None


def create_anchor(settings: DepthSettings, device: str) -> AnchoredDepth:
    """Return the metric anchor of a sequence, with its reference estimator.

    Raises `SettingsError` where the range is missing or impossible, `WeightsError` where Depth Pro is chosen and
    its weights are missing.
    """
    if settings.anchor == "depth-pro" and settings.backend != "depth-pro":
        return AnchoredDepth(settings, pretrained_depth_pro(settings.anchor_model, settings, device))
    return AnchoredDepth(settings, ShadingDepth(settings))
