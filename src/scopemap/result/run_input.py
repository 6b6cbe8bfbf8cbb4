"""Where the input of a run is: provenance.json has its place in three forms, and its content."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from typing import Any

from scopemap.engine.errors import InputError
from scopemap.result.checksums import input_checksum
from scopemap.result.result import Result

_MOST_NEIGHBOURS = 10_000
PLACES = ("input_absolute", "input_relative")
"""Entries of provenance.json with the folders around an input, whose names may tell of a patient."""


def stated_input(path: Path, out: Path | None) -> dict[str, Any]:
    """Return what a result in the folder `out` says of its input: `input` as it was given, where it is, its content."""
    content = input_checksum(path)
    if not content:
        return {"input": str(path), "input_content": content}
    absolute = os.path.abspath(path)
    places = {"input": str(path), "input_absolute": absolute}
    if out is not None:
        with suppress(ValueError):  # on another drive
            places["input_relative"] = os.path.relpath(absolute, os.path.abspath(out))
    return places | {"input_content": content}


def find_input(run: Path, given: Path | None = None) -> Path:
    """Return where the input of a run, or of its submap, is now.

    It is looked for relative to the result, where it was, as it was named, and by its size and content beside the
    result and in the working folder; `given` replaces these. A file must have the content that the run read. Raises
    `InputError` where it is not found, or is another file.
    """
    whole = _whole(run)
    facts = whole.provenance
    name, content = str(facts.get("input", "")), dict(facts.get("input_content") or {})
    if given is not None:
        if not given.exists():
            raise InputError(f"there is no {given}, which --input names as the input of the run {run}")
        if not _is_same(given, content):
            raise InputError(f"{given} is not the file that the run {run} read ({name}): its content differs")
        return given
    there = places_of_input(run)
    for place in (*there, *_neighbours(whole.folder, Path(name).name, content)):
        if _is_same(place, content):
            return place
    if there:
        raise InputError(f"the input {there[0]} of the run {run} is another file now; name the input with --input PATH")
    raise InputError(f"the input {name} of the run {run} was not found; name it with --input PATH")


def places_of_input(run: Path) -> list[Path]:
    """Return the places named by a run, or by the run of a submap, at which there is something."""
    whole = _whole(run)
    facts = whole.provenance
    named = [whole.folder / str(facts["input_relative"])] if "input_relative" in facts else []
    named += [Path(str(facts[key])) for key in ("input_absolute", "input") if facts.get(key)]
    return [Path(os.path.normpath(place)) for place in named if place.exists()]


def _whole(run: Path) -> Result:
    return Result(run.parent.parent if run.parent.name == "maps" else run)


def _is_same(place: Path, content: dict[str, Any]) -> bool:
    """Whether a file has the content of an input, where that is known; a folder may have got further files since."""
    if not place.is_file() or "sha256" not in content:
        return True
    # When a large file was changed is no longer known of its copy.
    known = {key: value for key, value in content.items() if key != "changed_ns"}
    if place.stat().st_size != known["bytes"] or "files" in known:
        return False
    return {key: value for key, value in input_checksum(place).items() if key != "changed_ns"} == known


def _neighbours(folder: Path, name: str, content: dict[str, Any]) -> Iterator[Path]:
    """Yield what may be the input by its size, beside a result, in the folders there, and in the working folder."""
    parent, size = Path(os.path.abspath(folder)).parent, content.get("bytes")
    beside = (path for place in ("*", "*/*") for path in parent.glob(place))
    for path in islice(chain(beside, Path().glob("*")), _MOST_NEIGHBOURS):
        with suppress(OSError):
            if "files" in content:
                if path.name == name and path.is_dir() and input_checksum(path) == content:
                    yield path
            elif size is not None and path.is_file() and path.stat().st_size == size:
                yield path
