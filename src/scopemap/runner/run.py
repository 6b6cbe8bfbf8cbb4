"""One run: the loop that passes the frames of a sequence through the stages of the pipeline, each in a thread."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from numba.core.event import TimingListener, register

from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import surface_agreement, vertex_sigmas
from scopemap.engine.fusion.finish import finished, with_normals_alone
from scopemap.engine.fusion.frame_store import SpreadFrames
from scopemap.engine.fusion.free_space import FreeSpace, views_among
from scopemap.engine.fusion.moving_tissue import MovingTissue, SeenAt, block_edge_mm
from scopemap.engine.fusion.reference_state import SurfaceState
from scopemap.engine.fusion.surface_fusion import FusedSurface, depth_notices
from scopemap.engine.kept import Kept
from scopemap.engine.mapping.multiview_depth import KeyframeDepths
from scopemap.engine.mapping.submaps import FinalFrames, Submap
from scopemap.engine.mapping.tissue_states import TissueStates
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Step
from scopemap.engine.pipeline import Pipeline
from scopemap.engine.tracking.track import Track
from scopemap.input.sequence import Sequence
from scopemap.result.frame_table import FrameTable, GrowingFrameTable
from scopemap.result.reconstruction import Reconstruction
from scopemap.runner.backwards import track_backwards
from scopemap.runner.memory import MemoryPlan, trim_memory
from scopemap.runner.provenance import Limits, motion_notices, notices_of_end, provenance_of
from scopemap.runner.submap_frames import check_tracked, frames_of_submap

Observer = Callable[[Step], bool | None]
"""Called with each step; True: no further frame is read, and the result is of the frames until then."""


@runtime_checkable
class KeptObserver(Protocol):
    """An `Observer` that is resumed with a run, by what it marks as `Kept`, and saved with the result."""

    def __call__(self, step: Step) -> bool | None:
        """Take a step."""

    def save(self, run: Path) -> None:
        """Write what was observed to the folder of the result."""


Progress = Callable[[str, int, int], None]
"""Called with what is done outside of tracking (such as "fusing"), frames done, and all frames; 0: not in frames."""
FrameWriter = Callable[[Frame], None]
"""Writes something of a frame whose depth is final."""
_Item = TypeVar("_Item")
_END = object()
_COMPILING = TimingListener()
register("numba:compile", _COMPILING)


class RunStates(Protocol):
    """Writes the state of a run as it goes, that of each stage after the same frame, as `Checkpoints` does."""

    @property
    def exist(self) -> bool:
        """Whether there is a state to resume from."""

    def restore(self) -> tuple[int, bool]:
        """Bring the run to the state that was committed last; return the last frame and whether it was that of all."""

    def due(self) -> bool:
        """Return whether the frame that is read now should be one after which the state is written."""

    def keep(self, stage: str) -> None:
        """Write the state of a stage, called in its thread."""

    def commit(self, last: int) -> None:
        """Write the rest; the state is now that after the frame `last`."""

    def commit_all(self, last: int) -> None:
        """Write the state after all frames, when no stage is at work."""


@dataclass
class KeptMaps:
    """Which maps and frames a run without an end keeps, by its limits; `forgotten` counts frames."""

    limits: Limits = field(default_factory=Limits)
    map: Kept[int] = 0
    frames_of_map: Kept[Counter[int]] = field(default_factory=Counter)
    forgotten: Kept[int] = 0

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
    kept_maps: Kept[KeptMaps] = field(default_factory=KeptMaps)
    stopped: bool = False
    interrupted: bool = False
    resumed_after: int | None = None
    frames: Kept[GrowingFrameTable] = field(init=False)
    checked: Kept[dict[int, SpreadFrames]] = field(default_factory=lambda: defaultdict(SpreadFrames))

    def __post_init__(self) -> None:
        self.frames = GrowingFrameTable(self.pipeline.fusion.store.table)
        self.pipeline.fusion.coarser_beyond = self.plan.blocks
        self.pipeline.fusion.most_blocks = self.kept_maps.limits.blocks
        self.pipeline.mapper.limit(self.plan.observations)

    def track(self, observers: tuple[Observer, ...], states: RunStates | None = None) -> None:
        """Pass all frames through the pipeline, those after the last checkpoint."""
        last, complete = -1, False
        if states is not None and states.exist:
            last, complete = states.restore()
            self.resumed_after = last
            self.progress("resuming", len(self.frames), 0)
        frames = iter(()) if complete else self._until_stopped(last)
        for step in overlapped(frames, self.pipeline, self.clock, self.plan.ahead, states):
            self.take(step)
            for observer in observers:
                self.stopped = bool(observer(step)) or self.stopped
        if states is not None and len(self.frames) and not (complete or self.interrupted):
            states.commit_all(self.frames.last_index)

    def take(self, step: Step) -> None:
        """Collect the results of a step, and forget what is beyond the limits."""
        fusion, limits = self.pipeline.fusion, self.kept_maps.limits
        if not fusion.at_end:
            for write in self.writers:
                write(step.frame)
        if fusion.at_once:
            self.checked[step.track.map].put(step.frame, fusion.store if limits.maps is None else None)
        self.frames.append(step.row)
        for number in self.kept_maps.beyond(step.track, is_full=fusion.is_full):
            fusion.forget(number)
            self.checked.pop(number, None)
        if limits.frames is not None and len(self.frames) > limits.frames:
            older = self.frames.thin()
            self.pipeline.mapper.forget(older)
            self.kept_maps.forgotten += len(older)

    def _until_stopped(self, after: int) -> Iterator[Frame]:
        """Yield the frames after one until an observer asks for a stop."""
        for frame in self.sequence.frames(after):
            if self.stopped:
                self.interrupted = True
                return
            yield frame

    def result(self, prepared: list[Notice]) -> Reconstruction:
        """Return the reconstruction of the largest submap with those of the others. Raises `InputError` without one."""
        result = _Finishing(self, self.frames.read(), prepared + self.plan.notices).result()
        last = self.frames.last_index if self.interrupted else None
        facts = {"interrupted_at_frame": last, "resumed_after_frame": self.resumed_after}
        notices = notices_of_end(result.frames, last, self.kept_maps.forgotten, self.kept_maps.limits)
        result.provenance.update(facts)
        result.provenance["notices"] += [notice.as_json() for notice in notices]
        return result


@dataclass
class _Finishing:
    """Makes the result of a run from the table of all its frames, as tracked; `notices` are of all submaps."""

    run: Run
    frames: FrameTable
    notices: list[Notice]
    _done: int = field(default=0, init=False)

    def result(self) -> Reconstruction:
        """Return the reconstruction of the largest submap with those of the others. Raises `InputError` without one."""
        frames, pipeline, clock = self.frames, self.run.pipeline, self.run.clock
        check_tracked(frames, self.run.sequence.path)
        clock.timed("track backwards", track_backwards, pipeline, frames)
        if pipeline.config.mapping.at_end:
            self.run.progress("adjusting keyframes", 0, 0)
        submaps, notices = clock.timed("back end", pipeline.mapper.submaps)
        results = [self._fused(number, submaps) for number in range(len(submaps))]
        submapped = {index for submap in submaps for index in submap.frames}
        apart = set(frames["index"].tolist()) - submapped if pipeline.fusion.at_end else set()
        for frame in pipeline.fusion.store.frames(apart):
            self._write(frame)  # as tracked
        results[0].provenance["notices"] += [notice.as_json() for notice in pipeline.notices + notices]
        return replace(results[0], others=results[1:])

    def _fused(self, number: int, submaps: list[Submap]) -> Reconstruction:
        """Correct, write and fuse the frames of a submap."""
        trim_memory()
        sequence, pipeline, submap = self.run.sequence, self.run.pipeline, submaps[number]
        config, store = pipeline.config, pipeline.fusion.store
        final = FinalFrames(submap, self._stored_poses(submap), store.frame)
        frames, at_s = frames_of_submap(number, submaps, self.frames), config.fusion.surface_at_s
        states = _states(submap, frames.only(frames.tracked), at_s)
        depths = self._triangulated_depths(final, states)
        with closing(depths) if depths is not None else nullcontext():
            views = views_among(list(final.T_world_camera)) if config.fusion.constants.free_space else []
            free_space: FreeSpace = self.run.clock.timed("free space", FreeSpace, final.frames(None, among=views))
            triangulated = None if depths is None else depths.depth
            corrected = in_thread(final.frames(triangulated, free_space.without), "correct")
            # Of the frames that the largest depth was chosen from, so that it cannot contradict itself.
            median_mm = store.median_depth_mm(submap.main_frames if pipeline.fusion.at_end else (), submap.depth_factor)
            moving = MovingTissue(block_edge_mm(median_mm))
            state, seen_at = None if states is None else SurfaceState(states), None
            if at_s is not None:
                # What one curve does not explain is as the frames around that second have it.
                at_rest = final.frames(None) if state is None else map(state.fused, final.frames(None))
                seen_at = SeenAt(at_rest, at_s, block_edge_mm(median_mm))
            checked = self.run.checked.pop(submap.main, SpreadFrames())
            all_frames = sum(len(submap.frames) for submap in submaps)
            written = self._written(corrected, checked, moving, all_frames)
            for part in (state, seen_at):
                written = written if part is None else map(part.fused, written)
            seen = in_thread(written, "write")
            with closing(seen):
                fused: FusedSurface = self.run.clock.timed("fuse", pipeline.fusion.fuse, seen, median_mm, submap.main)
        fused = replace(fused, mesh=self.run.clock.timed("finish mesh", finished, fused.mesh, fused.settings))
        fused.mesh.vertex_attributes["moving"] = moving.shares(fused.mesh.vertices).astype(np.float32)
        looking, check = (checked.frames(store), states), partial(self.run.clock.timed, "check surface")
        agreement = check(surface_agreement, fused.mesh, fused.settings, *looking)
        fused.mesh.vertex_attributes["sigma_mm"] = check(vertex_sigmas, fused.mesh, *looking)
        provenance = provenance_of(sequence, pipeline.estimators, self.run.clock.seconds, frames)
        adjusted = pipeline.odometry.notices(submap.main) if submap.correction is None else submap.correction.notices
        confirmed = bool(adjusted) or pipeline.estimators.anchor.is_measured
        notices = self.notices + motion_notices(frames, config, confirmed=confirmed) + adjusted
        notices += [part.notice for part in (state, seen_at, depths) if part is not None] + fused.notices
        notices += [] if free_space.notice is None else [free_space.notice]
        masks, known_mm = pipeline.estimators.masks, self.frames["median_depth_mm"]
        notices += [] if masks is None else masks.notices
        medians_mm = known_mm[np.isfinite(known_mm)].tolist() if median_mm is None else [median_mm]
        notices += depth_notices(medians_mm, fused.settings)
        provenance["notices"] += [notice.as_json() for notice in notices]
        provenance["surface"] = agreement
        provenance["loops"] = [] if submap.correction is None else submap.correction.loop_frames
        config = config.model_copy(update={"fusion": fused.settings})
        source_camera, sigma_px = sequence.rectifier.source, sequence.focal_sigma_px
        return Reconstruction(
            sequence.camera,
            frames,
            with_normals_alone(fused.mesh),
            config,
            provenance,
            source_camera,
            sequence.skipped,
            sigma_px,
            states=states,
        )

    def _stored_poses(self, submap: Submap) -> dict[int, np.ndarray]:
        """Return the poses (4, 4) as tracked, by number, of the submap's frames that wait for fusion."""
        if not self.run.pipeline.fusion.at_end:
            return {}
        poses = zip(self.frames["index"].tolist(), self.frames["T_world_camera"], strict=True)
        return {index: T_world_camera for index, T_world_camera in poses if index in submap.frames}

    def _triangulated_depths(self, final: FinalFrames, states: TissueStates | None) -> KeyframeDepths | None:
        """Return what triangulates the depth of a submap's keyframes; None where nothing can."""
        config, flow = self.run.pipeline.config, self.run.pipeline.estimators.keyframe_flow
        used = bool(self.run.writers) or config.fusion.enabled
        if not (used and config.mapping.constants.triangulate_depth and final.keyframes) or flow.name == "none":
            return None
        camera = self.run.sequence.camera
        return KeyframeDepths(final.view, final.T_world_camera, final.keyframes, camera, flow, states)

    def _written(
        self, frames: Iterator[Frame], checked: SpreadFrames, moving: MovingTissue, count: int
    ) -> Iterator[Frame]:
        """Yield the final frames of a submap, written; `checked` keeps some, `moving` counts; count : of all."""
        for frame in frames:
            if frame.nonrigidity is not None and frame.T_world_camera is not None:
                usable_mm = np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
                moving.put(usable_mm, frame.nonrigidity, frame.camera, frame.T_world_camera)
            checked.put(frame)
            self._write(frame)
            yield frame
            self._done += 1
            self.run.progress("fusing", self._done, count)

    def _write(self, frame: Frame) -> None:
        for write in self.run.writers:
            write(frame)


