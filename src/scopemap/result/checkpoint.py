"""The checkpoint of a run: one small file with what does not follow from the frames that the run has stored.

    checkpoint.npz  "record": JSON as UTF-8, in which {"array": NAME} stands for the array of that name beside it

The file replaces the one before by renaming: it is written whole or not at all. Each array has a checksum.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError

CHECKPOINT = "checkpoint.npz"
"""Name of the file within the folder of an unfinished run."""

CHECKPOINT_NEW = "checkpoint.new"
"""Name of that file until it is whole."""

_VERSION = 1
_RECORD = "record"


def has_checkpoint(unfinished: Path) -> bool:
    """Return whether the folder of an unfinished run holds a checkpoint to go on from, which may be damaged."""
    return (unfinished / CHECKPOINT).is_file()


def discard_checkpoint(unfinished: Path) -> None:
    """Have nothing resume from the folder of an unfinished run. Raises `OSError`."""
    (unfinished / CHECKPOINT).unlink(missing_ok=True)


def write_checkpoint(unfinished: Path, record: dict[str, Any]) -> None:
    """Put a record in place of the one before: JSON values and arrays, in dictionaries by name.

    Raises `InputError` where it cannot be written.
    """
    arrays = dict[str, np.ndarray]()
    named = {"version": _VERSION} | _without_arrays(record, "", arrays)
    document = json.dumps(named, default=lambda scalar: scalar.item())  # numpy's numbers are none of JSON's
    arrays[_RECORD] = np.frombuffer(document.encode(), np.uint8)
    try:
        with (unfinished / CHECKPOINT_NEW).open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        (unfinished / CHECKPOINT_NEW).replace(unfinished / CHECKPOINT)
    except OSError as error:
        raise InputError(f"cannot write the checkpoint {unfinished / CHECKPOINT}: {error.strerror or error}") from None


def read_checkpoint(unfinished: Path) -> dict[str, Any]:
    """Return the record that was written last; {} where there is none. Raises `InputError` where it is damaged."""
    file = unfinished / CHECKPOINT
    if not has_checkpoint(unfinished):
        return {}
    try:
        with np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        document = json.loads(arrays.pop(_RECORD).tobytes())
        record: dict[str, Any] = _with_arrays(document, arrays)
    except Exception as error:  # of the file's format, of the disk, of a checksum
        raise InputError(f"the checkpoint {file} is damaged: {error}") from None
    if record.pop("version", None) != _VERSION:
        raise InputError(f"the checkpoint {file} is of another version of scopemap")
    return record


def _without_arrays(record: dict[str, Any], place: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return a record whose arrays are named; `arrays` takes them by these names."""
    named = dict[str, Any]()
    for name, value in record.items():
        if isinstance(value, np.ndarray):
            arrays[f"{place}{name}"] = value
            named[name] = {"array": f"{place}{name}"}
        else:
            named[name] = _without_arrays(value, f"{place}{name}.", arrays) if isinstance(value, dict) else value
    return named


def _with_arrays(named: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return what `_without_arrays` was given."""
    record = dict[str, Any]()
    for name, value in named.items():
        if isinstance(value, dict):
            value = arrays[value["array"]] if [*value] == ["array"] else _with_arrays(value, arrays)
        record[name] = value
    return record
