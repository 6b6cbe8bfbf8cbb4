"""One run: the loop that passes the frames of a sequence through the stages of the pipeline, each in a thread."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import Any, Protocol

from numba.core.event import TimingListener, register

from scopemap.engine.finishing import Execution
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import SpreadFrames
from scopemap.engine.mapping.judge import LensTest
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Step
from scopemap.engine.pipeline import Adjusted, Pipeline
from scopemap.engine.tracking.track import Track
from scopemap.input.sequence import Sequence, in_thread
from scopemap.result.frame_table import FrameTable, GrowingFrameTable
from scopemap.result.result import Result
from scopemap.result.surface_segments import main_segment
from scopemap.result.verdict import graded
from scopemap.result.wording import facts_of_notices
from scopemap.runner.memory import MemoryPlan, keep_freed_arrays, trim_memory
from scopemap.runner.observers import FrameWriter, Observer, Progress, RunStopped
from scopemap.runner.provenance import Limits, facts_of_segment, motion_notices, notices_of_end, provenance_of
from scopemap.runner.submap_frames import check_tracked, frames_of_submap, put_backwards, tracked_frames


class CheckpointWriter(Protocol):
    """Writes checkpoints of a run as it goes, with each stage as it was after the same frame, as `Checkpoints` does."""

    @property
    def exist(self) -> bool:
        """Whether there is a checkpoint to resume from."""

    def restore(self) -> tuple[int, bool]:
        """Bring the run to where the checkpoint was made; return the last frame and whether it was that of all."""

    def take(self, step: Step) -> None:
        """Take each step of the run, in order."""

    def due(self) -> bool:
        """Return whether the frame that is read now should be one after which a checkpoint is written."""

    def keep(self, stage: str) -> None:
        """Make the record of a stage, called in its thread."""

    def commit(self, last: int) -> None:
        """Write the checkpoint after the frame `last`."""

    def commit_all(self, last: int, *, stopped: bool, complete: bool) -> None:
        """Write the checkpoint after the last frame that was read, when no stage is at work.

        stopped : the run ends with it. complete : no further frame follows.
        """


@dataclass
class KeptMaps:
    """Which maps and frames a run without an end keeps, by its limits; `forgotten` counts frames."""

    limits: Limits = field(default_factory=Limits)
    map: int = 0
    frames_of_map: Counter[int] = field(default_factory=Counter)
    forgotten: int = 0

    def beyond(self, track: Track, *, is_full: bool) -> list[int]:
        """Count a frame, and return the numbers of the maps whose surface is to be forgotten."""
        self.frames_of_map[track.map] += track.status != "lost"
        left, self.map = track.map != self.map, track.map
        if not ((left and self.limits.maps is not None) or is_full):
            return []
        others = [number for number, _ in self.frames_of_map.most_common() if number != self.map]
        return others[0 if is_full else self.limits.maps :]


@dataclass
class Run:
    """One run, and what is collected from it.

    writers : of the final depth, or the surface, of each frame; none where the result stays in memory. checked : frames
    of each map at which its surface is checked.
    """

    sequence: Sequence
    pipeline: Pipeline
    clock: Clock
    writers: tuple[FrameWriter, ...] = ()
    progress: Progress = lambda doing, done, total: None
    plan: MemoryPlan = field(default_factory=MemoryPlan)
    kept_maps: KeptMaps = field(default_factory=KeptMaps)
    stopped: bool = False
    interrupted: bool = False
    resumed_after: int | None = None
    frames: GrowingFrameTable = field(init=False)
    checked: dict[int, SpreadFrames] = field(default_factory=lambda: defaultdict(SpreadFrames))

    def __post_init__(self) -> None:
        self.frames = GrowingFrameTable(self.pipeline.fusion.store.lasting_table)
        self.pipeline.fusion.coarser_beyond = self.plan.blocks
        self.pipeline.fusion.most_blocks = self.kept_maps.limits.blocks
        self.pipeline.mapper.limit(self.plan.observations)
        keep_freed_arrays(at_the_end=False)

    def track(self, observers: tuple[Observer, ...], checkpoints: CheckpointWriter | None = None) -> None:
        """Pass all frames through the pipeline, those after the last checkpoint. Raises `RunStopped` of an observer."""
        last, complete = -1, False
        if checkpoints is not None and checkpoints.exist:
            last, complete = checkpoints.restore()
            self.resumed_after = last
            self.progress("resuming", len(self.frames), 0)
        frames, stop = iter(()) if complete else self._until_stopped(last), None
        for step in overlapped(frames, self.pipeline, self.clock, self.plan.ahead, checkpoints):
            self.take(step)
            if checkpoints is not None:
                checkpoints.take(step)
            for observer in observers:
                try:
                    self.stopped = bool(observer(step)) or self.stopped
                except RunStopped as asked:
                    # Frames that are on their way are tracked: the checkpoint is that after a frame.
                    self.stopped, stop = True, asked
        if checkpoints is not None and len(self.frames) and not complete and (stop or not self.interrupted):
            checkpoints.commit_all(self.frames.last_index, stopped=stop is not None, complete=not self.interrupted)
        if stop is not None:
            raise stop

    def take(self, step: Step) -> None:
        """Fuse or store the frame of a step, collect its results, and forget what is beyond the limits."""
        fusion, limits = self.pipeline.fusion, self.kept_maps.limits
        self.clock.timed("store or fuse", self.pipeline.fuse, step)
        self.replay(step)
        self.frames.append(step.row)
        is_beyond = limits.exceeded(frames=len(self.frames), stored=len(fusion.store))
        if fusion.at_end and fusion.at_once and is_beyond:
            fusion.stay_at_once()
            self.pipeline.mapper.stay_as_tracked()
        for number in self.kept_maps.beyond(step.track, is_full=fusion.is_full):
            fusion.forget(number)
            self.checked.pop(number, None)
        if limits.frames is not None and len(self.frames) > limits.frames:
            older = self.frames.thin()
            self.pipeline.mapper.forget(older)
            self.kept_maps.forgotten += len(older)

    def replay(self, step: Step) -> None:
        """Collect the results of a step whose row is there: it was made before the run was resumed."""
        fusion, limits = self.pipeline.fusion, self.kept_maps.limits
        if not fusion.at_end:
            for write in self.writers:
                write(step.frame)
        # Stored frames are checked as corrected, unless they become too many.
        if fusion.at_once and (not fusion.at_end or limits != Limits()):
            in_memory = fusion.at_end or limits.maps is not None
            self.checked[step.track.map].put(step.frame, None if in_memory else fusion.store)

    def _until_stopped(self, after: int) -> Iterator[Frame]:
        """Yield the frames after one until an observer asks for a stop."""
        for frame in self.sequence.frames(after):
            if self.stopped:
                self.interrupted = True
                return
            yield frame

    @cached_property
    def table(self) -> FrameTable:
        """The table of all frames, as tracked, after the last one; `adjusted` puts in what is tracked backwards."""
        return self.frames.read()

    @cached_property
    def adjusted(self) -> Adjusted:
        """The adjusted submaps, and what was tracked backwards. Raises `InputError` where no frame was tracked."""
        check_tracked(self.table, self.sequence.path, self.pipeline.preprocessing.estimators.masks)
        if self.pipeline.config.mapping.global_adjustment:
            self.progress("adjusting keyframes", 0, 0)
        keep_freed_arrays(at_the_end=True)
        trim_memory()
        found = self.pipeline.adjust(tracked_frames(self.table), _InThreads(self))
        put_backwards(self.table, found.backwards)
        return found

    @property
    def lens(self) -> LensTest:
        """What left-out tracks of the largest submap tell of the focal length."""
        correction = self.adjusted.submaps[0].segments[0].correction
        return LensTest() if correction is None else correction.lens

    def result(self, prepared: list[Notice]) -> Result:
        """Return the reconstruction of the largest submap with those of the others. Raises `InputError` without one."""
        result = _Finishing(self, self.table, prepared + self.plan.notices).result()
        last = self.frames.last_index if self.interrupted else None
        from scopemap.runner.texturing import put_textures  # not loaded before there is a surface

        trim_memory()  # the volume
        put_textures(result, self.sequence, self.pipeline, self.progress)
        notices = notices_of_end(result.frames, last, self.kept_maps.forgotten, self.kept_maps.limits)
        result.provenance["notices"] += facts_of_notices(notices)
        result.provenance |= {"interrupted_at_frame": last, "resumed_after_frame": self.resumed_after}
        return result


@dataclass
class _Finishing:
    """Makes the result of a run from the table of all its frames, as tracked; `notices` concern all submaps."""

    run: Run
    frames: FrameTable
    notices: list[Notice]

    def result(self) -> Result:
        """Return the reconstruction of the largest submap with those of the others. Raises `InputError` without one."""
        pipeline, adjusted = self.run.pipeline, self.run.adjusted
        submapped = {index for submap in adjusted.submaps for index in submap.frames}
        execution = _InThreads(self.run, len(submapped))
        results = [self._submap_result(number, execution) for number in range(len(adjusted.submaps))]
        apart = set(self.frames["index"].tolist()) - submapped if pipeline.fusion.at_end else set()
        for frame in pipeline.fusion.store.frames(apart):
            execution.write(frame)  # as tracked
        results[0].provenance["notices"] += facts_of_notices(pipeline.notices + adjusted.notices)
        results[0].others = results[1:]
        return results[0]

    def _submap_result(self, number: int, execution: _InThreads) -> Result:
        """Finish a submap, one segment after the other; its final frames are written meanwhile."""
        trim_memory()
        sequence, pipeline, submaps = self.run.sequence, self.run.pipeline, self.run.adjusted.submaps
        submap, config, tracked = submaps[number], pipeline.config, tracked_frames(self.frames)
        surfaces = []
        for segment in submap.segments:
            checked = None if pipeline.fusion.at_end else self.run.checked.pop(submap.main, None)
            surfaces.append(pipeline.surface(submap, segment, tracked, sequence.camera, execution, checked))
        frames = frames_of_submap(number, submaps, self.frames)
        segments = graded(
            facts := [facts_of_segment(*each, frames) for each in zip(submap.segments, surfaces, strict=True)]
        )
        main = main_segment(segments)
        surface = surfaces[main]
        moving = motion_notices(frames, config, checked=surface.is_checked)
        provenance = provenance_of(sequence, pipeline.estimators, self.run.clock.seconds, frames)
        provenance["notices"] += facts_of_notices(self.notices + moving + surface.notices)
        provenance["surface"] = surface.agreement
        provenance["segments"], provenance["main_segment"] = facts, main
        corrections = [segment.correction for segment in submap.segments if segment.correction is not None]
        provenance["loops"] = [frames for correction in corrections for frames in correction.loop_frames]
        return Result.in_memory(
            sequence.camera,
            frames.with_skipped(sequence.skipped),
            surface.mesh,
            config.model_copy(update={"fusion": surface.settings}),
            provenance,
            source_camera=sequence.rectifier.source,
        ).with_segments(segments, [one.mesh for one in surfaces])


@dataclass
class _InThreads(Execution):
    """Carries out the steps after the last frame: timed, some in threads; writes final frames, `count` of them."""

    run: Run
    count: int = 0
    _done: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self.keeps_depth = bool(self.run.writers)

    def timed(self, part: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a call returns, and count its seconds."""
        return self.run.clock.timed(part, call, *arguments)

    def in_thread(self, frames: Iterator[Frame], thread: str) -> Generator[Frame, None, None]:
        """Yield frames in order, computed in a thread of their own."""
        return in_thread(frames, thread)

    def final(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        """Yield final frames, written."""
        for frame in frames:
            self.write(frame)
            yield frame
            self._done += 1
            self.run.progress("fusing", self._done, self.count)

    def write(self, frame: Frame) -> None:
        """Write a frame whose depth is final."""
        for write in self.run.writers:
            write(frame)


class Clock:
    """Seconds spent per part; parts in different threads overlap."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._compiled_before_s = compiling_s()

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of the parts so far, and of all; those of kernels not compiled ahead are in other parts, too."""
        compiled_s = compiling_s() - self._compiled_before_s + self._seconds.get("compile kernels", 0.0)
        compiled = {"compile kernels": compiled_s} if compiled_s else {}
        return self._seconds | compiled | {"total": time.perf_counter() - self._started}

    def timed(self, part: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a call returns, and count its seconds."""
        started = time.perf_counter()
        try:
            return call(*arguments)
        finally:
            self._seconds[part] = self._seconds.get(part, 0.0) + time.perf_counter() - started


def compiling_s() -> float:
    """Return how long this process has compiled kernels that no cache held, s, since the first call."""
    compiling = _compiling()
    return float(compiling.duration) if compiling.done else 0.0


@cache
def _compiling() -> TimingListener:
    """Return what hears of all compiling from now on."""
    listener = TimingListener()
    register("numba:compile", listener)
    return listener


def overlapped(
    frames: Iterator[Frame],
    pipeline: Pipeline,
    clock: Clock,
    ahead: int = 2,
    checkpoints: CheckpointWriter | None = None,
) -> Iterator[Step]:
    """Yield the steps of all frames, not yet fused; each stage runs in a thread of its own, `ahead` frames ahead.

    A checkpoint is committed when the next step is asked for: the one before is fused by then.
    """

    def stage(part: str, call: Callable[[Any], Any], items: Iterable[Any]) -> Generator[Any, None, None]:
        def results() -> Iterator[Any]:
            for item, due in items:
                result = clock.timed(part, call, item)
                if due and checkpoints is not None:
                    checkpoints.keep(part)
                yield result, due

        return in_thread(results(), part, ahead)

    read = iter(partial(clock.timed, "read", next, frames, None), None)
    marked = ((frame, checkpoints is not None and checkpoints.due()) for frame in read)
    items: Any = marked
    for part, call in pipeline.steps.items():
        items = stage(part, call, items)
    with closing(items):
        for step, due in items:
            yield step
            if due and checkpoints is not None:
                checkpoints.commit(step.frame.index)
