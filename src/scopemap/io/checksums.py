"""Checksums of a result, as `sha256sum -c SHA256SUMS` reads them, and of the input that it was made from."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import islice
from pathlib import Path
from typing import Any

from scopemap.errors import InputError, reporting

SUMS = "SHA256SUMS"
_NEEDED = ("camera.yaml", "config.toml", "frames.csv", "mesh.ply", "trajectory.tum", "provenance.json")
_MOST_INPUT_BYTES, _MOST_INPUT_FILES = 256 << 20, 20_000


@dataclass(frozen=True)
class Verified:
    """A result compared with its checksums.

    whole : number of unchanged files. damaged, missing, added : names of the others. bytes : of all files that were
    read. notes : how the result came about, and which versions differ on this machine.
    """

    whole: int
    damaged: list[str]
    missing: list[str]
    added: list[str]
    bytes: int
    notes: list[str] = field(default_factory=list)

    @property
    def is_whole(self) -> bool:
        """Whether nothing is damaged or missing."""
        return not (self.damaged or self.missing)


def write_checksums(folder: Path, *, only: Collection[str] = (), without: Collection[str] = ()) -> None:
    """Write the checksums of all files in a result's folder to `SHA256SUMS` there.

    only : names of files and folders in it that are new; the others keep their checksums. without : names of files and
    folders in it that are none of the result's. Raises `InputError` where the folder cannot be written.
    """
    sums = _read(folder) if only else {}
    sums = {name: digest for name, digest in sums.items() if name.split("/")[0] not in only}
    with reporting(f"cannot write {folder / SUMS}"):
        for name in _files_in(folder):
            first = name.split("/")[0]
            if name != SUMS and first not in without and (not only or first in only):
                sums[name] = _digest(folder / name)
        # What every result has comes last: a list that breaks off lacks it.
        names = sorted(sums, key=lambda name: (name in _NEEDED, name))
        draft = folder / f"{SUMS}.part"
        draft.write_text("".join(f"{sums[name]}  {name}\n" for name in names), encoding="utf-8")
        draft.replace(folder / SUMS)


def verify_result(folder: Path) -> Verified:
    """Compare the files of a result with its checksums. Raises `InputError` where it has none, or they are damaged."""
    if not (folder / SUMS).is_file():
        raise InputError(f"verifying {folder}: there is no {SUMS}, so no finished run, or one of an earlier version")
    sums, damaged, missing, size = _read(folder), [], [], 0
    if lacking := [name for name in _NEEDED if name not in sums]:
        raise InputError(f"verifying {folder}: {SUMS} is damaged, it does not name {', '.join(lacking)}")
    for name, digest in sums.items():
        with reporting(f"verifying {folder / name}"):
            if not (folder / name).is_file():
                missing.append(name)
                continue
            size += (folder / name).stat().st_size
            if _digest(folder / name) != digest:
                damaged.append(name)
    added = [name for name in _files_in(folder) if name not in sums and name != SUMS]
    whole = len(sums) - len(damaged) - len(missing)
    return Verified(whole, damaged, missing, added, size, [] if "provenance.json" in damaged else _notes(folder))


def input_checksum(path: Path) -> dict[str, Any]:
    """Return the size of an input and a SHA-256 of its content, {} for what is neither file nor folder.

    At most 256 MB are read, of a larger file its first and last 128 MB, and 20,000 files counted. A folder's SHA-256 is
    that of lines "SIZE NAME" in the order of their names, each followed by the file's while the files before it hold
    less than 256 MB. Where not all is read there is `hashed_bytes`, and `changed_ns`, the latest time of change.
    """
    try:
        if path.is_file():
            return {"bytes": path.stat().st_size, "sha256": _digest(path, _MOST_INPUT_BYTES)} | _part([path])
        if not path.is_dir():
            return {}
        names = list(islice(_files_in(path), _MOST_INPUT_FILES + 1))
        if len(names) > _MOST_INPUT_FILES:
            return {"files": f"more than {_MOST_INPUT_FILES}"}
        total, found = 0, hashlib.sha256()
        for name in names:
            size = (path / name).stat().st_size
            found.update(f"{size} {name}\n".encode("utf-8", "surrogateescape"))
            if total < _MOST_INPUT_BYTES:
                found.update(_digest(path / name, _MOST_INPUT_BYTES - total).encode())
            total += size
        part = _part([path / name for name in names])
        return {"files": len(names), "bytes": total, "sha256": found.hexdigest()} | part
    except OSError:  # it was read, and is gone
        return {}


def _part(files: list[Path]) -> dict[str, int]:
    """Return what tells files apart that are too large to be hashed; {} for smaller ones."""
    stats = [file.stat() for file in files]
    if sum(stat.st_size for stat in stats) <= _MOST_INPUT_BYTES:
        return {}
    return {"hashed_bytes": _MOST_INPUT_BYTES, "changed_ns": max(stat.st_mtime_ns for stat in stats)}


def _files_in(folder: Path) -> Iterator[str]:
    """Yield the files in a folder by their names, in order, but those of unfinished runs; links are not followed."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            if os.path.isfile(os.path.join(place, name)):
                yield Path(place, name).relative_to(folder).as_posix()


def _digest(file: Path, most_bytes: int | None = None) -> str:
    """Return the SHA-256 of a file, of a larger one of so many of its bytes at both ends; 64 hexadecimal digits."""
    with file.open("rb") as stream:
        size = file.stat().st_size
        if most_bytes is None or size <= most_bytes:
            return hashlib.file_digest(stream, "sha256").hexdigest()
        found = hashlib.sha256()
        for start, end in ((0, most_bytes // 2), (size - (most_bytes - most_bytes // 2), size)):
            stream.seek(start)
            while start < end and (part := stream.read(min(end - start, 1 << 20))):
                found.update(part)
                start += len(part)
        return found.hexdigest()


def _read(folder: Path) -> dict[str, str]:
    """Return the checksums of a result by the names of its files; all of them are in its folder."""
    sums = {}
    with reporting(f"cannot read {folder / SUMS}"):
        for line in (folder / SUMS).read_text(encoding="utf-8").splitlines():
            digest, _, name = line.partition("  ")
            if len(digest) != 64 or not name or ".." in Path(name).parts or Path(name).is_absolute():
                raise ValueError(f"it holds the line {line[:100]!r}")
            sums[name] = digest
    return sums


def _notes(folder: Path) -> list[str]:
    """Return what the provenance tells: whether the run was cut short, and versions that are others here."""
    with reporting(f"cannot read {folder / 'provenance.json'}"):
        told = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
        versions, last = dict(told.get("versions", {})), told.get("interrupted_at_frame")
    notes = [] if last is None else [f"it was interrupted at frame {last}"]
    notes.append(f"made by scopemap {versions.get('scopemap', 'of unknown version')}")
    here = {name: _version(name) for name in versions}
    other = [f"{name} {then} (here {here[name]})" for name, then in versions.items() if here[name] != then]
    return notes + ([f"made with other versions than those here: {', '.join(other)}"] if other else [])


def _version(name: str) -> str:
    try:
        return platform.python_version() if name == "python" else version(name)
    except PackageNotFoundError:
        return "none"
