"""Runs the story over a sequence: looks ahead, keeps the clock, tells observers, collects what is needed to trust it.

While frame i is tracked and fused in this thread, frame i+1 is read and goes through the networks in another.
"""

from __future__ import annotations

import math
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.calibration.focal_length import with_focal_from_motion
from scopemap.config import Config, FusionSettings
from scopemap.depth.estimate import DepthEstimator
from scopemap.depth.power_law import fit_exponent
from scopemap.errors import InputError
from scopemap.io.sequence import Sequence
from scopemap.io.video_format.redundant_frames import is_constant
from scopemap.mapping import LARGEST_LOG_FACTOR, Submap
from scopemap.pipeline import Estimators, Fused, Percept, Pipeline, Step
from scopemap.reconstruction import DepthWriter, FrameRecord, Reconstruction, corrected, only_maps, prepare_folder
from scopemap.tracking import FrameTracker

Observer = Callable[[Step], None]
_VERSIONS = (
    *("scopemap", "numpy", "scipy", "opencv-python-headless", "numba", "torch", "torchvision", "transformers", "lpips"),
)


def reconstruct(
    sequence: Sequence,
    config: Config | None = None,
    *,
    out: Path | str | None = None,
    overwrite: bool = False,
    observers: tuple[Observer, ...] = (),
    tracker: FrameTracker | None = None,
) -> Reconstruction:
    """Turn a sequence into poses, depth and a surface.

    Parameters
    ----------
    sequence : what `open_sequence` gave.
    config : settings, by default the preset `default`.
    out : folder for the result; None keeps it in memory, without depth maps.
    overwrite : replace an earlier run there.
    observers : called with each `Step` as it is done, its pose and depth as tracked: a back end has not spoken yet.
    tracker : odometry that takes the place of ours; None: as `config.tracking` says. Its keyframes are adjusted, too,
        unless `config.mapping.method` is "none".

    The settings in the result are the resolved ones: a `depth.exponent` that was to be fitted is a number there, and so
    is the size of the voxels.
    Where maps could not be joined, what has most frames is the result, and `others` are beside it.
    Raises `InputError` where no frame could be used, and whatever the chosen estimators raise for missing weights.
    """
    config, clock = config or Config(), _Clock()
    estimators = Estimators.create(config, sequence)
    writer = None
    if out is not None:
        _refuse_own_input(Path(out), sequence, config)
        prepare_folder(Path(out), overwrite=overwrite)
        writer = DepthWriter(Path(out), _most_depth_mm(config, estimators))
        observers = (writer, *observers)
    sequence, camera_note = _with_best_camera(sequence, config, estimators, clock)
    config, exponent_note = _with_exponent(sequence, config, estimators, clock)
    if exponent_note:
        # Some estimators remember the first frame that they saw, and the anchor holds the settings.
        estimators = Estimators.create(config, sequence)
    distances = _Distances()
    observers = (distances, *observers)
    pipeline = Pipeline(config, estimators, tracker)
    records = [_observed(step, observers) for step in _steps(sequence, pipeline, clock)]
    if all(record.track.status == "lost" for record in records):
        raise InputError(f"no frame of {sequence.path} could be used: {records[0].track.reason} (black or constant?)")
    submaps, warnings = clock.timed("back end", pipeline.submaps)
    tracked = _Tracked(sequence, config, pipeline, clock, records, camera_note + exponent_note, distances, writer)
    results = [tracked.result(submap) for submap in submaps]
    results[0].provenance["warnings"] += warnings
    result = replace(results[0], others=results[1:])
    if out is not None:
        result.save(Path(out))
    return result


class _Clock:
    """Seconds spent per part; parts in different threads overlap."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of the parts so far, and of all."""
        return self._seconds | {"total": time.perf_counter() - self._started}

    def timed(self, part: str, call: Callable[..., Any], *arguments: Any) -> Any:
        started = time.perf_counter()
        try:
            return call(*arguments)
        finally:
            self._seconds[part] = self._seconds.get(part, 0.0) + time.perf_counter() - started


class _Distances:
    """Observer that keeps how far the scene lies: what is too far to be fused must not go missing unsaid."""

    def __init__(self) -> None:
        self._medians_mm: list[float] = []

    def __call__(self, step: Step) -> None:
        """Note the median depth of a frame."""
        some_mm = step.refined.depth_mm[::4, ::4]
        if np.isfinite(some_mm).any():
            self._medians_mm.append(float(np.nanmedian(some_mm)))

    def warnings(self, settings: FusionSettings) -> list[str]:
        """Return what there is to say of all frames so far."""
        if not settings.enabled or not self._medians_mm or settings.max_depth_mm is None:
            return []
        median_mm = float(np.median(self._medians_mm))
        if median_mm <= settings.max_depth_mm:
            return []
        return [
            f"most of the scene is not fused: its median depth is {median_mm:.0f} mm, fusion.max_depth_mm "
            f"{settings.max_depth_mm:g}; raise fusion.max_depth_mm and fusion.voxel_mm"
        ]