def _states(submap: Submap, tracked: FrameTable, at_s: float | None) -> TissueStates | None:
    """Return the states of a submap's tissue at its frames where it moves, that of the surface next to a second."""
    correction = submap.correction
    if correction is None or correction.tissue is None:
        return None
    motion, index = correction.tissue.deformation, tracked["index"]
    curves = np.column_stack([np.interp(index, correction.index, curve) for curve in motion.basis.T])
    states = TissueStates(motion.nodes, motion.modes, index, tracked["time_s"], curves, curves[0])
    return states.with_reference(at_s)


class Clock:
    """Seconds spent per part; parts in different threads overlap."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._compiled_before_s = compiling_s()

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of the parts so far, and of all; those of compiling kernels are in other parts, too."""
        compiled_s = compiling_s() - self._compiled_before_s
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
    """Return how long this process has compiled kernels that no cache held, s."""
    return float(_COMPILING.duration) if _COMPILING.done else 0.0


def in_thread(items: Iterable[_Item], thread: str, count: int = 2) -> Generator[_Item, None, None]:
    """Yield items in order, computed in a thread of their own, at most `count` ahead of their use.

    thread : its name. An error of an item is raised where the item would come. Closed early, the thread ends after the
    item that it computes.
    """
    source = iter(items)
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix=thread)
    try:
        coming = deque(worker.submit(next, source, _END) for _ in range(count))
        while (item := coming.popleft().result()) is not _END:
            coming.append(worker.submit(next, source, _END))
            yield item  # type: ignore[misc]
    finally:
        worker.shutdown(cancel_futures=True)
        if hasattr(source, "close"):
            source.close()


def overlapped(
    frames: Iterator[Frame], pipeline: Pipeline, clock: Clock, ahead: int = 2, states: RunStates | None = None
) -> Iterator[Step]:
    """Yield the steps of all frames; each stage but the last runs in a thread of its own, `ahead` frames ahead."""

    def stage(part: str, call: Callable[[Any], Any], items: Iterable[Any]) -> Generator[Any, None, None]:
        def results() -> Iterator[Any]:
            for item, due in items:
                result = clock.timed(part, call, item)
                if due and states is not None:
                    states.keep(part)
                yield result, due

        return in_thread(results(), part, ahead)

    read = iter(partial(clock.timed, "read", next, frames, None), None)
    marked = ((frame, states is not None and states.due()) for frame in read)
    steps = stage(
        "track", pipeline.track, stage("match", pipeline.match, stage("preprocess", pipeline.estimate, marked))
    )
    with closing(steps):
        for step, due in steps:
            clock.timed("store or fuse", pipeline.fuse, step)
            yield step
            if due and states is not None:
                states.commit(step.frame.index)
