"""What comes before the first frame of a run: kernels, estimators, an unknown focal length, kind of depth files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from scopemap.engine.config import Config
from scopemap.engine.depth.estimate import DepthEstimator
from scopemap.engine.estimators import Estimators
from scopemap.engine.frame import is_constant
from scopemap.engine.geometry.kernels import IS_CACHED, compiled_mark
from scopemap.engine.notices import Notice
from scopemap.input.sequence import Sequence
from scopemap.runner.depth_backends import files_folder
from scopemap.runner.estimators import CustomEstimators, create_estimators
from scopemap.runner.observers import Progress

Timed = Callable[..., Any]
"""Takes the name of a part, a function and its arguments; returns what the function returns."""


def prepare(
    sequence: Sequence, config: Config, timed: Timed, progress: Progress, own: CustomEstimators | None = None
) -> tuple[Sequence, Config, Estimators, list[Notice]]:
    """Return a sequence with a focal length, resolved settings, the estimators, and notices of what was estimated."""
    compile_once(timed, progress)
    progress("preparing", 0, 0)
    estimators = timed("prepare", create_estimators, config, sequence, own)
    if not (sequence.calibrated or sequence.is_estimated):
        progress("estimating the focal length", 0, 0)
    sequence, notices = _with_estimated_focal(sequence, config, estimators, timed)
    if files_folder(config.depth) is not None:
        # Runs without depth files do not import what judges them.
        from scopemap.runner.own_depth import with_files_judged

        progress("examining the depth files", 0, 0)
        config, estimators, of_files = timed("prepare", with_files_judged, sequence, config, estimators)
        notices = [*notices, *of_files]
    return sequence, config, estimators, notices


def compile_once(timed: Timed, progress: Progress) -> None:
    """Compile all kernels where that has not been done on this machine; before processes that would all do it, too."""
    if IS_CACHED and not compiled_mark().exists():
        from scopemap.runner.kernels import compile_kernels

        progress("compiling kernels, once", 0, 0)
        timed("compile kernels", compile_kernels)


def _with_estimated_focal(
    sequence: Sequence, config: Config, estimators: Estimators, timed: Timed
) -> tuple[Sequence, list[Notice]]:
    """Give an unknown camera the focal length by `input.focal`, with notices of the estimation."""
    is_stated = config.input.focal == "auto" and sequence.focal_is_stated
    if sequence.calibrated or is_stated or sequence.is_estimated or config.input.focal == "assume":
        return sequence, []
    network = next((part for part in (estimators.depth, estimators.anchor.reference) if part.name == "depth-pro"), None)
    if config.input.focal == "auto" and network is not None:
        return _with_networks_focal(sequence, network), []
    from scopemap.input.focal_length.from_motion import with_focal_from_motion

    estimated: tuple[Sequence, list[Notice]] = timed("focal length", with_focal_from_motion, sequence, config)
    return estimated


def _with_networks_focal(sequence: Sequence, network: DepthEstimator) -> Sequence:
    """Take the focal length from Depth Pro's view of the first lit frame: it is in use anyway."""
    first = next((frame for frame in sequence.frames() if not is_constant(frame.rgb)), None)
    focal_px = None if first is None else network.estimate(first).focal_px
    if first is None or focal_px is None:
        return sequence
    return sequence.with_focal(focal_px, f"estimated: Depth Pro on frame {first.index}")
