"""Inputs from a few texts: files, folders of videos, addresses (s3://bucket/video.mp4), patterns, lists, table."""

from __future__ import annotations

import csv
import glob
import os
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from scopemap.engine.errors import InputError, check_bytes, reporting
from scopemap.input.images import ImageFolder
from scopemap.input.opening import VIDEO_ENDINGS, readers

# Two letters at least: C://video.mp4 is a path of Windows.
_ADDRESS = re.compile(r"[A-Za-z][\w+.-]+(::[^/]*)?://")
# What changes with a file's content, by the words of different stores; the first that is known.
_VERSIONS = ("ETag", "etag", "LastModified", "last_modified", "mtime", "created")


@dataclass(frozen=True)
class RemoteFile:
    """A file at an address: its size in bytes, and its ETag or time of change, both None where there is none."""

    address: str
    size: int | None = None
    version: str | None = None

    def __str__(self) -> str:
        return self.address

    @property
    def name(self) -> str:
        """The last part of its address."""
        return PurePosixPath(self.address).name

    def fetch(self, folder: Path) -> Path:
        """Copy it into a folder, which is made, and return the copy.

        Raises `InputError` where it is not there, may not be read, or is not what was listed; what may pass, such as a
        broken connection, as it comes.
        """
        try:
            system, name = _system(self.address)
            system.invalidate_cache()
            if (now := _remote_file(system, system.info(name))) != self:
                raise InputError(f"fetching {self}: it has changed since it was listed; give the command again")
            folder.mkdir(parents=True, exist_ok=True)
            copy = folder / (re.sub(r"[^\w.-]+", "_", self.name).lstrip(".") or "video")
            draft = copy.with_name(f".{copy.name}")
            system.get_file(name, str(draft))
            if draft.stat().st_size != now.size:
                raise OSError(f"fetching {self}: {draft.stat().st_size} of {now.size} bytes came")
            # A run of a large file is resumed by its time of change: that of each copy of the same version.
            stamp = zlib.crc32(f"{self}{now.version}".encode())
            os.utime(draft, (stamp, stamp))
            return draft.replace(copy)
        except (FileNotFoundError, PermissionError) as error:
            raise InputError(f"fetching {self}: {error.strerror or error}") from None


def is_address(text: str) -> bool:
    """Return whether a text is an address, and no path."""
    return _ADDRESS.match(text) is not None


def remote_files(address: str, endings: Sequence[str]) -> list[RemoteFile]:
    """Return the files that an address names, in the order of their names.

    It is that of a file, of a folder, below which each file with one of the endings is meant, or a pattern (`*`,
    `**`). A file that is not there is one of unknown size. Raises `InputError` where a store cannot be listed.
    """
    with reporting(f"cannot list {address}"):
        system, name = _system(address)
        if any(letter in name for letter in "*?["):
            matched = system.glob(name, detail=True).values()
        else:
            try:
                matched = [system.info(name)]
            except FileNotFoundError:
                return [RemoteFile(address)]
        found = {}
        for facts in matched:
            if facts["type"] != "directory":
                found[facts["name"]] = facts
                continue
            for inner, of_inner in system.find(facts["name"], detail=True).items():
                if inner.lower().endswith(tuple(endings)) and "/." not in inner.removeprefix(facts["name"]):
                    found[inner] = of_inner
        return [_remote_file(system, found[inner]) for inner in sorted(found)]


def _system(address: str) -> tuple[Any, str]:
    """Return the file system of an address, and its name there."""
    try:
        import fsspec

        return fsspec.url_to_fs(address)
    except ImportError as error:
        raise InputError(f"reading {address} needs a package ({error}): pip install -e '.[cluster]'") from None
    except ValueError as error:  # an unknown protocol
        raise InputError(f"reading {address}: {error}") from None


def _remote_file(system: Any, facts: dict[str, Any]) -> RemoteFile:
    version = next((str(facts[key]) for key in _VERSIONS if facts.get(key)), "")
    return RemoteFile(system.unstrip_protocol(facts["name"]), facts.get("size"), version)


LIST = ".txt"
TABLE = ".csv"
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