@dataclass(frozen=True)
class _Tracked:
    """All that there is of a run once the last frame is tracked."""

    sequence: Sequence
    config: Config
    pipeline: Pipeline
    clock: _Clock
    records: list[FrameRecord]
    notes: list[str]
    distances: _Distances
    writer: DepthWriter | None

    def result(self, submap: Submap) -> Reconstruction:
        """Correct and fuse one submap; its depth is written anew."""
        sequence, clock, correction = self.sequence, self.clock, submap.correction
        records = only_maps(self.records, submap.maps)
        if correction is not None:
            records = corrected(records, correction)
            if self.writer is not None:
                clock.timed("depth corrected", self.writer.correct, records, correction)
        fused: Fused = clock.timed("fuse", self.pipeline.fuse, submap)
        config = self.config.model_copy(update={"fusion": fused.settings})
        estimators = self.pipeline.estimators
        provenance = _provenance(sequence, estimators, clock, records)
        provenance["notes"] += self.notes + ([] if correction is None else [correction.description]) + fused.note
        provenance["warnings"] += [] if estimators.masks is None else estimators.masks.warnings
        provenance["warnings"] += self.distances.warnings(config.fusion)
        source_camera, sigma_px = sequence.rectifier.source, sequence.focal_sigma_px
        return Reconstruction(
            sequence.camera, records, fused.mesh, config, provenance, source_camera, sequence.skipped, sigma_px
        )


def _steps(sequence: Sequence, pipeline: Pipeline, clock: _Clock) -> Iterator[Step]:
    frames = sequence.frames()

    def perceive_next() -> Percept | None:
        frame = clock.timed("read", next, frames, None)
        return None if frame is None else clock.timed("perceive", pipeline.perceive, frame)

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="perceive") as ahead:
        coming: Future[Percept | None] = ahead.submit(perceive_next)
        while (percept := coming.result()) is not None:
            coming = ahead.submit(perceive_next)
            yield clock.timed("track and fuse", pipeline.step, percept)


def _observed(step: Step, observers: tuple[Observer, ...]) -> FrameRecord:
    for observer in observers:
        observer(step)
    return FrameRecord.of(step)


def _refuse_own_input(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where the result would replace what the run reads."""
    kind, _, folder = config.depth.backend.partition(":")
    for source in [sequence.path, *([Path(folder)] if kind == "files" else [])]:
        if source.resolve().is_relative_to(out.resolve()):
            raise InputError(f"cannot write a run to {out}: its input {source} lies there; name another folder")


def _most_depth_mm(config: Config, estimators: Estimators) -> float:
    """How far depth may reach, mm, with room for what a back end may make of it (three deviations of the scale)."""
    bent = LARGEST_LOG_FACTOR if config.mapping.depth_step_sigma > 0 else 0.0
    room = 1.0 if config.mapping.method == "none" else math.exp(3 * config.mapping.scale_sigma + bent)
    return estimators.reach_mm(config.depth, room)


def _with_best_camera(
    sequence: Sequence, config: Config, estimators: Estimators, clock: _Clock
) -> tuple[Sequence, list[str]]:
    """Give an unknown camera the focal length that `input.focal` asks for, with notes on what the motion tells."""
    unasked = config.input.focal == "auto" and sequence.focal_is_stated
    if sequence.calibrated or unasked or config.input.focal == "assume":
        return sequence, []
    network = next((part for part in (estimators.depth, estimators.anchor.reference) if part.name == "depth-pro"), None)
    if config.input.focal == "auto" and network is not None:
        return _with_networks_focal(sequence, network), []
    taken: tuple[Sequence, list[str]] = clock.timed("focal length", with_focal_from_motion, sequence, config)
    return taken


def _with_networks_focal(sequence: Sequence, network: DepthEstimator) -> Sequence:
    """Take the focal length from Depth Pro's view of the first lit frame: it is in use anyway."""
    first = next((frame for frame in sequence.frames() if not is_constant(frame.rgb)), None)
    focal_px = None if first is None else network.estimate(first).focal_px
    if first is None or focal_px is None:
        return sequence
    return sequence.with_focal(focal_px, f"estimated: Depth Pro on frame {first.index}")


def _with_exponent(
    sequence: Sequence, config: Config, estimators: Estimators, clock: _Clock
) -> tuple[Config, list[str]]:
    """Put a number where the settings ask for a fitted exponent, with a note of what was found; else change nothing."""
    if config.depth.exponent != "fit":
        return config, []
    fit = clock.timed("depth exponent", fit_exponent, sequence, config, estimators.depth)
    return fit.applied(config), [fit.describe(config.depth.advanced.exponent_frames)]


def _provenance(
    sequence: Sequence, estimators: Estimators, clock: _Clock, records: list[FrameRecord]
) -> dict[str, Any]:
    camera = sequence.camera
    lost = [record for record in records if record.track.status == "lost"]
    return {
        "input": str(sequence.path),
        "dataset": sequence.source.name,
        "frames": len(records),
        "tracked": len(records) - len(lost),
        "skipped": dict(Counter(frame.kind for frame in sequence.skipped)),
        "camera": {
            "source": sequence.camera_source,
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "focal_sigma_px": sequence.focal_sigma_px,
            "size": sequence.size_source,
        },
        "estimators": estimators.provenance(),
        "notes": sequence.notes,
        "warnings": sequence.warnings,
        "seconds": {part: round(seconds, 3) for part, seconds in clock.seconds.items()},
        "versions": {name: version(name) for name in _VERSIONS} | {"python": platform.python_version()},
        "machine": f"{platform.system()} {platform.machine()}, {platform.processor() or 'unknown processor'}",
    }
