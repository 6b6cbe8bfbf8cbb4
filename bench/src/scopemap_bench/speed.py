"""Processor time of each stage of a run on this machine.

A stage counts without the stages that it calls. Times of two machines are compared as ratios to a calibration, OpenCV's
DIS flow of a fixed pair of images: not this package's code, and like most of its work. It is measured again and again
while the run lasts: a processor whose cores are all busy is slower than an idle one, and other work comes and goes.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from scopemap.engine.config import Config, Preset
from scopemap.engine.errors import InputError
from scopemap.input.frame_choice import selection_text
from scopemap.input.opening import open_sequence
from scopemap.runner.reconstruct import reconstruct
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom

PHANTOM = PhantomSpec(scene="colon", frames=60, width=320, height=256, seed=0)
"""What is measured without a video."""

STAGES: dict[str, tuple[str, ...]] = {
    "rectify": ("engine.cameras.rectification:Rectifier.image",),
    "masks": ("engine.masking.masker:Masker.__call__",),
    "depth network": (
        "engine.depth.scopenet.estimator:ScopeNetDepth.estimate",
        "engine.depth.depth_anything:DepthAnything.estimate",
        "engine.depth.depth_pro:DepthPro.estimate",
    ),
    "metric anchor": ("engine.depth.anchor:AnchoredDepth.metric",),
    "correspondence": ("engine.depth.mapis:DenseMatcher.match",),
    "perceptual distance": (
        "engine.depth.perceptual:StructureDistance.compare",
        "engine.depth.perceptual:LpipsAlex.compare",
    ),
    "flow": (
        "engine.flow.dis:DisFlow.estimate",
        "engine.flow.dis:DisFlow.estimate_small",
        "engine.flow.dis:DisFlow.estimate_checked",
        *("engine.flow.raft:RaftFlow.estimate", "engine.flow.raft:RaftFlow.estimate_both"),
    ),
    "tracking": ("engine.tracking.tracker:Tracker.track",),
    "corners": ("engine.flow.corners:KeyframeMatcher.match", "engine.flow.corners:KeyframeMatcher.set_keyframe"),
    "pose from corners": ("engine.tracking.keyframe_alignment:pose_from_correspondences",),
    "photometric alignment": ("engine.tracking.keyframe_alignment:align",),
    "relocalisation": ("engine.tracking.relocalisation:Relocaliser.find",),
    "MAPIS": ("engine.depth.mapis:Mapis.refine",),
    "keyframe": ("engine.tracking.tracker:Tracker.update", "engine.mapping.mapper:Mapper.add_keyframe"),
    "store": ("engine.fusion.frame_store:FrameStore.put", "engine.fusion.frame_store:FrameStore._read"),
    "feature tracks": ("engine.mapping.feature_tracks:FeatureTracks.add",),
    "depth triangulation": (
        "engine.mapping.multiview_depth:triangulate_depth",
        "engine.mapping.multiview_depth:propagate_depth",
    ),
    "fusion": ("engine.fusion.surface_fusion:TsdfVolume.integrate",),
    "writing": ("result.depth_maps:DepthWriter.__call__", "result.result:Result.save"),
}
"""Functions, "module:name" in the package, whose processor time is a stage's; the rest is that of the run's parts."""

_PARTS = "runner.run:Clock.timed"  # called with the part's name
_CALLER = {"correspondence": "flow to the previous frame", "corners": "flow to the keyframe"}
_OTHER_FLOW = "flow between keyframes"
_NOISE = 0.2  # of the calibration: two measurements of one machine differ by 0.15
_WARM_UP_FRAMES = 12  # compile, load and fill caches
_CALIBRATION_RUNS = 15
_CALIBRATION_PAUSE_S = 0.2  # some 60 flows in a run of the phantom; their ratios of five runs lie 3 % apart


@dataclass(frozen=True)
class StageTime:
    """Processor time of a stage: ms per frame, ratio to the calibration, share of all stages, main thread."""

    ms: float
    ratio: float
    share: float
    thread: str


@dataclass(frozen=True)
class Speed:
    """Processor time per frame of a run's stages on one machine.

    video : its path below the folder of the data, None: the phantom. selection : its frames, "A:B:S", "": all.
    calibration_ms, cpu_ms : of the calibration, and of the whole process per frame. passed_ms : time that passed, per
    frame.
    size : (width, height) of the working images, px. stages : by name.
    """

    video: str | None
    selection: str
    frames: int
    preset: Preset
    size: tuple[int, int]
    calibration_ms: float
    cpu_ms: float
    passed_ms: float
    stages: dict[str, StageTime]

    @property
    def whole_ratio(self) -> float:
        """Processor time of the whole process per frame, in calibrations."""
        return self.cpu_ms / self.calibration_ms

    @property
    def clip(self) -> str:
        """Name of what was measured, such as "cecum_t1_a 0:60"."""
        return " ".join(filter(None, ("phantom" if self.video is None else Path(self.video).name, self.selection)))

    @property
    def _measured(self) -> str:
        return f"{self.frames} frames of {self.clip} at {self.size[0]}x{self.size[1]} px, preset {self.preset}"

    def slower_than(self, before: Speed, tolerance: float, *, whole: bool = False) -> list[str]:
        """Return a line for each stage, and for the whole process, slower by more than the share `tolerance`.

        whole : only for the whole process. Raises `InputError` for other clips or presets.
        """
        if before._measured != self._measured:
            raise InputError(f"cannot compare {self._measured} with {before._measured}: measure the same")
        stages = ({} if whole else speed.stages for speed in (self, before))
        now, then = ({name: stage.ratio for name, stage in of_run.items()} for of_run in stages)
        now["whole process"], then["whole process"] = (one.whole_ratio for one in (self, before))
        slower = {name: (ratio, then.get(name, 0.0)) for name, ratio in now.items()}
        return [
            f"{name}: {ratio:.2f} of the calibration, before {was:.2f}"
            for name, (ratio, was) in slower.items()
            if ratio > max((1 + tolerance) * was, was + _NOISE)
        ]


@contextmanager
def timed_runs(
    video: str | None, frames: slice, config: Config, data: Path | None = None
) -> Iterator[Callable[[], Speed]]:
    """Yield what runs a video, each time anew, and returns the processor time of the stages; a short run warms it up.

    OpenCV has one thread while the context lasts, so that its work is counted where it is called.

    Parameters
    ----------
    video : path below `data`, None: a phantom.
    frames : which of its frames.
    data : None: the working directory.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with tempfile.TemporaryDirectory() as folder:
            path, out = Path(folder) / "phantom", Path(folder) / "run"
            if video is None:
                write_phantom(PHANTOM, path)
            else:
                path = (data or Path()) / video
            reconstruct(open_sequence(path, frames=slice(_WARM_UP_FRAMES)), config, out=out)
            yield lambda: _measured(video, path, frames, config, out)
    finally:
        cv2.setNumThreads(threads)


