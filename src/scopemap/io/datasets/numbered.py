"""Numbered files of a data set, in a folder or still in a tar archive, read one at a time.

An archive is never unpacked: its members are found as the stream goes by. Asking for them in the order of the archive
decompresses everything once; going back costs at most one stretch between restart points (`seekable_gzip`). Only
regular members with a number in their own name are read, whatever folder the archive puts them in, and only into
memory: links and paths that lead outside do no harm.
"""

from __future__ import annotations

import io
import re
import tarfile
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Protocol

from scopemap.errors import InputError
from scopemap.io.datasets.seekable_gzip import SeekableGzip

LARGEST_FILE_BYTES = 256 << 20
MOST_MEMBERS = 200_000
_BUFFER_BYTES = 1 << 20
_ARCHIVES = (".tar.gz", ".tgz", ".tar")
_DAMAGE = (tarfile.TarError, OSError, EOFError, zlib.error, ValueError, OverflowError)


class NumberedFiles(Protocol):
    """Files that carry a number in their names.

    Attributes
    ----------
    path : the folder or the archive.
    """

    path: Path

    def read(self, number: int) -> bytes | None:
        """Return the content of the file with this number, or None where there is none; `InputError` if damaged."""

    def numbers(self) -> list[int]:
        """Return all numbers, ascending; an archive is read to its end for it."""

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield name, number and content of every file, in the order in which they are stored."""


def find_numbered(
    folder: Path, places: tuple[str, ...], prefix: str, suffixes: tuple[str, ...]
) -> NumberedFiles | None:
    """Return the files PREFIX<number>SUFFIX in the first of `places` below `folder` that has them, or None.

    A place is a folder, or an archive of the same name with `.tar.gz`, `.tgz` or `.tar`; the folder is preferred.
    """
    for place in places:
        inside = _numbered_in(folder / place, prefix, suffixes)
        if inside:
            return _Folder(folder / place, inside)
        for ending in _ARCHIVES:
            archive = folder / (place + ending)
            if archive.is_file():
                return _Archive(archive, prefix, suffixes)
    return None


def _number_of(name: str, prefix: str, suffixes: tuple[str, ...]) -> int | None:
    path = PurePosixPath(name)
    match = re.fullmatch(re.escape(prefix) + r"\D*(\d{1,12})", path.stem)
    return int(match[1]) if match and path.suffix.lower() in suffixes else None


def _numbered_in(folder: Path, prefix: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    files = sorted((file for file in folder.iterdir() if file.is_file()) if folder.is_dir() else [], reverse=True)
    numbered = {_number_of(file.name, prefix, suffixes): file for file in files}
    return {number: file for number, file in numbered.items() if number is not None}


class _Folder:
    def __init__(self, path: Path, files: dict[int, Path]) -> None:
        self.path, self._files = path, dict(sorted(files.items()))

    def read(self, number: int) -> bytes | None:
        file = self._files.get(number)
        return None if file is None else _content(file)

    def numbers(self) -> list[int]:
        return list(self._files)

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        return ((file.name, number, _content(file)) for number, file in self._files.items())


class _Archive:
    def __init__(self, path: Path, prefix: str, suffixes: tuple[str, ...]) -> None:
        self.path, self._prefix, self._suffixes = path, prefix, suffixes
        self._found: dict[int, tarfile.TarInfo] = {}
        self._order: list[int] = []
        self._tar: tarfile.TarFile | None = None
        self._last: tarfile.TarInfo | None = None
        self._seen, self._complete = 0, False
        # Frames are read ahead in a thread of their own, truth in another; the stream is one.
        self._lock = threading.Lock()

    def read(self, number: int) -> bytes | None:
        with self._lock:
            while number not in self._found and self._advance():
                pass
            return self._content(number) if number in self._found else None

    def numbers(self) -> list[int]:
        with self._lock:
            while self._advance():
                pass
            return sorted(self._order)

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        position = 0
        while True:
            with self._lock:
                while len(self._order) <= position and self._advance():
                    pass
                if len(self._order) <= position:
                    return
                number = self._order[position]
                name, data = PurePosixPath(self._found[number].name).name, self._content(number)
            yield name, number, data
            position += 1

    def _advance(self) -> bool:
        """Look at the next member; False at the end of the archive."""
        if self._complete:
            return False
        try:
            self._tar = self._tar or _opened(self.path)
            member = self._tar.next()
        except _DAMAGE as error:
            raise self._damaged(str(error)) from None
        if member is None:
            self._complete = True
            return False
        # Headers that lead back would be read for ever.
        if member.size < 0 or (self._last is not None and member.offset <= self._last.offset):
            raise self._damaged(f"{member.name} lies where it cannot")
        self._last = member
        self._note(member)
        return True

    def _note(self, member: tarfile.TarInfo) -> None:
        number = _number_of(PurePosixPath(member.name).name, self._prefix, self._suffixes)
        if number is not None and number not in self._found and member.isreg():
            self._found[number] = member
            self._order.append(number)
        self._seen += 1
        if self._seen > MOST_MEMBERS:
            raise InputError(f"reading {self.path}: it holds more than {MOST_MEMBERS} files; is it the right archive?")

    def _content(self, number: int) -> bytes:
        member = self._found[number]
        _check_size(f"{self.path}, {member.name}", member.size)
        try:
            stream = self._tar.extractfile(member) if self._tar is not None else None
            data = b"" if stream is None else stream.read()
        except _DAMAGE as error:
            raise self._damaged(str(error)) from None
        if len(data) < member.size:
            raise self._damaged(f"{member.name} breaks off")
        return data

    def _damaged(self, how: str) -> InputError:
        return InputError(f"reading {self.path}: the archive is damaged or incomplete ({how}); download it again")


def _opened(path: Path) -> tarfile.TarFile:
    raw = path.open("rb", buffering=0) if path.suffix == ".tar" else SeekableGzip(path)
    return tarfile.open(fileobj=io.BufferedReader(raw, _BUFFER_BYTES), mode="r:")


def _content(file: Path) -> bytes:
    try:
        _check_size(str(file), file.stat().st_size)
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"reading {file}: {error.strerror}") from None


def _check_size(what: str, size: int) -> None:
    if size > LARGEST_FILE_BYTES:
        raise InputError(
            f"reading {what}: it holds {size >> 20} MB, expected {LARGEST_FILE_BYTES >> 20} MB at most; is it damaged?"
        )
