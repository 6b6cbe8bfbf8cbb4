"""Checksums of a result, as `sha256sum -c SHA256SUMS` reads them, and of the input that it was made from."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from scopemap.engine.errors import reporting

SUMS = "SHA256SUMS"
NEEDED = ("camera.yaml", "config.toml", "frames.csv", "mesh.ply", "trajectory.tum", "provenance.json")
_MOST_INPUT_BYTES = 256 << 20
_MOST_INPUT_FILES = 20_000
_MOST_CHECKED_BYTES = 256 << 20  # half a second


def write_checksums(folder: Path, *, only: Collection[str] = (), without: Collection[str] = ()) -> None:
    """Write the checksums of all files in a result's folder to `SHA256SUMS` there.

    only : names of files and folders in it that are new; the others keep their checksums. without : names of files and
    folders in it that are none of the result's. Raises `InputError` where the folder cannot be written.
    """
    sums = read_checksums(folder) if only else {}
    sums = {name: digest for name, digest in sums.items() if name.split("/")[0] not in only}
    with reporting(f"cannot write {folder / SUMS}"):
        for name in files_in(folder):
            first = name.split("/")[0]
            if name != SUMS and first not in without and (not only or first in only):
                sums[name] = digest_of(folder / name)
        # What every result has comes last: a list that breaks off lacks it.
        names = sorted(sums, key=lambda name: (name in NEEDED, name))
        draft = folder / f"{SUMS}.part"
        draft.write_text("".join(f"{sums[name]}  {name}\n" for name in names), encoding="utf-8")
        draft.replace(folder / SUMS)


def input_checksum(path: Path) -> dict[str, Any]:
    """Return the size of an input and a SHA-256 of its content, {} for what is neither file nor folder.

    At most 256 MB are read, of a larger file its first and last 128 MB, and 20,000 files counted. A folder's SHA-256 is
    that of lines "SIZE NAME" in the order of their names, each followed by the file's while the files before it hold
    less than 256 MB. Where not all is read there is `hashed_bytes`, and `changed_ns`, the latest time of change.
    """
    try:
        if path.is_file():
            return {"bytes": path.stat().st_size, "sha256": digest_of(path, _MOST_INPUT_BYTES)} | _part([path])
        if not path.is_dir():
            return {}
        names = list(islice(files_in(path), _MOST_INPUT_FILES + 1))
        if len(names) > _MOST_INPUT_FILES:
            return {"files": f"more than {_MOST_INPUT_FILES}"}
        total, found = 0, hashlib.sha256()
        for name in names:
            size = (path / name).stat().st_size
            found.update(f"{size} {name}\n".encode("utf-8", "surrogateescape"))
            if total < _MOST_INPUT_BYTES:
                found.update(digest_of(path / name, _MOST_INPUT_BYTES - total).encode())
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


def files_in(folder: Path) -> Iterator[str]:
    """Yield the files in a folder by their names, in order, but those of unfinished runs; links are not followed."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            if os.path.isfile(os.path.join(place, name)):
                yield Path(place, name).relative_to(folder).as_posix()


def digest_of(file: Path, most_bytes: int | None = None) -> str:
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


def changed_files(folder: Path, most_bytes: int = _MOST_CHECKED_BYTES) -> list[str]:
    """Return the files of a result, or of that of a submap, that are missing or changed; [] where it has no checksums.

    At most so many bytes are read, those of the files that every result has first. Raises `InputError` where the
    checksums are damaged.
    """
    folder = folder.parent.parent if folder.parent.name == "maps" else folder
    if not (folder / SUMS).is_file():
        return []
    sums, changed = read_checksums(folder), []
    with reporting(f"cannot read {folder}"):
        for name in sorted(sums, key=lambda name: (name not in NEEDED, name)):
            size = (folder / name).stat().st_size if (folder / name).is_file() else -1
            most_bytes -= max(size, 0)
            if most_bytes < 0:
                break
            if size < 0 or digest_of(folder / name) != sums[name]:
                changed.append(name)
    return changed


def read_checksums(folder: Path) -> dict[str, str]:
    """Return the checksums of a result by the names of its files; all of them are in its folder."""
    sums = {}
    with reporting(f"cannot read {folder / SUMS}"):
        for line in (folder / SUMS).read_text(encoding="utf-8").splitlines():
            digest, _, name = line.partition("  ")
            if len(digest) != 64 or not name or ".." in Path(name).parts or Path(name).is_absolute():
                raise ValueError(f"it holds the line {line[:100]!r}")
            sums[name] = digest
    return sums
