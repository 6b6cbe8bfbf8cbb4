"""The checkpoint of a run: the state of its objects in one SQLite file, written whole or not at all.

Structure of objects is JSON, arrays are blobs by hash; no code. What is no number, text, array, container or object of
scopemap's classes (a network, a file, a thread) is not stored: the objects restored keep theirs.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import sqlite3
import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from enum import Enum
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np

from scopemap.engine.config.settings import Settings
from scopemap.engine.errors import InputError

CHECKPOINT = "checkpoint.sqlite"
"""Name of the file within the folder of an unfinished run."""

_TABLES = """
create table if not exists facts (name text primary key, value text not null);
create table if not exists states (name text primary key, tree text not null);
create table if not exists blobs (hash blob, part integer, bytes blob not null, primary key (hash, part));
"""
_DIGESTS = "digests"
_SUM = "sum"
_PART_BYTES = 64 << 20  # SQLite's blobs end at 1 GB
_OWN = "scopemap."
_OUTSIDE: dict[str, Any] = {"outside": True}
_PLAIN = (list, tuple, set, frozenset, deque, dict, Counter, defaultdict)
_NAMES = {kind.__name__: kind for kind in _PLAIN}


def is_committed(file: Path) -> bool:
    """Return whether a file holds a state to go on with."""
    if not file.is_file():
        return False
    try:
        with closing(SavedState(file)) as checkpoint:
            return bool(checkpoint.facts)
    except InputError:
        return False


class SavedState:
    """The state of a run by parts, valid when all are committed; `InputError` where `file` is damaged or read-only."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._writing = Lock()
        self._hashes: set[bytes] = set()
        self._digests: dict[str, str] = {}
        self.seconds = 0.0
        self._opened: sqlite3.Connection | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """Facts as committed last; {} where nothing was. Raises `InputError` where they are damaged."""
        if not self._file.is_file():
            return {}
        with self._reported():
            rows = dict(self._database.execute("select * from facts").fetchall())
        if rows and rows.pop(_SUM, None) != _sum_of(rows):
            raise self._damaged()
        return {name: json.loads(value) for name, value in rows.items()}

    def put(self, part: str, value: object) -> None:
        """Write the state of a part, to be committed with the others."""
        started = time.perf_counter()
        with self._writing, self._reported():
            if not self._database.in_transaction:
                self._database.execute("begin")
            tree = json.dumps(_Writer(self._put_blob).tree(value))
            self._digests[part] = _digest(tree.encode()).hex()
            self._database.execute("insert or replace into states values (?, ?)", (part, tree))
        self.seconds += time.perf_counter() - started

    def commit(self, facts: dict[str, Any]) -> None:
        """Make what was put the state of the run, with facts that JSON can hold."""
        started = time.perf_counter()
        with self._writing, self._reported():
            facts = facts | {_DIGESTS: self._digests}
            rows = {name: json.dumps(value) for name, value in facts.items()}
            rows[_SUM] = _sum_of(rows)
            self._database.execute("delete from facts")
            self._database.executemany("insert into facts values (?, ?)", rows.items())
            known = {row[0] for row in self._database.execute("select distinct hash from blobs")}
            old = [(key,) for key in known - self._hashes]
            self._database.executemany("delete from blobs where hash = ?", old)
            self._database.execute("commit")
            self._hashes = set()
        self.seconds += time.perf_counter() - started

    def restore(self, part: str, value: object) -> Any:
        """Return the committed state of a part, with what is not stored from `value`, whose objects are changed."""
        return _Reader(self._blob).value(self._tree(part), value)

    def check(self, kind: type) -> list[dict[str, Any]]:
        """Return the attributes of all objects of one of scopemap's classes, by name, as JSON holds them.

        Raises `InputError` where anything in the checkpoint is damaged.
        """
        name, blobs, found = _name_of(kind), set[str](), []
        for part in self.facts[_DIGESTS]:
            for node in _nodes(self._tree(part)):
                blobs |= {node[key] for key in ("blob", "bytes") if key in node}
                found += [node["attributes"]] if node.get("of") == name else []
        for blob in blobs:
            self._blob(blob)
        return found

    def close(self) -> None:
        """Close the file."""
        if self._opened is not None:
            self._opened.close()

    @property
    def _database(self) -> sqlite3.Connection:
        if self._opened is None:
            self._opened = sqlite3.connect(self._file, check_same_thread=False, isolation_level=None)
            self._opened.executescript(_TABLES)
        return self._opened

    def _put_blob(self, content: bytes | memoryview) -> str:
        key = _digest(content)
        if key not in self._hashes:
            self._hashes.add(key)
            if self._database.execute("select 1 from blobs where hash = ?", (key,)).fetchone() is None:
                starts = range(0, max(1, len(content)), _PART_BYTES)
                parts = ((key, n, content[start : start + _PART_BYTES]) for n, start in enumerate(starts))
                self._database.executemany("insert into blobs values (?, ?, ?)", parts)
        return key.hex()

    def _blob(self, name: str) -> bytes:
        query = "select bytes from blobs where hash = ? order by part"
        with self._reported():
            content = b"".join(row[0] for row in self._database.execute(query, (bytes.fromhex(name),)))
        self._check(content, name)
        return content

    def _tree(self, part: str) -> Any:
        with self._reported():
            row = self._database.execute("select tree from states where name = ?", (part,)).fetchone()
        tree = str(row[0]) if row else ""
        self._check(tree.encode(), self.facts[_DIGESTS].get(part, ""))
        return json.loads(tree)

    def _check(self, content: bytes, digest: str) -> None:
        if _digest(content).hex() != digest:
            raise self._damaged()

    def _damaged(self) -> InputError:
        return InputError(f"the checkpoint {self._file} is damaged")

    @contextmanager
    def _reported(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            if self._opened is not None:
                with suppress(sqlite3.Error):
                    self._opened.rollback()
            raise InputError(f"cannot write or read the checkpoint {self._file}: {error}") from None


def _nodes(tree: Any) -> Iterator[dict[str, Any]]:
    """Yield what `_Writer` has made of each object in a tree."""
    if isinstance(tree, dict):
        yield tree
        tree = [part for key, item in tree.items() for part in (item.values() if key == "attributes" else [item])]
    for part in tree if isinstance(tree, list) else ():
        yield from _nodes(part)


def _sum_of(rows: dict[str, str]) -> str:
    return _digest(repr(sorted(rows.items())).encode()).hex()


def _digest(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=20).digest()


class _Writer:
    """Turns objects into a tree that JSON can hold; an object that is met again is referred to by its number."""

    def __init__(self, put_blob: Any) -> None:
        self._put_blob = put_blob
        self._numbers: dict[int, int] = {}
        self._met: list[object] = []  # so that no number is given twice

    def tree(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, Enum):
            return {"member": value.value, "of": _name_of(type(value))}
        if isinstance(value, np.generic):
            return {"scalar": value.dtype.str, "hex": value.tobytes().hex()}
        if isinstance(value, type):
            return {"class": _name_of(value)} if _is_known(value) else _OUTSIDE
        if isinstance(value, Settings):
            return {"settings": _name_of(type(value)), "json": value.model_dump_json()}
        if id(value) in self._numbers:
            return {"again": self._numbers[id(value)]}
        if not (_is_known(type(value)) or isinstance(value, np.ndarray | bytes | Path)):
            return _OUTSIDE
        self._numbers[id(value)] = len(self._met)
        self._met.append(value)
        return self._shared(value)

    def _shared(self, value: Any) -> dict[str, Any]:
        if isinstance(value, np.ndarray):
            order: Literal["C", "F"] = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
            blob = self._put_blob(value.ravel(order=order).view(np.uint8).data if value.size else b"")
            return {"array": value.dtype.str, "shape": value.shape, "order": order, "blob": blob}
        if isinstance(value, bytes):
            return {"bytes": self._put_blob(value)}
        if isinstance(value, Path):
            return {"path": str(value)}
        name = _name_of(type(value))
        if isinstance(value, dict):
            items = [[self.tree(key), self.tree(item)] for key, item in value.items()]
            factory = self.tree(value.default_factory) if isinstance(value, defaultdict) else None
            return {"of": name, "items": items, "factory": factory}
        if isinstance(value, list | tuple | set | frozenset | deque):
            longest = value.maxlen if isinstance(value, deque) else None
            return {"of": name, "values": [self.tree(item) for item in value], "longest": longest}
        return {"of": name, "attributes": {key: self.tree(item) for key, item in _attributes(value).items()}}


class _Reader:
    """Turns a tree back into objects, those that exist already in place."""

    def __init__(self, blob: Any) -> None:
        self._blob = blob
        self._met: list[Any] = []

    def value(self, tree: Any, now: Any) -> Any:
        if not isinstance(tree, dict):
            return tree
        if "outside" in tree:
            return now
        if "again" in tree:
            return self._met[tree["again"]]
        if "member" in tree:
            return _class_of(tree["of"])(tree["member"])
        if "scalar" in tree:
            return np.frombuffer(bytes.fromhex(tree["hex"]), tree["scalar"])[0]
        if "class" in tree:
            return _class_of(tree["class"])
        if "settings" in tree:
            return _class_of(tree["settings"]).model_validate_json(tree["json"])
        number = len(self._met)
        self._met.append(None)
        return self._shared(tree, now, number)

    def _shared(self, tree: dict[str, Any], now: Any, number: int) -> Any:
        if "array" in tree:
            flat = np.frombuffer(self._blob(tree["blob"]), tree["array"])
            # A copy owns its data: volumes grow in place.
            found: Any = flat.reshape(tree["shape"], order=tree["order"]).copy(order="K")
        elif "bytes" in tree:
            found = self._blob(tree["bytes"])
        elif "path" in tree:
            found = Path(tree["path"])
        else:
            found = self._own(tree, now, number)
        self._met[number] = found
        return found

    def _own(self, tree: dict[str, Any], now: Any, number: int) -> Any:
        kind = _class_of(tree["of"])
        now = now if type(now) is kind else None
        if "items" in tree:
            found = kind()
            if kind is defaultdict:
                found.default_factory = self.value(tree["factory"], getattr(now, "default_factory", None))
            self._met[number] = found
            for key, item in tree["items"]:
                key = self.value(key, None)
                found[key] = self.value(item, None if now is None else now.get(key))
            return found
        if "values" in tree:
            counterparts = [*(now or ())] if kind in (list, tuple) or hasattr(kind, "_fields") else []
            counterparts += [None] * (len(tree["values"]) - len(counterparts))
            values = [self.value(item, other) for item, other in zip(tree["values"], counterparts, strict=False)]
            if hasattr(kind, "_fields"):
                return kind(*values)
            return deque(values, tree["longest"]) if kind is deque else kind(values)
        found = kind.__new__(kind) if now is None else now
        self._met[number] = found
        for name, item in tree["attributes"].items():
            # Frozen classes forbid the usual way.
            object.__setattr__(found, name, self.value(item, getattr(now, name, None)))
        return found


def _attributes(value: object) -> dict[str, Any]:
    """Return what an object holds by name, without what its class excludes in `NOT_IN_CHECKPOINT`."""
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    held = {name: getattr(value, name) for name in slots if hasattr(value, name)} | getattr(value, "__dict__", {})
    return {name: item for name, item in held.items() if name not in getattr(value, "NOT_IN_CHECKPOINT", ())}


def _is_known(kind: type) -> bool:
    return kind in _PLAIN or kind.__module__.startswith(_OWN)


def _name_of(kind: type) -> str:
    return kind.__name__ if kind in _PLAIN else f"{kind.__module__}:{kind.__qualname__}"


def _class_of(name: str) -> Any:
    """Return a class by its name. Raises `InputError` where it is none of scopemap's."""
    if name in _NAMES:
        return _NAMES[name]
    module, _, path = name.partition(":")
    if not module.startswith(_OWN):
        raise InputError(f"the checkpoint names {name}, which is not scopemap's")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        raise InputError(f"the checkpoint names {name}, which this version does not have")
    return found
