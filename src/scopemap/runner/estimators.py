"""Creates the estimators that the settings name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.engine.config import PRESETS, Config
from scopemap.engine.depth import perceptual
from scopemap.engine.depth.anchor import max_depth_mm
from scopemap.engine.depth.estimate import DepthEstimator
from scopemap.engine.errors import WeightsError
from scopemap.engine.estimators import Estimators
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.flow.flows import FLOWS, create_flow
from scopemap.engine.mapping.bundle_problem import TRACKED
from scopemap.engine.mapping.depth_correction import MAX_LOG_FACTOR
from scopemap.engine.models import device, weights
from scopemap.engine.tracking.alike import AlikeFeatures
from scopemap.engine.tracking.features import SiftFeatures
from scopemap.input.mask_files import masks_of
from scopemap.input.sequence import Sequence
from scopemap.runner.depth_backends import create_anchor, create_depth, files_folder
from scopemap.runner.depth_networks import needs_weights

if TYPE_CHECKING:
    from scopemap.input.depth_files import FilesOfInput


@dataclass(frozen=True)
class CustomEstimators:
    """Estimators of the caller in place of those that the settings name; None: by the settings."""

    depth: DepthEstimator | None = None
    flow: FlowEstimator | None = None


def create_estimators(config: Config, sequence: Sequence, own: CustomEstimators | None = None) -> Estimators:
    """Return the estimators; raises `WeightsError`, `InputError` or `SettingsError` as their factories do.

    own : replace those of the settings; a flow must then be safe in several threads.
    """
    own = own or CustomEstimators()
    if own == CustomEstimators():
        _need_weights(config)
    networks, folder = config.networks, files_folder(config.depth)
    in_input = folder is not None and folder.resolve() == sequence.path.resolve()
    depth = own.depth or create_depth(
        config.depth,
        sequence.depth_rectifier if in_input else sequence.rectifier,
        networks.device,
        None if folder is None else _files_of(sequence),
        calibrated=sequence.calibrated,
        averaged=bool(config.tracking.camera_at_rest),  # no parallax corrects its shape
        pair=sequence.pair,
    )
    corner_flow = own.flow or create_flow(networks.keyframe_flow, networks.device)
    tracker = None
    if config.tracking.camera_at_rest:
        from scopemap.engine.tracking.at_rest import CameraAtRest

        tracker = partial(CameraAtRest, config.tracking, corner_flow)
    return Estimators(
        depth,
        create_anchor(config.depth, networks.device),
        own.flow or create_flow(networks.flow, networks.device),
        corner_flow,
        own.flow or create_flow(networks.keyframe_flow, networks.device),
        perceptual.create_perceptual(networks.perceptual, networks.device),
        masks_of(config.mask, sequence),
        AlikeFeatures(networks.device) if networks.features == "alike" else SiftFeatures(),
        tracker,
    )


def _need_weights(config: Config) -> None:
    """Raise `WeightsError` where several weights are missing, or those of an anchor that only the preset asks for."""
    lacking, preset = missing_weights(config), PRESETS[config.preset]
    anchor, backend = config.depth.anchor, config.depth.backend
    # With another depth than its own the preset's anchor is easily overlooked.
    of_preset = anchor == "depth-pro" == preset.get("depth.anchor") and backend != preset["depth.backend"]
    replaceable = of_preset and backend != "depth-pro" and (config.depth.anchor_model or "depth-pro") in lacking
    if len(lacking) < 2 and not replaceable:
        return
    pulls = " && ".join(f"scopemap models pull {name}" for name in lacking)
    fault = f"weights are missing: {pulls}; `scopemap models list` says where they are looked for"
    advice = f"; --set depth.anchor=auto does without depth-pro, the metric anchor of the preset {config.preset}"
    raise WeightsError(fault + advice if replaceable else fault)


def _files_of(sequence: Sequence) -> FilesOfInput:
    from scopemap.input.depth_files import FilesOfInput

    return FilesOfInput(sequence.depth_scale_mm, sequence.source.picture_files(), sequence.numbers or ())


def missing_weights(config: Config, *other_flows: str, verified: bool = False) -> list[str]:
    """Return the names of the weights that the settings need and this machine does not have; nothing is loaded.

    other_flows : names of flows that are needed besides. verified : also "NAME (damaged)" where a hash is wrong.
    """
    needed = [names for _, names in _networks(config, other_flows) if names]
    if verified:
        return [fault for names in needed if (fault := weights.fault(*names))]
    return [names[0] for names in needed if not weights.is_present(*names)]


def missing_packages(config: Config, *other_flows: str) -> str:
    """Return "needs PACKAGES: COMMAND" for the packages that networks need and this machine does not have, or "".

    other_flows : names of flows that are needed besides.
    """
    packages = dict.fromkeys(package for of_network, _ in _networks(config, other_flows) for package in of_network)
    return device.missing_packages("", *packages)


def _networks(config: Config, other_flows: tuple[str, ...]) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Return the packages of each network that the settings need, and its weights, of which any will do.

    No weights are named where the settings name their folder.
    """
    depth, networks = config.depth, config.networks
    models = {depth.backend: depth.model} if needs_weights(depth.backend) else {}
    if depth.anchor == "depth-pro":
        models.setdefault("depth-pro", depth.anchor_model)
    needed: list[tuple[tuple[str, ...], tuple[str, ...]]] = []
    if models:
        from scopemap.engine.depth.pretrained import PACKAGES

        named = {name: () if model and Path(model).is_dir() else (model or name,) for name, model in models.items()}
        needed += [(PACKAGES, names) for names in named.values()]
    flows = {networks.flow, networks.keyframe_flow, *other_flows}
    needed += [flow.needs() for name, flow in FLOWS.items() if name in flows and flow.needs is not None]
    if networks.perceptual == "lpips":
        needed.append((perceptual.PACKAGES, perceptual.CHECKPOINTS))
    return needed


def largest_depth_mm(config: Config, estimators: Estimators) -> float:
    """Return the largest depth that a result can hold, mm: of measured depth its own, else that of the settings.

    A back end may scale predicted depth; three standard deviations of that are included.
    """
    measured_max_mm: float | None = getattr(estimators.depth, "measured_max_mm", None)
    if measured_max_mm:
        return measured_max_mm
    mapping, log_factor = config.mapping, 0.0
    if mapping.adjusts:
        log_factor = 3 * TRACKED.scale + (MAX_LOG_FACTOR if mapping.depth_step_sigma > 0 else 0.0)
    return math.exp(log_factor) * max_depth_mm(config.depth)
