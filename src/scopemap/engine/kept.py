"""What a stage keeps from frame to frame: declared by its class, so that a run that was killed goes on from it.

A class marks attributes by their type, `count: Kept[int]`. What it does not mark (settings, networks, files, what
follows from the rest) is not stored: the object that is restored has its own. Stored are numbers, texts, arrays,
containers, dataclasses and named tuples, and objects that keep something themselves, which are restored in place.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, partial
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

_T = TypeVar("_T")
_MARK = "kept from frame to frame"

Kept = Annotated[_T, _MARK]
"""Type of an attribute that is stored with a run."""

PutArray = Callable[[np.ndarray], Any]
"""Stores an array, and returns what JSON holds of it: no string, number or list."""

GetArray = Callable[..., np.ndarray]
"""Returns the array of what `PutArray` returned; with `shared=True` one that others get, too, and nobody changes."""


@cache
def kept(kind: type) -> dict[str, Any]:
    """Return the types of the attributes that a class keeps, by their names; {} where it keeps nothing."""
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError:  # a class of others, with names that only type checkers know
        return {}
    return {name: get_args(hint)[0] for name, hint in hints.items() if _MARK in getattr(hint, "__metadata__", ())}


def state_of(owner: Any, put: PutArray) -> dict[str, Any]:
    """Return what an object keeps as JSON holds it, by name."""
    return {name: _stored(getattr(owner, name), put) for name in kept(owner.__class__)}


def restore(owner: Any, state: Mapping[str, Any], get: GetArray) -> None:
    """Give an object, made as that of `state_of` was, what that one kept."""
    for name, kind in kept(owner.__class__).items():
        now = getattr(owner, name)
        found = _restored(kind, state[name], get, now)
        if found is not now:
            setattr(owner, name, found)


def _stored(value: Any, put: PutArray) -> Any:
    if isinstance(value, np.generic):  # arithmetic depends on its type
        return {"scalar": value.dtype.str, "value": _stored(value.item(), put)}
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):  # JSON knows neither NaN nor infinity
        return value if math.isfinite(value) else str(value)
    if isinstance(value, np.ndarray | bytes):
        return put(np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value)
    if isinstance(value, Mapping):
        return {str(key): _stored(item, put) for key, item in value.items()}
    if not kept(value.__class__) and (types := _fields(value.__class__)):
        return {name: _stored(getattr(value, name), put) for name in types}
    if isinstance(value, list | tuple | set | deque):
        return [_stored(item, put) for item in value]
    return state_of(value, put)


def _restored(kind: Any, stored: Any, get: GetArray, now: Any = None) -> Any:
    """Return a value of a declared type; now : what there is in its place, which an object that keeps something stays.

    Nothing in what is stored names a type.
    """
    outer = get_origin(kind)
    if stored is None or outer is Literal:
        return stored
    if outer in (Union, UnionType):
        names = stored.keys() if isinstance(stored, dict) else set()
        kinds = [one for one in get_args(kind) if one is not type(None)]
        return _restored(max(kinds, key=lambda one: _fields(one).keys() == names), stored, get, now)
    if outer is not None:
        return _restored_container(kind, stored, get, now)
    if isinstance(stored, dict) and "scalar" in stored:
        return np.dtype(stored["scalar"]).type(stored["value"])
    if kind is Any:
        return stored
    if kind is float:
        return float(stored) if isinstance(stored, str) else stored
    if kind is np.ndarray:
        return get(stored)
    if kind is bytes:
        return get(stored).tobytes()
    if issubclass(kind, int | str | Enum):
        return kind(stored)
    if not kept(now.__class__) and (types := _fields(kind)):
        # Frames are not changed in place, so what several of them hold is in memory once.
        get = partial(get, shared=True) if is_dataclass(kind) else get
        return kind(**{name: _restored(types[name], stored[name], get) for name in types})
    restore(now, stored, get)
    return now


def _restored_container(kind: Any, stored: Any, get: GetArray, now: Any) -> Any:
    """Return a container of a declared type; a dictionary or list stays the object that it is."""
    outer, of = get_origin(kind), get_args(kind)
    if issubclass(outer, Mapping):
        of_key, of_item = (*of, int)[:2]  # a counter names no type of its counts
        is_part, found = isinstance(of_item, type) and kept(of_item), {}
        for name, item in stored.items():
            key = of_key(name)
            found[key] = _restored(of_item, item, get, now[key] if is_part else None)  # which makes a part
        if now is None:
            return found
        now.clear()
        now.update(found)
        return now
    types = of if outer is tuple and of[-1] is not Ellipsis else of[:1] * len(stored)
    values = [_restored(one, item, get) for one, item in zip(types, stored, strict=True)]
    if isinstance(now, list):
        now[:] = values
        return now
    return deque(values, getattr(now, "maxlen", None)) if outer is deque else outer(values)


@cache
def _fields(kind: Any) -> dict[str, Any]:
    """Return the types of the fields of a dataclass or named tuple, by name; {} for anything else."""
    names = [one.name for one in fields(kind) if one.init] if is_dataclass(kind) else []
    if isinstance(kind, type) and issubclass(kind, tuple):
        names = [*getattr(kind, "_fields", ())]
    types = get_type_hints(kind) if names else {}
    return {name: types[name] for name in names}
