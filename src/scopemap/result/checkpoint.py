"""The checkpoint of a run: a folder with its state as JSON and arrays, which any tool opens.

    checkpoint/  state.json  {"sum": ..., "facts": ..., "state": {part: {attribute: value}}}
                 5f3c....npy (an array, named by the BLAKE2b sum of the file)

A file with an array never changes, so one that two states share is written once. The state is that of `state.json`,
which replaces the one before by renaming: it is written whole or not at all.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, Literal
from weakref import WeakValueDictionary

import numpy as np

from scopemap.engine.errors import InputError, reporting
from scopemap.engine.kept import restore, state_of

CHECKPOINT = "checkpoint"
"""Name of the folder within the folder of an unfinished run."""

_STATE = "state.json"
_NEW = "new"  # a file until it is whole
_WITHIN_JSON_BYTES = 2048  # a pose has 128
_FILE_BYTES = 16 << 20  # of a volume that grows only what changed is written again


def has_checkpoint(unfinished: Path) -> bool:
    """Return whether the folder of an unfinished run holds a state to go on with, which may be damaged."""
    return (unfinished / CHECKPOINT / _STATE).is_file()


def discard_checkpoint(unfinished: Path) -> None:
    """Have nothing resume from the folder of an unfinished run. Raises `OSError`."""
    (unfinished / CHECKPOINT / _STATE).unlink(missing_ok=True)


class SavedState:
    """The state of a run by parts, in the folder of an unfinished run; valid when all are committed.

    Raises `InputError` where it is damaged, and where it cannot be written or read.
    """

    def __init__(self, unfinished: Path) -> None:
        self._folder = unfinished / CHECKPOINT
        self._writing = Lock()
        self._parts: dict[str, Any] = {}
        self._used: set[str] = set()
        self._whole: set[str] = set()  # of the files with arrays: what else there is a run has left that was killed
        self._new: list[Path] = []
        self._shared = WeakValueDictionary[str, np.ndarray]()
        self._committed: dict[str, Any] | None = None
        self.seconds = 0.0
        """How long writing took so far."""

    @property
    def facts(self) -> dict[str, Any]:
        """Facts as committed last; {} where nothing was."""
        found: dict[str, Any] = self._document.get("facts", {})
        return found

    def put(self, part: str, owner: object) -> None:
        """Write what an object keeps as a part of the state, to be committed with the others."""
        started = time.perf_counter()
        with self._writing, self._reported():
            self._folder.mkdir(exist_ok=True)
            self._parts[part] = state_of(owner, self._put)
        self.seconds += time.perf_counter() - started

    def commit(self, facts: dict[str, Any]) -> None:
        """Make what was put the state of the run, with facts that JSON can hold."""
        started = time.perf_counter()
        text = _text({"facts": facts, "state": self._parts})
        with self._writing, self._reported():
            new = self._folder / _NEW
            new.write_bytes(f'{{"sum": "{_sum(text)}", '.encode() + text[1:])
            _sync([*self._new, new])
            new.replace(self._folder / _STATE)
            for file in self._folder.glob("*.npy"):
                if file.name not in self._used:
                    file.unlink()
        self._whole, self._used, self._new = self._used, set(), []
        self._parts, self._committed = {}, None
        self.seconds += time.perf_counter() - started

    def restore(self, part: str, owner: object) -> None:
        """Give an object what it kept in a part of the committed state; without such a part it stays as it is."""
        if part in self._document["state"]:
            restore(owner, self._document["state"][part], self._array)

    def check(self) -> list[dict[str, Any]]:
        """Return what `StoredFile`s keep in the committed state, all of which is read."""
        nodes = list(_nodes(self._document))
        for name in {name for node in nodes for name in node.get("npy", ())}:
            self._read(name)
        return [node for node in nodes if "crc" in node]

    @property
    def _document(self) -> dict[str, Any]:
        """What `state.json` holds; {} where there is none."""
        if self._committed is None and (self._folder / _STATE).is_file():
            with reporting(f"the checkpoint {self._folder} is damaged: {_STATE}"):
                found = json.loads((self._folder / _STATE).read_bytes())
                is_whole = found.pop("sum") == _sum(_text(found))
            if not is_whole:
                raise self._damaged(_STATE)
            self._committed = found
        return self._committed or {}

    def _put(self, array: np.ndarray) -> dict[str, Any]:
        """Write an array, in files where it is large; return what JSON holds of it."""
        if array.nbytes <= _WITHIN_JSON_BYTES and array.dtype.kind in "biuf":
            order: Literal["C", "F"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
            flat = [value if math.isfinite(value) else str(value) for value in array.ravel(order).tolist()]
            return {"dtype": array.dtype.str, "shape": array.shape, "order": order, "values": flat}
        parts = [array]
        if array.nbytes > _FILE_BYTES:
            rows = max(1, _FILE_BYTES * len(array) // array.nbytes)
            parts = [array[start : start + rows] for start in range(0, len(array), rows)]
        return {"npy": [self._put_file(part) for part in parts]}

    def _put_file(self, array: np.ndarray) -> str:
        content = io.BytesIO()
        np.save(content, array, allow_pickle=False)
        name = f"{_sum(content.getbuffer())}.npy"
        if name not in self._whole:
            (self._folder / _NEW).write_bytes(content.getbuffer())
            (self._folder / _NEW).replace(self._folder / name)
            self._new.append(self._folder / name)
            self._whole.add(name)
        self._used.add(name)
        return name

    def _array(self, stored: dict[str, Any], *, shared: bool = False) -> np.ndarray:
        if "values" in stored:
            flat = np.array(stored["values"], stored["dtype"])
            return flat.reshape(stored["shape"], order=stored["order"])
        key = "".join(stored["npy"])
        if shared and key in self._shared:
            return self._shared[key]
        parts = [self._read(name) for name in stored["npy"]]
        # Of one part a copy, which owns its data: volumes grow in place.
        found = parts[0].copy(order="K") if len(parts) == 1 else np.concatenate(parts)
        if shared:
            self._shared[key] = found
        return found

    def _read(self, name: str) -> np.ndarray:
        with self._reported():
            content = (self._folder / name).read_bytes()
        if f"{_sum(content)}.npy" != name:
            raise self._damaged(name)
        self._whole.add(name)
        found: np.ndarray = np.load(io.BytesIO(content), allow_pickle=False)
        return found

    def _damaged(self, name: str) -> InputError:
        return InputError(f"the checkpoint {self._folder} is damaged: {name}")

    @contextmanager
    def _reported(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(f"cannot write or read the checkpoint {self._folder}: {error.strerror or error}") from None


def _sync(files: list[Path]) -> None:
    """Have the disk hold files: many at once take hardly longer than one."""

    def sync(file: Path) -> None:
        with file.open("rb+") as opened:
            os.fsync(opened.fileno())

    with ThreadPoolExecutor(max_workers=16, thread_name_prefix="sync") as pool:
        list(pool.map(sync, files))


def _text(document: dict[str, Any]) -> bytes:
    return json.dumps(document, allow_nan=False).encode()


def _sum(content: bytes | memoryview) -> str:
    return hashlib.blake2b(content, digest_size=20).hexdigest()


def _nodes(tree: Any) -> Iterator[dict[str, Any]]:
    """Yield all objects of a JSON document."""
    if isinstance(tree, dict):
        yield tree
        tree = list(tree.values())
    for part in tree if isinstance(tree, list) else ():
        yield from _nodes(part)
