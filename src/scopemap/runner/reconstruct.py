"""`reconstruct`, what users call: prepares a run, resumes it where one was killed, and writes its result."""

from __future__ import annotations

from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

from scopemap.engine.config import Config
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.kept import kept
from scopemap.engine.notices import Notice
from scopemap.engine.pipeline import Pipeline
from scopemap.engine.tracking.track import FrameTracker
from scopemap.input.frame_choice import selection_text, slice_of
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.report.depth_figures import DepthPreviews
from scopemap.report.notebook_progress import in_notebook, notebook_progress
from scopemap.result.checksums import write_checksums
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.result import Result
from scopemap.result.result_folder import NOT_OF_THE_RESULT, STORED, check_result_folder, result_folder
from scopemap.result.run_input import stated_input
from scopemap.result.verdict import state_verdict
from scopemap.runner.checkpoints import Checkpoints, can_resume, identity_of, input_changes
from scopemap.runner.estimators import largest_depth_mm
from scopemap.runner.frame_surfaces import SurfaceWriter
from scopemap.runner.memory import memory_plan
from scopemap.runner.preparation import prepare
from scopemap.runner.provenance import refuse_own_input
from scopemap.runner.run import Clock, FinalFrameObserver, FrameWriter, KeptObserver, Observer, Progress, Run

_NO_STORE = "or set mapping.method=none and fusion.voxel_mm: then no frame is stored"


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

    A run of the same input, settings and versions that was killed in `out` is resumed from its checkpoint, to the same
    result; if that is damaged the run starts again, which a notice reports. So it does where a `tracker` of your own
    keeps nothing (`Kept`). Observers of the kind `KeptObserver` are resumed and saved with it.

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
        True ends the run early, with the frames that were read until then.
    tracker : replaces the one of `config.tracking`; its keyframes are adjusted, too, unless `config.mapping.method` is
        "none".
    progress : called before the first frame and after the last one; None: a notebook shows how far the run is.
    """
    config = Config.chosen(config)
    if isinstance(sequence, Path | str):
        sequence = open_sequence(sequence, settings=config.input)
    folder = None if out is None else Path(out)
    with ExitStack() as stack:
        if progress is None and in_notebook():
            observe, progress = stack.enter_context(notebook_progress(sequence.used_count))
            observers += (observe,)
        progress = progress or (lambda doing, done, total: None)
        return _reconstruct(sequence, config, folder, overwrite, observers, progress, tracker)


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
    config = _with_selection(config, sequence)
    plan = memory_plan(config, sequence)
    if out is not None:
        refuse_own_input(out, sequence, config)
        check_result_folder(out, overwrite=overwrite)  # before the input is hashed
    identity, damage = {} if out is None else identity_of(sequence, config, tracker), list[str]()
    resumes = partial(can_resume, identity=identity, damage=damage)
    with result_folder(out, overwrite=overwrite, can_resume=resumes) as folder:
        for reason in damage:
            progress(f"starting again: {reason}", 0, 0)
        store = FrameStore(folder, _NO_STORE, "" if folder is None else STORED)
        sequence, config, estimators, notices = prepare(sequence, config, clock.timed, progress)
        notices = [Notice("checkpoint-damaged", {"reason": reason}) for reason in damage] + notices
        write_depth = None if folder is None else DepthWriter(folder, largest_depth_mm(config, estimators))
        previews = None if folder is None else DepthPreviews(folder)
        writers: tuple[FrameWriter, ...] = tuple(each for each in (write_depth, previews) if each is not None)
        if folder is not None and config.tracking.camera_at_rest:
            writers += (SurfaceWriter(folder, config, estimators),)
        writers += tuple(observer.final for observer in observers if isinstance(observer, FinalFrameObserver))
        lasting = tuple(observer for observer in observers if isinstance(observer, KeptObserver))
        with closing(store):
            pipeline = Pipeline(config, estimators, store, tracker)
            run = Run(sequence, pipeline, clock, writers, progress, plan)
            place = folder if tracker is None or kept(tracker.__class__) else None
            # Without a name, since it holds the run, which goes before the result is written.
            run.track(observers, None if place is None else Checkpoints(place, identity, run, lasting))
            result = run.result(notices)
        result.provenance.update(stated_input(sequence.path, None if out is None else Path(out)))
        changes = input_changes(identity, result.provenance["input_content"], sequence.path)
        result.provenance["notices"] += [notice.as_json() for notice in changes]
        state_verdict(result)
        del run, pipeline  # with their keyframes and volumes: a long run has none to spare when it writes
        if folder is not None and write_depth is not None and previews is not None:
            progress("writing", 0, 0)
            scale_known = result.provenance["scale"]["known"]
            if range_mm := write_depth.finish(scale_known=scale_known):
                previews.finish(range_mm, scale_known=scale_known)
            result.save(folder)
            for observer in lasting:
                observer.save(folder)
            write_checksums(folder, without=NOT_OF_THE_RESULT)
    return result if out is None else Result(out)


def _with_selection(config: Config, sequence: Sequence) -> Config:
    """Return the settings that choose the frames of the sequence: those in the result repeat the run."""
    if slice_of(config.input.frames or None) == sequence.selection:
        return config
    chosen = config.input.model_copy(update={"frames": selection_text(sequence.selection)})
    return config.model_copy(update={"input": chosen})
