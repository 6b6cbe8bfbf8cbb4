"""The runner: passes a sequence through the pipeline and collects the result.

The stages of the pipeline overlap: while a frame is fused in this thread, later ones are read and go through the
networks, are matched, and tracked, each in a thread of its own. So do the stages after the last frame.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from scopemap.config import Config
from scopemap.estimators import compiling_s, largest_depth_mm
from scopemap.frame import Frame, Rows
from scopemap.fusion.agreement import surface_agreement
from scopemap.fusion.finish import finished
from scopemap.fusion.frame_store import FrameStore
from scopemap.fusion.moving_tissue import MovingTissue, SeenAt, block_edge_mm
from scopemap.fusion.surface_fusion import FusedSurface, depth_notices
from scopemap.io.checksums import input_checksum, write_checksums
from scopemap.io.result_folder import NOT_OF_THE_RESULT, STORED, check_result_folder, result_folder
from scopemap.io.sequence import Sequence
from scopemap.mapping.multiview_depth import KeyframeDepths
from scopemap.mapping.submaps import FinalFrames, Submap
from scopemap.notices import Notice
from scopemap.odometry import Step
from scopemap.pipeline import Pipeline
from scopemap.reconstruction import DepthWriter, FrameRecord, Reconstruction, notices_of_frames
from scopemap.runner.backwards import track_backwards
from scopemap.runner.checkpoints import Checkpoints, can_resume, identity_of, input_changes
from scopemap.runner.frame_surfaces import SurfaceWriter
from scopemap.runner.memory import MemoryPlan, memory_plan
from scopemap.runner.preparation import Progress, prepare
from scopemap.runner.provenance import Limits, motion_notices, provenance_of, refuse_own_input
from scopemap.runner.records import FrameRecords, check_tracked, records_of
from scopemap.tracking.track import FrameTracker, Track

Observer = Callable[[Step], bool | None]
"""Called with each step; True: no further frame is read, and the result is of the frames until then."""
_Item = TypeVar("_Item")
_END = object()
_CHECKED_FRAMES = 16  # most frames of a submap at which its surface is rendered again
_NO_STORE = "or set mapping.method=none and fusion.voxel_mm: then no frame is stored"


def reconstruct(
    sequence: Sequence,
    config: Config | None = None,
    *,
    out: Path | str | None = None,
    overwrite: bool = False,
    observers: tuple[Observer, ...] = (),
    progress: Progress = lambda doing, done, total: None,
    tracker: FrameTracker | None = None,
) -> Reconstruction:
    """Turn a sequence into poses, depth and a surface.

    A run of the same input, settings and versions that was killed in `out` is resumed from its checkpoint, to the same
    result. Observers that are methods of an object with an attribute `NOT_IN_CHECKPOINT` are resumed and saved with it.

    The settings in the result are the resolved ones: the TSDF parameters are numbers.
    Of several submaps the one with most frames is the result, and `others` holds the others.
    Raises `InputError` where no frame could be tracked, and what the estimators raise for missing weights.

    Parameters
    ----------
    sequence : from `open_sequence`.
    config : settings, by default the preset `default`.
    out : folder for the result; None keeps it in memory, without depth maps. Where the run fails it stays as it was.
    overwrite : replace an earlier run there, once the new one is whole.
    observers : called with each `Step`, whose pose and depth are as tracked, before the back end; one that returns
        True ends the run early, with the frames that were read until then.
    tracker : replaces the one of `config.tracking`; its keyframes are adjusted, too, unless `config.mapping.method` is
        "none".
    progress : called before the first frame and after the last one.
    """
    clock = Clock()
    config = config or Config()
    if out is not None:
        memory_plan(config, sequence)  # that it is refused early
        refuse_own_input(Path(out), sequence, config)
        check_result_folder(Path(out), overwrite=overwrite)  # before the input is hashed
    identity = {} if out is None else identity_of(sequence, config, tracker)
    with result_folder(out, overwrite=overwrite, can_resume=partial(can_resume, identity=identity)) as folder:
        store = FrameStore(folder, _NO_STORE, "" if folder is None else STORED)
        sequence, config, estimators, notices = prepare(sequence, config, clock.timed, progress)
        write = None if folder is None else DepthWriter(folder, largest_depth_mm(config, estimators))
        with closing(store):
            run = Run(sequence, config, Pipeline(config, estimators, store, tracker), clock, write, progress)
            if folder is not None and config.tracking.camera_at_rest:
                run.write_surface = SurfaceWriter(folder, config, estimators)
            if folder is None:
                run.track(observers)
            else:
                _track_with_checkpoints(run, observers, folder, identity)
            result = run.result(notices)
        changes = input_changes(identity, result.provenance["input_content"], sequence.path)
        result.provenance["notices"] += [notice.as_json() for notice in changes]
        del run  # with its keyframes and volumes: a long run has none to spare when it writes
        if folder is not None and write is not None:
            progress("writing", 0, 0)
            write.finish(scale_known=result.provenance["scale"]["known"])
            result.save(folder)
            for owner in _kept_with(observers):
                owner.save(folder)
            write_checksums(folder, without=NOT_OF_THE_RESULT)
    return result


def _track_with_checkpoints(run: Run, observers: tuple[Observer, ...], folder: Path, identity: dict[str, Any]) -> None:
    with closing(Checkpoints(folder, identity, run, _kept_with(observers))) as checkpoints:
        run.track(observers, checkpoints)


def _kept_with(observers: tuple[Observer, ...]) -> tuple[Any, ...]:
    """Return the objects that observe a run by a method, and are resumed and saved with it."""
    owners = (getattr(observer, "__self__", None) for observer in observers)
    return tuple(owner for owner in owners if hasattr(owner, "NOT_IN_CHECKPOINT"))


@dataclass
class Run:
    """One run: the pipeline, and the results collected from it."""

    sequence: Sequence
    config: Config
    pipeline: Pipeline
    clock: Clock
    write: DepthWriter | None
    progress: Progress
    write_surface: SurfaceWriter | None = None
    stopped: bool = False
    interrupted: bool = False
    records: FrameRecords = field(init=False)
    plan: MemoryPlan = field(init=False)
    median_depths_mm: Rows = field(default_factory=lambda: Rows(np.dtype(np.float64)))
    limits: Limits = field(default_factory=Limits)
    resumed_after: int | None = None
    forgotten: int = 0
    map: int = 0
    frames_of_map: Counter[int] = field(default_factory=Counter)
    final_frames: int = 0
    final_done: int = 0
    checked: dict[int, _SpreadFrames] = field(default_factory=lambda: defaultdict(_SpreadFrames))

    def __post_init__(self) -> None:
        self.records = FrameRecords(self.pipeline.fusion.store.table)
        self.plan = memory_plan(self.config, self.sequence)
        self.pipeline.fusion.coarser_beyond = self.plan.blocks
        self.pipeline.mapper.limit(self.plan.observations)

    def track(self, observers: tuple[Observer, ...], checkpoints: Checkpoints | None = None) -> None:
        """Pass all frames through the pipeline, those after the last checkpoint."""
        last, complete = -1, False
        if checkpoints is not None and checkpoints.exist:
            last, complete = checkpoints.restore()
            self.resumed_after = last
            self.progress("resuming", len(self.records), 0)
        frames = iter(()) if complete else self._frames(last)
        for step in overlapped(frames, self.pipeline, self.clock, self.plan.ahead, checkpoints):
            self.take(step)
            for observer in observers:
                self.stopped = bool(observer(step)) or self.stopped
        if checkpoints is not None and len(self.records) and not (complete or self.interrupted):
            checkpoints.commit_all(self.records.last_index)

    def take(self, step: Step) -> None:
        """Collect the results of a step."""
        some_mm = step.refined.depth_mm[::4, ::4]
        if np.isfinite(some_mm).any():
            self.median_depths_mm.append(np.array([np.nanmedian(some_mm)]))
        if not self.pipeline.fusion.at_end:
            self._write_depth(step.frame)
        if self.pipeline.fusion.at_once:
            self.checked[step.track.map].put(step.frame)
        self.records.append(FrameRecord.of(step))
        self._keep_within_limits(step.track)

    def _keep_within_limits(self, track: Track) -> None:
        """Forget what is beyond the limits."""
        fusion, most = self.pipeline.fusion, self.limits
        fusion.most_blocks = most.blocks
        self.frames_of_map[track.map] += track.status != "lost"
        left, self.map = track.map != self.map, track.map
        if (left and most.maps is not None) or fusion.is_full:
            others = [number for number, _ in self.frames_of_map.most_common() if number != self.map]
            for number in others[0 if fusion.is_full else most.maps :]:
                fusion.forget(number)
                self.checked.pop(number, None)
        if most.frames is not None and len(self.records) > most.frames:
            older = self.records.thin()
            self.median_depths_mm.keep(np.arange(len(self.median_depths_mm)) % 2 == 0)
            self.pipeline.mapper.forget(older)
            self.forgotten += len(older)

    def _frames(self, after: int) -> Iterator[Frame]:
        """Yield the frames after one until an observer asks for a stop."""
        for frame in self.sequence.frames(after):
            if self.stopped:
                self.interrupted = True
                return
            yield frame

    def result(self, prepared: list[Notice]) -> Reconstruction:
        """Return the reconstruction of the largest submap with those of the others. Raises `InputError` without one."""
        records = self.records.read()
        check_tracked(records, self.sequence.path)
        records = self.clock.timed("track backwards", self._after_going_back, records)
        self.progress("adjusting keyframes", 0, 0)
        submaps, notices = self.clock.timed("back end", self.pipeline.mapper.submaps)
        self.final_frames = sum(len(submap.frames) for submap in submaps)
        results = [
            self._fuse_submap(records_of(n, submaps, records), submaps[n], prepared) for n in range(len(submaps))
        ]
        submapped = {index for submap in submaps for index in submap.frames}
        for frame in self.pipeline.fusion.store.frames({r.index for r in records if r.index not in submapped}):
            self._write_depth(frame)  # as tracked
        last = self.records.last_index if self.interrupted else None
        notices = self.pipeline.notices + notices + notices_of_frames(results[0].records, last)
        results[0].provenance["interrupted_at_frame"] = last
        results[0].provenance["resumed_after_frame"] = self.resumed_after
        results[0].provenance["input_content"] = self.clock.timed("hash input", input_checksum, self.sequence.path)
        if self.forgotten:
            notices.append(Notice("frames-forgotten", {"frames": self.forgotten, "kept": self.limits.frames}))
        results[0].provenance["notices"] += [notice.as_json() for notice in notices]
        return replace(results[0], others=results[1:])

    def _after_going_back(self, records: list[FrameRecord]) -> list[FrameRecord]:
        """Return the records after lost frames were tracked from the frames after them."""
        tracks = track_backwards(self.pipeline, [record.track for record in records])
        return [
            record if track is record.track else replace(record, track=track, T_world_camera=track.T_world_camera)
            for record, track in zip(records, tracks, strict=True)
        ]

    def _fuse_submap(self, records: list[FrameRecord], submap: Submap, notices: list[Notice]) -> Reconstruction:
        """Correct, write and fuse the frames of a submap, whose records these are."""
        sequence, pipeline = self.sequence, self.pipeline
        store = pipeline.fusion.store
        final = FinalFrames(submap, store.poses(submap.frames), store.frame)
        depths = self._triangulated_depths(final)
        with closing(depths) if depths is not None else nullcontext():
            corrected = _ahead(final.frames(None if depths is None else depths.depth), "correct")
            # Of the frames that the largest depth was chosen from, so that it cannot contradict itself.
            median_mm = store.median_depth_mm(submap.main_frames)
            moving, at_s = MovingTissue(block_edge_mm(median_mm)), self.config.fusion.surface_at_s
            seen_at = None if at_s is None else SeenAt(final.frames(None), at_s, block_edge_mm(median_mm))
            written = self._written(corrected, submap.main, moving)
            frames = _ahead(written if seen_at is None else map(seen_at.weighted, written), "write")
            with closing(frames):
                fused: FusedSurface = self.clock.timed(
                    "fuse", pipeline.fusion.fuse, frames, submap.main_frames, submap.main
                )
        fused = replace(fused, mesh=self.clock.timed("finish mesh", finished, fused.mesh, fused.settings))
        fused.mesh.vertex_attributes["moving"] = moving.shares(fused.mesh.vertices).astype(np.float32)
        checked = self.checked.pop(submap.main, _SpreadFrames()).frames
        agreement = self.clock.timed("check surface", surface_agreement, fused.mesh, fused.settings, checked)
        provenance = provenance_of(sequence, pipeline.estimators, self.clock.seconds, records)
        found = notices + self.plan.notices + motion_notices(records, self.config)
        found += [part.notice for part in (seen_at, submap.correction, depths) if part is not None] + fused.notices
        masks = pipeline.estimators.masks
        found += [] if masks is None else masks.notices
        medians_mm = self.median_depths_mm.read().tolist() if median_mm is None else [median_mm]
        found += depth_notices(medians_mm, fused.settings)
        provenance["notices"] += [notice.as_json() for notice in found]
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

    def _written(self, frames: Iterator[Frame], main: int, moving: MovingTissue) -> Iterator[Frame]:
        """Yield the final frames of a submap, their depth written; keep some, at which its surface is checked.

        moving : counts them all.
        """
        for frame in frames:
            if frame.nonrigidity is not None and frame.T_world_camera is not None:
                usable_mm = np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
                moving.put(usable_mm, frame.nonrigidity, frame.camera, frame.T_world_camera)
            self.checked[main].put(frame)
            yield self._write_depth(frame)
            self.final_done += 1
            self.progress("fusing", self.final_done, self.final_frames)

    def _write_depth(self, frame: Frame) -> Frame:
        """Write the final depth of a frame, and its surface where each has one of its own."""
        if self.write is not None:
            self.write(frame)
        if self.write_surface is not None and frame.T_world_camera is not None:
            self.write_surface(frame)
        return frame


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


def _ahead(items: Iterable[_Item], thread: str, count: int = 2) -> Generator[_Item, None, None]:
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
    frames: Iterator[Frame], pipeline: Pipeline, clock: Clock, ahead: int = 2, states: Checkpoints | None = None
) -> Iterator[Step]:
    """Yield the steps of all frames; each stage but the last runs in a thread of its own, `ahead` frames ahead."""

    def stage(part: str, call: Callable[[Any], Any], items: Iterable[Any]) -> Generator[Any, None, None]:
        def results() -> Iterator[Any]:
            for item, due in items:
                result = clock.timed(part, call, item)
                if due and states is not None:
                    states.keep(part)
                yield result, due

        return _ahead(results(), part, ahead)

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
