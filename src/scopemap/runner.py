"""The runner: passes a sequence through the pipeline and collects the result.

While frame i is tracked and fused in this thread, frame i+1 is read and goes through the networks in another.
"""

from __future__ import annotations

import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.calibration.focal_length.estimate import with_focal_from_motion
from scopemap.config import Config, FusionSettings
from scopemap.depth.estimate import DepthEstimator
from scopemap.depth.power_law import fit_exponent
from scopemap.errors import InputError
from scopemap.estimators import create_estimators, estimators_provenance, largest_depth_mm
from scopemap.frame import Frame, is_constant
from scopemap.fusion.agreement import agreement_figures, compare_with_frame
from scopemap.fusion.finish import finished
from scopemap.fusion.frame_store import FrameStore
from scopemap.fusion.volume import FusedSurface
from scopemap.io.sequence import Sequence
from scopemap.mapping.multiview_depth import KeyframeDepths
from scopemap.mapping.submaps import FinalFrames, Submap
from scopemap.pipeline import Estimators, Pipeline, PreprocessedFrame, Step
from scopemap.reconstruction import DepthWriter, FrameRecord, Reconstruction, prepare_folder, records_of
from scopemap.tracking.track import FrameTracker

Observer = Callable[[Step], None]
_CHECKED_FRAMES = 16  # most frames of a submap at which its surface is rendered again
_NO_STORE = "or set mapping.method=none and fusion.voxel_mm: then no frame is stored"
_VERSIONS = ("scopemap", "numpy", "scipy", "opencv-python-headless", "numba", "onnxruntime")
_VERSIONS_OF_NETWORKS = ("torch", "torchvision", "transformers", "lpips")


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
    sequence : from `open_sequence`.
    config : settings, by default the preset `default`.
    out : folder for the result; None keeps it in memory, without depth maps.
    overwrite : replace an earlier run there.
    observers : called with each `Step`, whose pose and depth are as tracked, before the back end.
    tracker : replaces the one of `config.tracking`; its keyframes are adjusted, too, unless `config.mapping.method` is
        "none".

    The settings in the result are the resolved ones: a fitted `depth.exponent` and the TSDF parameters are numbers.
    Of several submaps the one with most frames is the result, and `others` holds the others.
    Raises `InputError` where no frame could be tracked, and what the estimators raise for missing weights.
    """
    config, clock = config or Config(), _Clock()
    folder = None if out is None else Path(out)
    estimators = clock.timed("prepare", create_estimators, config, sequence)
    write = None
    if folder is not None:
        _refuse_own_input(folder, sequence, config)
        prepare_folder(folder, overwrite=overwrite)
        write = DepthWriter(folder, largest_depth_mm(config, estimators))
    sequence, camera_notes = _with_estimated_focal(sequence, config, estimators, clock)
    config, exponent_notes = _with_exponent(sequence, config, estimators, clock)
    if exponent_notes:
        # Some estimators remember the first frame that they saw, and the anchor holds the settings.
        estimators = create_estimators(config, sequence)
    with closing(FrameStore(folder, _NO_STORE)) as store:
        run = _Run(sequence, config, Pipeline(config, estimators, store, tracker), clock, write)
        run.track(observers)
        result = run.result(camera_notes + exponent_notes)
    if folder is not None:
        result.save(folder)
    return result


@dataclass
class _Run:
    """One run: the pipeline, and the results collected from it."""

    sequence: Sequence
    config: Config
    pipeline: Pipeline
    clock: _Clock
    write: DepthWriter | None
    records: list[FrameRecord] = field(default_factory=list)
    median_depths_mm: list[float] = field(default_factory=list)
    checked: _SpreadFrames = field(default_factory=lambda: _SpreadFrames())

    def track(self, observers: tuple[Observer, ...]) -> None:
        """Pass all frames through the pipeline. Raises `InputError` where no frame is tracked."""
        for step in _steps(self.sequence, self.pipeline, self.clock):
            some_mm = step.refined.depth_mm[::4, ::4]
            if np.isfinite(some_mm).any():
                self.median_depths_mm.append(float(np.nanmedian(some_mm)))
            if self.write is not None and not self.pipeline.fusion.at_end:
                self.write(step.frame)
            if self.pipeline.fusion.at_once:
                self.checked.put(step.frame)
            for observer in observers:
                observer(step)
            self.records.append(FrameRecord.of(step))
        if all(record.track.status == "lost" for record in self.records):
            reason = self.records[0].track.reason
            guess = "" if "max_depth_mm" in reason else " (black or constant?)"
            raise InputError(f"no frame of {self.sequence.path} could be used: {reason}{guess}")

    def result(self, notes: list[str]) -> Reconstruction:
        """Return the reconstruction of the largest submap with those of the others."""
        submaps, warnings = self.clock.timed("back end", self.pipeline.mapper.submaps)
        results = [self._fuse_submap(submap, notes) for submap in submaps]
        for frame in self._frames_outside_submaps(submaps):
            self._write_depth(frame)
        results[0].provenance["warnings"] += warnings
        return replace(results[0], others=results[1:])

    def _fuse_submap(self, submap: Submap, notes: list[str]) -> Reconstruction:
        """Correct, write and fuse the frames of a submap."""
        sequence, pipeline = self.sequence, self.pipeline
        store = pipeline.fusion.store
        final = FinalFrames(submap, store.poses(submap.frames), store.frame)
        depths = self._triangulated_depths(final)
        with closing(depths) if depths is not None else nullcontext():
            frames = self._written(final.frames(None if depths is None else depths.depth))
            fused: FusedSurface = self.clock.timed("fuse", pipeline.fusion.fuse, frames, submap.main_frames)
        fused = replace(fused, mesh=self.clock.timed("finish mesh", finished, fused.mesh, fused.settings))
        agreement = self.clock.timed("check surface", _surface_agreement, fused, self.checked.frames)
        self.checked = _SpreadFrames()
        records = records_of(submap, self.records)
        provenance = _provenance(sequence, pipeline.estimators, self.clock, records)
        correction = [] if submap.correction is None else [submap.correction.description]
        provenance["notes"] += notes + correction + ([] if depths is None else [depths.description]) + fused.notes
        masks = pipeline.estimators.masks
        provenance["warnings"] += [] if masks is None else masks.warnings
        # Of the frames that the largest depth was chosen from, so that it cannot contradict itself.
        median_mm = store.median_depth_mm(submap.main_frames)
        medians_mm = self.median_depths_mm if median_mm is None else [median_mm]
        provenance["warnings"] += _depth_warnings(medians_mm, fused.settings)
        provenance["surface"] = agreement
        config = self.config.model_copy(update={"fusion": fused.settings})
        source_camera, sigma_px = sequence.rectifier.source, sequence.focal_sigma_px
        return Reconstruction(
            sequence.camera, records, fused.mesh, config, provenance, source_camera, sequence.skipped, sigma_px
        )

    def _triangulated_depths(self, final: FinalFrames) -> KeyframeDepths | None:
        """Return what triangulates the depth of a submap's keyframes; None where nothing can."""
        flow = self.pipeline.estimators.keyframe_flow
        used = self.write is not None or self.config.fusion.enabled
        if not (used and self.config.mapping.triangulate_depth and final.keyframes) or flow.name == "none":
            return None
        return KeyframeDepths(final.view, final.T_world_camera, final.keyframes, self.sequence.camera, flow)

    def _written(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """Yield the final frames of a submap, their depth written; keep some, at which its surface is checked."""
        for frame in frames:
            self.checked.put(frame)
            yield self._write_depth(frame)

    def _frames_outside_submaps(self, submaps: list[Submap]) -> Iterator[Frame]:
        """Yield the stored frames that are in no submap, as tracked."""
        submapped = {index for submap in submaps for index in submap.frames}
        return self.pipeline.fusion.store.frames({r.index for r in self.records if r.index not in submapped})

    def _write_depth(self, frame: Frame) -> Frame:
        """Write the final depth of a frame."""
        if self.write is not None:
            self.write(frame)
        return frame


def _surface_agreement(fused: FusedSurface, frames: list[Frame]) -> dict[str, float]:
    """Return the agreement of a surface with some of its frames; {} without a surface or frames."""
    agreements = []
    for frame in frames if len(fused.mesh.faces) else []:
        if frame.T_world_camera is not None and frame.depth_mm is not None:
            depth_mm = np.where(frame.valid, frame.depth_mm, np.nan)
            seen = (frame.camera, frame.T_world_camera, frame.rgb, depth_mm)
            found, _ = compare_with_frame(fused.mesh, *seen, albedo=fused.settings.colours == "albedo")
            agreements.append(found)
    return agreement_figures(agreements) if agreements else {}


class _SpreadFrames:
    """Every n-th of the frames with a pose that are put in, at most `_CHECKED_FRAMES`; n doubles as they grow more."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self._every, self._count = 1, 0

    def put(self, frame: Frame) -> None:
        """Keep or skip a frame."""
        if frame.T_world_camera is None:
            return
        if self._count % self._every == 0:
            self.frames.append(frame)
        self._count += 1
        if len(self.frames) > _CHECKED_FRAMES:
            self.frames, self._every = self.frames[::2], 2 * self._every


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


def _steps(sequence: Sequence, pipeline: Pipeline, clock: _Clock) -> Iterator[Step]:
    frames = sequence.frames()

    def preprocess_next() -> PreprocessedFrame | None:
        frame = clock.timed("read", next, frames, None)
        return None if frame is None else clock.timed("preprocess", pipeline.preprocess, frame)

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="preprocess") as ahead:
        coming: Future[PreprocessedFrame | None] = ahead.submit(preprocess_next)
        while (preprocessed := coming.result()) is not None:
            coming = ahead.submit(preprocess_next)
            yield clock.timed("track and fuse", pipeline.step, preprocessed)


def _refuse_own_input(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where the result would replace what the run reads."""
    kind, _, folder = config.depth.backend.partition(":")
    for source in [sequence.path, *([Path(folder)] if kind == "files" else [])]:
        if source.resolve().is_relative_to(out.resolve()):
            raise InputError(f"cannot write a run to {out}: its input {source} is in it; name another folder")


def _with_estimated_focal(
    sequence: Sequence, config: Config, estimators: Estimators, clock: _Clock
) -> tuple[Sequence, list[str]]:
    """Give an unknown camera the focal length by `input.focal`, with notes on the estimation."""
    is_stated = config.input.focal == "auto" and sequence.focal_is_stated
    if sequence.calibrated or is_stated or config.input.focal == "assume":
        return sequence, []
    network = next((part for part in (estimators.depth, estimators.anchor.reference) if part.name == "depth-pro"), None)
    if config.input.focal == "auto" and network is not None:
        return _with_networks_focal(sequence, network), []
    estimated: tuple[Sequence, list[str]] = clock.timed("focal length", with_focal_from_motion, sequence, config)
    return estimated


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
    """Put a number where the settings ask for a fitted exponent, with a note on the fit; else change nothing."""
    if config.depth.exponent != "fit":
        return config, []
    fit = clock.timed("depth exponent", fit_exponent, sequence, config, estimators.depth)
    return fit.applied(config), [fit.describe(config.depth.advanced.exponent_frames)]


def _depth_warnings(medians_mm: list[float], settings: FusionSettings) -> list[str]:
    """Return a warning where most of the scene is beyond the largest depth that is fused."""
    if not settings.enabled or not medians_mm or settings.max_depth_mm is None:
        return []
    median_mm = float(np.median(medians_mm))
    if median_mm <= settings.max_depth_mm:
        return []
    return [
        f"most of the scene is not fused: its median depth is {median_mm:.0f} mm, fusion.max_depth_mm "
        f"{settings.max_depth_mm:g}; raise fusion.max_depth_mm and fusion.voxel_mm"
    ]


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
        "estimators": estimators_provenance(estimators),
        "notes": sequence.notes,
        "warnings": sequence.warnings,
        "seconds": {part: round(seconds, 3) for part, seconds in clock.seconds.items()},
        "versions": _versions(),
        "machine": f"{platform.system()} {platform.machine()}, {platform.processor() or 'unknown processor'}",
    }


def _versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on; of `networks` if present."""
    installed = [name for name in _VERSIONS_OF_NETWORKS if find_spec(name) is not None]
    return {name: version(name) for name in (*_VERSIONS, *installed)} | {"python": platform.python_version()}
