"""Writes checkpoints during a run, and resumes a run from the last one."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.fusion.frame_store import check_stored
from scopemap.engine.notices import Notice
from scopemap.engine.pipeline import Pipeline
from scopemap.input.sequence import Sequence
from scopemap.result.checkpoint import SavedState, discard_checkpoint, has_checkpoint
from scopemap.result.checksums import input_checksum
from scopemap.result.result_folder import STORED, UNFINISHED
from scopemap.runner.observers import FrameWriter
from scopemap.runner.provenance import package_versions

# Writing takes a 50th of the time, unless that is less often than once a minute: so much is done again at most.
_SHARE = 0.02
_LEAST_S = 10.0
_MOST_S = 60.0
_SHOWN_DIFFERENCES = 4


class ResumableRun(Protocol):
    """A run, which keeps something itself, and what it is made of."""

    sequence: Sequence
    pipeline: Pipeline
    writers: tuple[FrameWriter, ...]


class Checkpoints:
    """Writes the state of a run as it goes, and restores it.

    The stages of the pipeline are some frames apart: the state of each is written when a certain frame has passed it,
    so that together they are the state of the run after that frame.

    folder : of the unfinished run. identity : what a run must have in common with this one to resume it, as JSON holds
    it. others : what goes with the run, by name. Raises `InputError` as `SavedState` does.
    """

    def __init__(
        self, folder: Path, identity: dict[str, Any], run: ResumableRun, others: Mapping[str, object] | None = None
    ) -> None:
        self._state = SavedState(folder)
        self._identity, self._run = identity, run
        sequence, fusion = run.sequence, run.pipeline.fusion
        own = {"run": run, "fusion": fusion, "frame choice": sequence.choice, "source": sequence.source}
        own |= {f"writer {number}": writer for number, writer in enumerate(run.writers)}
        self._others = own | dict(others or {})
        self._begun_s = time.perf_counter()
        self._first_s = self._next_s = self._begun_s + _LEAST_S
        self._open = False

    @property
    def exist(self) -> bool:
        """Whether there is a state to go on with."""
        return bool(self._state.facts)

    def due(self) -> bool:
        """Return whether the frame that is read now should be one after which the state is written."""
        now = time.perf_counter()
        if self._open or now < self._next_s:
            return False
        self._open, self._begun_s, self._state.seconds = True, now, 0.0
        return True

    def keep(self, stage: str) -> None:
        """Write the state of a stage of the pipeline, called in the thread that changes it."""
        if stage == "track":
            self._run.pipeline.mapper.settle()
        self._state.put(stage, self._run.pipeline.stages[stage])

    def commit(self, last: int, *, complete: bool = False) -> None:
        """Write the rest; the state of the run is now that after the frame `last`, `complete`: after all frames."""
        with reporting("cannot write the stored frames"):
            self._run.pipeline.fusion.store.sync()
        for name, owner in self._others.items():
            self._state.put(name, owner)
        self._state.commit({"identity": self._identity, "last": last, "complete": complete})
        # A run that is killed just before the next commit has lost the time between two frames and that of writing.
        most_s = _MOST_S - (time.perf_counter() - self._begun_s)
        self._next_s = self._begun_s + min(max(_LEAST_S, self._state.seconds / _SHARE), most_s)
        self._open = False

    def commit_all(self, last: int, *, stopped: bool, complete: bool) -> None:
        """Write the state after the last frame that was read, when no stage is at work.

        stopped : the run ends with it; else that of a short run is not worth it. complete : no further frame follows.
        """
        if time.perf_counter() < self._first_s and not stopped:
            return
        for stage in self._run.pipeline.stages:
            self.keep(stage)
        self.commit(last, complete=complete)

    def restore(self) -> tuple[int, bool]:
        """Bring the run to the state that was committed last; return the last frame and whether it was that of all."""
        facts = self._state.facts
        with reporting("cannot resume from the checkpoint; --no-resume starts again"):
            for name, owner in (self._run.pipeline.stages | self._others).items():
                # What reading frames finds is found again where they are read again.
                if name != "source" or facts["complete"]:
                    self._state.restore(name, owner)
            self._run.pipeline.fusion.store.reopen()
        return int(facts["last"]), bool(facts["complete"])


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
    state = SavedState(folder)
    try:
        with reporting(f"cannot read the checkpoint in {folder}"):
            if not state.facts or _differences(state.facts, identity):
                return False
            check_stored(folder / STORED, state.check())
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
        found = _differences(SavedState(out / UNFINISHED).facts, identity)
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


def _differences(facts: dict[str, Any], identity: dict[str, Any]) -> list[str]:
    """Return in words in what a run with these facts of its checkpoint differs from one with this identity."""
    before = facts.get("identity", identity)
    names = [name for name in sorted({*before, *identity}) if before.get(name) != identity.get(name)]
    return [_difference(name, before.get(name), identity.get(name)) for name in names]


def _difference(name: str, before: Any, now: Any) -> str:
    if name == "input" or name.startswith("content of "):
        return f"the {name} has changed"
    was, is_now = ("not set" if value in (None, "") else value for value in (before, now))
    return f"{name} was {was}, and is {is_now}"
