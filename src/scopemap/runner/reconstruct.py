"""`reconstruct`, what users call: prepares a run, resumes it where one was killed, and writes its result."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import astuple, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scopemap.engine.config import Config
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.notices import Notice
from scopemap.engine.pipeline import Pipeline
from scopemap.engine.tracking.track import FrameTracker, ResumableTracker
from scopemap.input.frame_choice import selection_text, slice_of
from scopemap.input.sequence import Sequence
from scopemap.result.checkpoint import discard_checkpoint, read_checkpoint
from scopemap.result.checksums import write_checksums
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.result import Result
from scopemap.result.result_folder import NOT_OF_THE_RESULT, STORED, check_result_folder, result_folder
from scopemap.result.run_input import stated_input
from scopemap.result.verdict import state_verdict
from scopemap.result.wording import facts_of_notices
from scopemap.runner.checkpoints import (
    Checkpoints,
    can_resume,
    identity_of,
    input_changes,
    said_as_json,
    said_of_json,
)
from scopemap.runner.estimators import largest_depth_mm
from scopemap.runner.lens_of_motion import MOST_PASSES, OtherLens, lens_of_motion, lenses_of
from scopemap.runner.memory import MemoryPlan, memory_plan
from scopemap.runner.observers import (
    FinalFrameObserver,
    FrameWriter,
    LastingObserver,
    Observer,
    Progress,
    RestartedObserver,
)
from scopemap.runner.preparation import prepare
from scopemap.runner.provenance import refuse_own_input
from scopemap.runner.run import Clock, Run

if TYPE_CHECKING:
    from scopemap.report.depth_figures import DepthPreviews


def reconstruct(
    sequence: Sequence | Path | str,
    config: Config | str | None = None,
    *,
    out: Path | str | None = None,
    overwrite: bool = False,
    observers: tuple[Observer, ...] = (),
    progress: Progress | None = None,
    tracker: FrameTracker | None = None,
) -> Result:
    """Turn a sequence, or a video, into poses, depth and a surface.

    A run of the same input, settings and versions that was killed in `out` is resumed: from the frames that it has
    stored, to the same result within noise. If these are damaged the run starts again, which a notice reports. So it
    does where a `tracker` of your own is no `ResumableTracker`. Observers of the kind `LastingObserver` take the stored
    frames again, and are saved with the result.

    Where nobody has given the lens and the motion of all keyframes fits another focal length clearly better, the run
    begins again at its first frame with that one, at most twice; it does not with a `tracker`. Observers then see the
    frames again; those of the kind `RestartedObserver` forget the earlier ones.

    The settings in the result are the resolved ones: the TSDF parameters are numbers. Of several submaps the one with
    most frames is the result, and `others` holds the others. With `out` the result is read from that folder.
    Raises `InputError` where no frame could be tracked, and what the estimators raise for missing weights.

    Parameters
    ----------
    sequence : from `open_sequence`; or the path of a video or folder that is opened with the settings' `input`.
    config : settings, or the name of a preset; by default the preset `default`.
    out : folder for the result; None keeps it in memory, without depth maps. Where the run fails it stays as it was.
    overwrite : replace an earlier run there, once the new one is whole.
    observers : called with each `Step`, whose pose and depth are as tracked, before the back end; one that returns
        True ends the run early, with the frames that were read until then; one that raises `RunStopped` ends it
        without a result, to be resumed after them.
    tracker : replaces the one of `config.tracking`; its keyframes are adjusted, too, unless `config.mapping.method` is
        "none".
    progress : called before the first frame and after the last one; None: a notebook shows how far the run is, and the
        summary picture of its result.
    """
    config = Config.chosen(config)
    if isinstance(sequence, Path | str):
        from scopemap.input.opening import open_sequence  # readers of all formats

        sequence = open_sequence(sequence, settings=config.input)
    folder = None if out is None else Path(out)
    show: Callable[[Result], None] | None = None
    with ExitStack() as stack:
        if progress is None:
            from scopemap.report.notebook import in_notebook, notebook_progress, show_summary

            if in_notebook():
                observe, progress = stack.enter_context(notebook_progress(sequence.used_count))
                observers += (observe,)
                show = show_summary
        progress = progress or (lambda doing, done, total: None)
        result = _reconstruct(sequence, config, folder, overwrite, observers, progress, tracker)
    if show is not None:
        show(result)
    return result


def _reconstruct(
    sequence: Sequence,
    config: Config,
    out: Path | None,
    overwrite: bool,
    observers: tuple[Observer, ...],
    progress: Progress,
    tracker: FrameTracker | None,
) -> Result:
    clock = Clock()
    config = _of_camera(_with_selection(config, sequence), sequence, tracker)
    plan = memory_plan(config, sequence)
    if out is not None:
        refuse_own_input(out, sequence, config)
        check_result_folder(out, overwrite=overwrite)  # before the input is hashed
    identity, damage = {} if out is None else identity_of(sequence, config, tracker), list[str]()
    resumes = partial(can_resume, identity=identity, damage=damage)
    with result_folder(out, overwrite=overwrite, can_resume=resumes) as folder:
        for reason in damage:
            progress(f"starting again: {reason}", 0, 0)
        notices = [Notice("checkpoint-damaged", {"reason": reason}) for reason in damage]
        passes = _Passes(config, clock, folder, observers, progress, tracker, plan, identity, notices)
        result, written = passes.result(sequence)
        result.provenance.update(stated_input(sequence.path, None if out is None else Path(out)))
        changes = input_changes(identity, result.provenance["input_content"], sequence.path)
        result.provenance["notices"] += facts_of_notices(changes)
        state_verdict(result)
        if folder is not None and written is not None:
            progress("writing", 0, 0)
            written.finish(scale_known=result.provenance["scale"]["known"])
            result.save(folder)
            for observer in passes.lasting:
                observer.save(folder)
            write_checksums(folder, without=NOT_OF_THE_RESULT)
    return result if out is None else Result(out)


@dataclass(frozen=True)
class _DepthPictures:
    """What writes the depth of each frame, and pictures of it."""

    depth: DepthWriter
    previews: DepthPreviews

    def finish(self, *, scale_known: bool) -> None:
        """Write what takes the depths of all frames."""
        if range_mm := self.depth.finish(scale_known=scale_known):
            self.previews.finish(range_mm, scale_known=scale_known)


@dataclass
class _PassStart:
    """What a pass begins with that the call does not name; written with its checkpoint, for it to be resumed.

    number : 1 for the first. lens : of the sequence in place of its own. config : settings as resolved by the pass
    before, JSON. warnings : of the source until then. notices : of the run until then.
    """

    number: int = 1
    lens: OtherLens | None = None
    config: str = ""
    warnings: list[str | Notice] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> _PassStart:
        """Return what `record` was made of; {} : of no checkpoint."""
        if not record:
            return cls()
        lens, (warnings, notices) = record["lens"], record["said"]
        found = None if lens is None else OtherLens(lens[0], lens[1], lens[2], tuple(lens[3]))
        said: list[Any] = said_of_json(notices)
        return cls(record["number"], found, record["config"], said_of_json(warnings), said)

    def record(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        lens = None if self.lens is None else astuple(self.lens)
        said = said_as_json(self.warnings), said_as_json(self.notices)
        return {"number": self.number, "lens": lens, "config": self.config, "said": said}


@dataclass(frozen=True)
class _Again:
    """What another pass begins with: another lens, and the settings as resolved."""

    lens: OtherLens
    config: Config


@dataclass(frozen=True)
class _Passes:
    """Passes of a run through its frames: another one where the motion contradicts a lens that nobody has given.

    What a pass has in memory goes with it: a long run has none to spare when it writes. notices : so far.
    """

    config: Config
    clock: Clock
    folder: Path | None
    observers: tuple[Observer, ...]
    progress: Progress
    tracker: FrameTracker | None
    plan: MemoryPlan
    identity: dict[str, Any]
    notices: list[Notice]

    @property
    def lasting(self) -> tuple[LastingObserver, ...]:
        """The observers that are resumed and saved with the run."""
        return tuple(observer for observer in self.observers if isinstance(observer, LastingObserver))

    def result(self, sequence: Sequence) -> tuple[Result, _DepthPictures | None]:
        """Return the result of the last pass, and what has written its depth."""
        passes, saved = self, {} if self.folder is None else read_checkpoint(self.folder)
        start = _PassStart.of_record(saved.get("start", {}))
        if start.lens is not None:
            sequence.source.warnings[:] = start.warnings
            sequence = start.lens.seen_by(sequence)
            passes = replace(self, config=Config.model_validate_json(start.config))
            self.notices[:] = start.notices
        while isinstance(found := passes._pass(sequence, start), _Again):
            # What was decided before the first frame stays decided.
            sequence, passes = found.lens.seen_by(sequence), replace(self, config=found.config)
            warnings, settings = list(sequence.source.warnings), found.config.model_dump_json()
            start = _PassStart(start.number + 1, found.lens, settings, warnings, list(self.notices))
            # It is of the pass before.
            if self.folder is not None:
                discard_checkpoint(self.folder)
            for observer in self.observers:
                if isinstance(observer, RestartedObserver):
                    observer.forget()
            from scopemap.report.progress_meter import TRACKING_AGAIN

            self.progress(f"{TRACKING_AGAIN}, lens {sequence.camera_source}", 0, 0)
        return found

    def _pass(self, sequence: Sequence, start: _PassStart) -> tuple[Result, _DepthPictures | None] | _Again:
        """Return the result of a sequence, and what has written its depth; or what to begin again with."""
        folder = self.folder
        store = FrameStore(folder, "" if folder is None else STORED)
        sequence, config, estimators, prepared = prepare(sequence, self.config, self.clock.timed, self.progress)
        self.notices.extend(prepared)
        writers: tuple[FrameWriter, ...] = ()
        written = None
        if folder is not None:
            from scopemap.report.depth_figures import DepthPreviews

            written = _DepthPictures(DepthWriter(folder, largest_depth_mm(config, estimators)), DepthPreviews(folder))
            writers = written.depth, written.previews
            if config.tracking.camera_at_rest:
                from scopemap.runner.frame_surfaces import SurfaceWriter

                writers += (SurfaceWriter(folder, config, estimators),)
        writers += tuple(observer.final for observer in self.observers if isinstance(observer, FinalFrameObserver))
        with closing(store):
            pipeline = Pipeline(config, estimators, store, self.tracker)
            pipeline.mapper.try_lenses(lenses_of(sequence, config, again=start.number > 1))
            run = Run(sequence, pipeline, self.clock, writers, self.progress, self.plan)
            checkpoints = None
            if folder is not None and isinstance(self.tracker, ResumableTracker | None):
                checkpoints = Checkpoints(folder, self.identity, run, start.record(), self.lasting)
            run.track(self.observers, checkpoints)
            # A tracker of the caller cannot begin again, and who stops a run waits for its end.
            if start.number < MOST_PASSES and self.tracker is None and not run.stopped:
                other = lens_of_motion(sequence, config, run.lens, again=start.number > 1)
                if other is not None:
                    return _Again(other, config)
            return run.result(self.notices), written


def _with_selection(config: Config, sequence: Sequence) -> Config:
    """Return the settings that choose the frames of the sequence: those in the result repeat the run."""
    if slice_of(config.input.frames or None) == sequence.selection:
        return config
    chosen = config.input.model_copy(update={"frames": selection_text(sequence.selection)})
    return config.model_copy(update={"input": chosen})


def _of_camera(config: Config, sequence: Sequence, tracker: FrameTracker | None) -> Config:
    """Return the settings with a camera at rest where the data set states that and the settings leave it open.

    Pictures cannot tell: where tissue moves as a whole, no part of them stands still. A tracker of the caller decides
    by itself.
    """
    stated = config.tracking.camera_at_rest
    if stated is not None or tracker is not None or not sequence.source.camera_at_rest:
        return config
    tracking = config.tracking.model_copy(update={"camera_at_rest": True})
    return Config.model_validate(dict(config) | {"tracking": tracking})
