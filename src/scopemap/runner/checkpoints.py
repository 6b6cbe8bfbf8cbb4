"""Writes checkpoints during a run, and resumes a run from the last one."""

from __future__ import annotations

import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Protocol

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, reporting
from scopemap.engine.fusion.frame_store import StoredFile, check_stored
from scopemap.engine.notices import Notice
from scopemap.engine.pipeline import Pipeline
from scopemap.input.sequence import Sequence
from scopemap.result.checkpoint import CHECKPOINT, SavedState
from scopemap.result.checksums import input_checksum
from scopemap.result.result_folder import STORED, UNFINISHED
from scopemap.runner.provenance import package_versions

# A checkpoint is due after so many seconds, and so long after the last one that they take a 50th of the time.
_LEAST_S = 10.0
_SHARE = 0.02
_RUN = ("frames", "checked", "kept_maps", "writers")
_SHOWN_DIFFERENCES = 4


class HasState(Protocol):
    """A run: what its attributes `_RUN` hold, and its pipeline."""

    sequence: Sequence
    pipeline: Pipeline


class Checkpoints:
    """Writes the state of a run as it goes, and restores it.

    The stages of the pipeline are some frames apart: the state of each is written when a certain frame has passed it,
    so that together they are the state of the run after that frame.

    folder : where the file is. identity : what a run must have in common with this one to resume it, as JSON holds it.
    kept : further objects that go with the run, such as observers. Raises `InputError` as `SavedState` does.
    """

    def __init__(self, folder: Path, identity: dict[str, Any], run: HasState, kept: tuple[object, ...] = ()) -> None:
        self._file = SavedState(folder / CHECKPOINT)
        self._identity, self._run, self._kept = identity, run, kept
        self._first_s = self._next_s = time.perf_counter() + _LEAST_S
        self._open = False

    @property
    def exist(self) -> bool:
        """Whether there is a state to go on with."""
        return bool(self._file.facts)

    def due(self) -> bool:
        """Return whether the frame that is read now should be one after which the state is written."""
        if self._open or time.perf_counter() < self._next_s:
            return False
        self._open, self._file.seconds = True, 0.0
        return True

    def keep(self, stage: str) -> None:
        """Write the state of a stage of the pipeline, called in the thread that changes it."""
        if stage == "track":
            self._run.pipeline.mapper.settle()
        self._file.put(stage, self._stage(stage))

    def commit(self, last: int, *, complete: bool = False) -> None:
        """Write the rest; the state of the run is now that after the frame `last`, `complete`: after all frames."""
        with reporting("cannot write the stored frames"):
            self._run.pipeline.fusion.store.sync()
        self._file.put("run", self._rest())
        self._file.commit({"identity": self._identity, "last": last, "complete": complete})
        self._next_s, self._open = time.perf_counter() + max(_LEAST_S, self._file.seconds / _SHARE), False

    def commit_all(self, last: int) -> None:
        """Write the state after all frames, when no stage is at work; that of a short run is not worth it."""
        if time.perf_counter() < self._first_s:
            return
        for stage in self._run.pipeline.stages:
            self.keep(stage)
        self.commit(last, complete=True)

    def restore(self) -> tuple[int, bool]:
        """Bring the run to the state that was committed last; return the last frame and whether it was that of all."""
        with reporting("cannot resume from the checkpoint; --no-resume starts again"):
            return self._restored()

    def _restored(self) -> tuple[int, bool]:
        pipeline, facts = self._run.pipeline, self._file.facts
        for stage, owner in pipeline.stages.items():
            for name, value in self._file.restore(stage, self._stage(stage)).items():
                setattr(owner, name, value)
        found = self._file.restore("run", self._rest())
        for name in _RUN:
            setattr(self._run, name, found[name])
        self._run.sequence.choice.skipped.update(found["skipped"])
        if facts["complete"]:
            self._run.sequence.source.warnings[:] = found["warnings"]
        pipeline.fusion.store.reopen()
        return int(facts["last"]), bool(facts["complete"])

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _stage(self, stage: str) -> dict[str, Any]:
        owner = self._run.pipeline.stages[stage]
        return {name: getattr(owner, name) for name in owner.STATE}

    def _rest(self) -> dict[str, Any]:
        sequence = self._run.sequence
        found = {name: getattr(self._run, name) for name in _RUN}
        read = {"skipped": dict(sequence.choice.skipped), "warnings": list(sequence.source.warnings)}
        return found | read | {"fusion": self._run.pipeline.fusion, "kept": self._kept}


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
    if not (folder / CHECKPOINT).is_file():
        return False
    try:
        with reporting(f"cannot read the checkpoint in {folder}"), closing(SavedState(folder / CHECKPOINT)) as file:
            if not file.facts or _differences(file.facts, identity):
                return False
            check_stored(folder / STORED, file.check(StoredFile))
    except InputError as fault:
        damage.append(str(fault))
        return False
    return True


def check_resumable(out: Path, sequence: Sequence, config: Config) -> None:
    """Raise `InputError` where what a killed run left in `out` is damaged, or with what makes the result another."""
    if not (out / UNFINISHED / CHECKPOINT).is_file():
        return
    identity, found = identity_of(sequence, config), list[str]()
    if not can_resume(out / UNFINISHED, identity, found) and not found:
        with closing(SavedState(out / UNFINISHED / CHECKPOINT)) as file:
            found = _differences(file.facts, identity)
    if found:
        raise InputError(
            f"cannot resume the run in {out}: {'; '.join(found[:_SHOWN_DIFFERENCES])}; --no-resume begins a new one"
        )


def discard_unfinished(out: Path) -> None:
    """Have the next run in `out` begin anew."""
    with suppress(FileNotFoundError):
        (out / UNFINISHED / CHECKPOINT).unlink()


def _differences(facts: dict[str, Any], identity: dict[str, Any]) -> list[str]:
    """Return in words in what a run with these facts of its checkpoint differs from one with this identity."""
    before = facts.get("identity", identity)
    names = [name for name in sorted({*before, *identity}) if before.get(name) != identity.get(name)]
    return [f"{name} was {before.get(name)}, is {identity.get(name)}" for name in names]