def _measured(video: str | None, path: Path, frames: slice, config: Config, out: Path) -> Speed:
    sequence, clock = open_sequence(path, frames=frames), Stopwatch()
    started, cpu_started = time.perf_counter(), time.process_time()
    with calibrating() as calibrations, clock.attached():
        result = reconstruct(sequence, config, out=out, overwrite=True)
    count = len(result.frames)
    cpu_ms = (1e3 * (time.process_time() - cpu_started) - sum(calibrations)) / count
    passed_ms = 1e3 * (time.perf_counter() - started) / count
    calibration_ms = float(np.median(calibrations))
    size, stages = (sequence.camera.width, sequence.camera.height), clock.stages(count, calibration_ms)
    measured = (calibration_ms, cpu_ms, passed_ms, stages)
    return Speed(video, selection_text(frames), count, config.preset, size, *measured)


class Stopwatch:
    """Notes the processor time of calls of the stages' functions, without that of the stages within them."""

    def __init__(self) -> None:
        # By stage, thread and function: functions of a stage may take very different times.
        self._seconds: dict[tuple[str, str, str], list[float]] = defaultdict(list)
        self._local = threading.local()

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Replace the functions of `STAGES` by timed ones while the context lasts."""
        places = [(resolved(place), stage) for stage, places in STAGES.items() for place in places]
        clock, method = resolved(_PARTS)
        original = getattr(clock, method)

        def timed(own: Any, part: str, call: Callable[..., Any], *arguments: Any) -> Any:
            with self.noted(part):
                return original(own, part, call, *arguments)

        with ExitStack() as replaced:
            replaced.enter_context(patch.object(clock, method, timed))
            for (owner, name), stage in places:
                function = getattr(owner, name)
                timed_function = wraps(function)(self.noted(stage, function.__qualname__)(function))
                replaced.enter_context(patch.object(owner, name, timed_function))
            yield

    @contextmanager
    def noted(self, stage: str, function: str = "") -> Iterator[None]:
        """Note the processor time of what is within as that of a function of a stage; usable as a decorator."""
        # Open calls of this thread: stage, seconds of the stages within.
        calls: list[tuple[str, list[float]]] = self._local.__dict__.setdefault("calls", [])
        name, within = stage, [0.0]
        if stage == "flow":  # named by what it is computed for
            name = next((_CALLER[caller] for caller, _ in calls if caller in _CALLER), _OTHER_FLOW)
        calls.append((stage, within))
        started = time.thread_time()
        try:
            yield
        finally:
            seconds = time.thread_time() - started
            calls.pop()
            if calls:
                calls[-1][1][0] += seconds
            thread = threading.current_thread().name
            thread = "main" if thread == "MainThread" else thread.rpartition("_")[0] or thread
            self._seconds[name, thread, function].append(seconds - within[0])

    def stages(self, frames: int, calibration_ms: float) -> dict[str, StageTime]:
        """Return the stages that ran, the slowest first."""
        ms: dict[str, dict[str, float]] = defaultdict(dict)
        for (stage, thread, _), seconds in self._seconds.items():
            own_ms = 1e3 * float(np.median(seconds)) * len(seconds) / frames
            ms[stage][thread] = ms[stage].get(thread, 0.0) + own_ms
        total = sum(sum(parts.values()) for parts in ms.values())
        found = {}
        for stage, threads in sorted(ms.items(), key=lambda item: -sum(item[1].values())):
            own = sum(threads.values())
            found[stage] = StageTime(own, own / calibration_ms, own / total, max(threads, key=threads.__getitem__))
        return found


def resolved(place: str) -> tuple[Any, str]:
    """Return the owner and the name of the function at "module:name"."""
    module, _, names = place.partition(":")
    *owners, name = names.split(".")
    owner: Any = import_module(f"scopemap.{module}")
    for part in owners:
        owner = getattr(owner, part)
    return owner, name


@contextmanager
def calibrating() -> Iterator[list[float]]:
    """Measure the calibration in a thread of its own while the context lasts, ms of processor time each.

    The list is complete when the context ends; it holds at least one.
    """
    times_ms: list[float] = []
    ended = threading.Event()

    def measure() -> None:
        flow = _calibration()
        while True:
            times_ms.append(_timed_ms(flow))
            if ended.wait(_CALIBRATION_PAUSE_S):
                return

    thread = threading.Thread(target=measure, name="calibration")
    thread.start()
    try:
        yield times_ms
    finally:
        ended.set()
        thread.join()


def calibrations_ms() -> list[float]:
    """Return the processor times of OpenCV's DIS flow of a fixed pair of images, 320x256 px."""
    flow = _calibration()
    return [_timed_ms(flow) for _ in range(_CALIBRATION_RUNS)]


def _calibration() -> Callable[[], object]:
    noise = np.random.default_rng(0).normal(size=(256, 340)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), 2.5)
    smooth = (127 + 60 * blurred / blurred.std()).clip(0, 255).astype(np.uint8)
    pair = np.ascontiguousarray(smooth[:, :320]), np.ascontiguousarray(smooth[:, 4:324])
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return lambda: dis.calc(*pair, np.zeros((256, 320, 2), np.float32))


def _timed_ms(call: Callable[[], object]) -> float:
    started = time.thread_time()
    call()
    return 1e3 * (time.thread_time() - started)
