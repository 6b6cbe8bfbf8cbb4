"""Writes checkpoints during a run, and brings a run that is resumed to where the last one was made."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import astuple
from pathlib import Path
from typing import Any, Protocol

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.fusion.frame_store import check_stored
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Step
from scopemap.engine.pipeline import Pipeline
from scopemap.input.sequence import Sequence
from scopemap.input.source import SkippedFrame
from scopemap.result.checkpoint import discard_checkpoint, has_checkpoint, read_checkpoint, write_checkpoint
from scopemap.result.checksums import input_checksum
from scopemap.result.frame_table import GrowingFrameTable
from scopemap.result.result_folder import STORED, UNFINISHED
from scopemap.runner.observers import LastingObserver
from scopemap.runner.provenance import package_versions
from scopemap.runner.tracking_log import TrackingLog, replay

# Writing takes a 50th of the time, unless that is less often than once a minute: so much is done again at most.
_SHARE = 0.02
_LEAST_S = 10.0
_MOST_S = 60.0
_SHOWN_DIFFERENCES = 4


class ResumableRun(Protocol):
    """A run, and what it is made of."""

    sequence: Sequence
    pipeline: Pipeline
    frames: GrowingFrameTable

    def replay(self, step: Step) -> None:
        """Collect the results of a step whose row is there."""


class Checkpoints:
    """Writes checkpoints of a run as it goes, and brings another run to where the last one was made.

    A checkpoint says up to which frame the stored frames, the table of frames and the tracking log count, and has what
    does not follow from these. The stages of the pipeline are some frames apart: the record of each is made when a
    certain frame has passed it.

    folder : of the unfinished run. identity : what a run must have in common with this one to resume it, as JSON holds
    it. start : what goes with the checkpoint, as JSON holds it. observers : that take the steps of a resumed run again.
    Raises `InputError` where a checkpoint is damaged, and where it cannot be written or read.
    """

    def __init__(
        self,
        folder: Path,
        identity: dict[str, Any],
        run: ResumableRun,
        start: dict[str, Any] | None = None,
        observers: tuple[LastingObserver, ...] = (),
    ) -> None:
        self._folder, self._identity, self._run = folder, identity, run
        self._start, self._observers = start or {}, observers
        run.pipeline.fusion.keeps_frames = True
        self._log = TrackingLog(run.pipeline.fusion.store)
        self._records = dict[str, dict[str, Any]]()
        self._begun_s = time.perf_counter()
        self._first_s = self._next_s = self._begun_s + _LEAST_S
        self._open, self._seconds = False, 0.0

    @property
    def exist(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return has_checkpoint(self._folder)

    def take(self, step: Step) -> None:
        """Take each step of the run, in order."""
        self._log.take(step)

    def due(self) -> bool:
        """Return whether the frame that is read now should be one after which a checkpoint is written."""
        now = time.perf_counter()
        if self._open or now < self._next_s:
            return False
        self._open, self._begun_s, self._seconds = True, now, 0.0
        return True

    def keep(self, stage: str) -> None:
        """Make the record of a stage of the pipeline, called in the thread that changes it."""
        started = time.perf_counter()
        self._records[stage] = self._run.pipeline.stages[stage].record()
        self._seconds += time.perf_counter() - started

    def commit(self, last: int, *, complete: bool = False) -> None:
        """Write the checkpoint after the frame `last`, `complete`: after all frames."""
        started = time.perf_counter()
        with reporting("cannot write the stored frames"):
            stored = self._run.pipeline.fusion.store.record()
        record = {"identity": self._identity, "last": last, "complete": complete, "start": self._start}
        if complete:  # else found again where the frames are read again
            record["input"] = _input_record(self._run.sequence)
        write_checkpoint(self._folder, record | {"stored": stored, "stages": self._records})
        self._seconds += time.perf_counter() - started
        # A run that is killed just before the next commit has lost the time between two frames and that of writing.
        most_s = _MOST_S - (time.perf_counter() - self._begun_s)
        self._next_s = self._begun_s + min(max(_LEAST_S, self._seconds / _SHARE), most_s)
        self._open, self._records = False, {}

    def commit_all(self, last: int, *, stopped: bool, complete: bool) -> None:
        """Write the checkpoint after the last frame that was read, when no stage is at work.

        stopped : the run ends with it; else that of a short run is not worth it. complete : no further frame follows.
        """
        if time.perf_counter() < self._first_s and not stopped:
            return
        for stage in self._run.pipeline.stages:
            self.keep(stage)
        self.commit(last, complete=complete)

    def restore(self) -> tuple[int, bool]:
        """Bring the run to where the checkpoint was made; return the last frame and whether it was that of all."""
        run = self._run
        with reporting("cannot resume from the checkpoint; --no-resume starts again"):
            record = read_checkpoint(self._folder)
            run.pipeline.fusion.store.resume(record["stored"])
            if record["complete"]:
                _resume_input(run.sequence, record["input"])
            steps = self._log.steps(run.frames.read(), run.sequence.camera)
            for step in replay(run.pipeline, record["stages"], steps):
                run.replay(step)
                for observer in self._observers:
                    observer.again(step)
        return int(record["last"]), bool(record["complete"])


def _input_record(sequence: Sequence) -> dict[str, Any]:
    """Return what was found while all frames were read, as JSON holds it."""
    source, skipped = sequence.source, (sequence.choice.skipped, sequence.source.left_out)
    left_out = [[astuple(frame) for frame in frames.values()] for frames in skipped]
    return {"warnings": said_as_json(source.warnings), "left_out": left_out, "resized": [*source.resized.items()]}


def _resume_input(sequence: Sequence, record: dict[str, Any]) -> None:
    source = sequence.source
    source.warnings[:] = said_of_json(record["warnings"])
    for frames, found in zip((sequence.choice.skipped, source.left_out), record["left_out"], strict=True):
        frames.update({facts[0]: SkippedFrame(*facts) for facts in found})
    source.resized.update(dict(record["resized"]))


def said_as_json(said: Iterable[str | Notice]) -> list[Any]:
    """Return texts and notices as JSON holds them."""
    return [[one.code, dict(one.values)] if isinstance(one, Notice) else one for one in said]


def said_of_json(found: Iterable[Any]) -> list[str | Notice]:
    """Return what `said_as_json` was given."""
    return [one if isinstance(one, str) else Notice(*one) for one in found]


def identity_of(sequence: Sequence, config: Config, tracker: object = None) -> dict[str, Any]:
    """Return what two runs have in common that have the same result, as JSON holds it."""
    kind, _, folder = config.depth.backend.partition(":")
    content, masks = input_checksum(sequence.path), config.mask.files or sequence.source.masks
    own_files = {
        "mask.files": "" if masks in (None, "none") else masks,
        "depth.model": config.depth.model,
        "depth.anchor_model": config.depth.anchor_model,
        "depth files": folder if kind == "files" else "",
        "second view": config.input.second_view or "",
    }
    facts = {
        # What is too large to be recognised by its content is recognised by its place.
        "input": content if "sha256" in content else content | {"path": str(sequence.path.resolve())},
        "frames": str(sequence.selection),
        "camera": f"{sequence.rectifier.source} at {sequence.camera.width}x{sequence.camera.height}",
        "tracker": type(tracker).__name__,
        "pair": str(sequence.pair),
    }
    # Names of weights on a hub are no files: the hashes of theirs are pinned.
    facts |= {f"content of {name}": input_checksum(Path(file)) for name, file in own_files.items() if file}
    groups = config.model_dump(mode="json", exclude={"preset"})
    return (
        facts
        | {f"{group}.{key}": value for group, part in groups.items() for key, value in part.items()}
        | package_versions()
    )


def input_changes(identity: dict[str, Any], content: dict[str, Any], path: Path) -> list[Notice]:
    """Return a notice where an input with this `input_checksum` is not that of an identity; {} : not known."""
    before = {name: value for name, value in identity.get("input", content).items() if name != "path"}
    return [] if before == content else [Notice("input-changed", {"path": str(path)})]


def can_resume(folder: Path, identity: dict[str, Any], damage: list[str]) -> bool:
    """Return whether a folder holds a whole checkpoint of a run that would have the same result.

    `damage` takes why one is not whole: the run then starts again.
    """
    try:
        with reporting(f"cannot read the checkpoint in {folder}"):
            record = read_checkpoint(folder)
            if not record or _differences(record, identity):
                return False
            check_stored(folder / STORED, record["stored"]["files"])
    except InputError as fault:
        damage.append(str(fault))
        return False
    return True


def check_resumable(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where what a killed run left in `out` is damaged, or with what makes the result another."""
    if not has_checkpoint(out / UNFINISHED):
        return
    identity, found = identity_of(sequence, config), list[str]()
    if not can_resume(out / UNFINISHED, identity, found) and not found:
        found = _differences(read_checkpoint(out / UNFINISHED), identity)
    if found:
        raise InputError(
            f"cannot resume the run in {out}: {'; '.join(found[:_SHOWN_DIFFERENCES])}; --no-resume begins a new one"
        )


def check_finishable(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where `out` holds nothing to make a result of without another frame."""
    if not has_checkpoint(out / UNFINISHED):
        raise InputError(
            f"cannot finish the run in {out}: no stopped run has kept anything there; run it without --finish"
        )
    check_resumable(out, sequence, config)


def discard_unfinished(out: Path) -> None:
    """Have the next run in `out` begin anew."""
    discard_checkpoint(out / UNFINISHED)


def _differences(record: dict[str, Any], identity: dict[str, Any]) -> list[str]:
    """Return in words in what a run with this record of its checkpoint differs from one with this identity."""
    before = record.get("identity", identity)
    names = [name for name in sorted({*before, *identity}) if before.get(name) != identity.get(name)]
    return [_difference(name, before.get(name), identity.get(name)) for name in names]


def _difference(name: str, before: Any, now: Any) -> str:
    if name == "input" or name.startswith("content of "):
        return f"the {name} has changed"
    was, is_now = ("not set" if value in (None, "") else value for value in (before, now))
    return f"{name} was {was}, and is {is_now}"
