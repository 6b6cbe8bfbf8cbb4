"""Many inputs from a few texts: files, folders of videos, addresses, patterns, lists and tables."""

from __future__ import annotations

import csv
import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scopemap.errors import InputError, check_bytes, reporting
from scopemap.io.addresses import RemoteFile, is_address, remote_files
from scopemap.io.images import ImageFolder
from scopemap.io.opening import VIDEO_ENDINGS, readers

LIST, TABLE = ".txt", ".csv"
_COLUMN = "input"
_FILES = ("camera", "config")
_MOST_BYTES = 64 << 20
_ENDINGS = (*VIDEO_ENDINGS, ".dcm", ".bag")
_DEEPEST = 8


@dataclass(frozen=True)
class NamedInput:
    """An input, and the columns of the table that names it, without empty cells; {} where no table does."""

    path: Path | RemoteFile
    columns: dict[str, str] = field(default_factory=dict)


def named_inputs(texts: Sequence[str]) -> list[NamedInput]:
    """Return what texts name, in order, each input with the same columns once.

    A text is the path of an input; a folder, of which each video, data set and folder of images below it is an input; a
    pattern (`*`, `**`); an address that fsspec reads (s3://...) of a video, a folder or a pattern; a list, *.txt, with
    one such text a line; or a table, *.csv, with such a text in its column `input`. Paths in a list or a table are
    relative to its folder, its cells `camera` and `config`, too. What does not exist fails when it is opened. Raises
    `InputError` for a list, table or address that cannot be read, and where nothing is named.
    """
    once = {(str(one.path), *sorted(one.columns.items())): one for text in texts for one in _of_text(text)}
    if not once:
        raise InputError(f"no video in {', '.join(texts) or 'no input'}")
    return list(once.values())


def _of_text(text: str) -> Iterator[NamedInput]:
    file = Path(text)
    ending = file.suffix.lower()
    if ending not in (LIST, TABLE) or not file.is_file():
        yield from map(NamedInput, _named(text, Path()))
        return
    with reporting(f"cannot read {file}"):
        check_bytes(str(file), file.stat().st_size, _MOST_BYTES)
        lines = file.read_text(encoding="utf-8-sig").splitlines()
        listed = [(line.strip(), dict[str, str]()) for line in lines if line.strip() and not line.startswith("#")]
        named = _of_table(file, lines) if ending == TABLE else listed
        for path, columns in named:
            beside = {key: str(file.parent / cell) for key, cell in columns.items() if key in _FILES}
            columns |= {key: cell for key, cell in beside.items() if Path(cell).is_file()}
            for one in _named(path, file.parent):
                yield NamedInput(one, columns)


def _of_table(file: Path, lines: list[str]) -> list[tuple[str, dict[str, str]]]:
    table = csv.DictReader(lines, restkey="", restval="")
    if _COLUMN not in (table.fieldnames or []):
        raise InputError(f"cannot read {file}: its first line names no column '{_COLUMN}'")
    named = []
    for row in table:
        if row.get(""):
            raise InputError(f"cannot read {file}: line {table.line_num} has more cells than the first line")
        cells = {key.strip(): value.strip() for key, value in row.items() if value and value.strip()}
        if path := cells.pop(_COLUMN, ""):
            named.append((path, cells))
    return named


def _named(text: str, folder: Path) -> Sequence[Path | RemoteFile]:
    """Return the inputs that an address names, or a path or pattern relative to a folder; or the path itself."""
    return remote_files(text, _ENDINGS) if is_address(text) else _paths(folder / text)


def _paths(path: Path) -> list[Path]:
    if path.is_dir():
        return list(_in_folder(path)) or [path]
    if not path.exists() and glob.has_magic(str(path)):
        # "**" follows links, even those that lead in a circle.
        found = sorted(glob.glob(str(path), recursive=True), key=lambda name: (name.count(os.sep), name), reverse=True)
        once = {os.path.realpath(name): name for name in found}
        return [one for name in sorted(once.values()) for one in _paths(Path(name))]
    return [path]


def _in_folder(folder: Path, depth: int = 0) -> Iterator[Path]:
    """Yield the inputs in a folder, in the order of their names; links to folders are not followed."""
    try:
        if any(kind.recognises(folder) for kind in readers().values() if kind is not ImageFolder):
            yield folder
            return
        with os.scandir(folder) as entries:
            visible = sorted((e for e in entries if not e.name.startswith(".")), key=lambda entry: entry.name)
        videos = [e for e in visible if e.name.lower().endswith(_ENDINGS) and e.is_file()]
        if not videos and ImageFolder.recognises(folder):
            yield folder
            return
    except OSError:  # no permission: opening says so
        yield folder
        return
    for entry in visible:
        if entry in videos:
            yield folder / entry.name
        elif depth < _DEEPEST and entry.is_dir(follow_symlinks=False):
            yield from _in_folder(folder / entry.name, depth + 1)
