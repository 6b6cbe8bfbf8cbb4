"""Numbered files of a data set, in a folder or in a tar archive, read one at a time.

Of an archive only regular files with a number in their own name are read. Going back in a compressed archive would
decompress it from its start again: in ascending order its files are decompressed once, however they lie in it. Those
that lie before a smaller number wait in a temporary file without a name.
"""

from __future__ import annotations

import re
import tarfile
import tempfile
import threading
import zlib
from contextlib import AbstractContextManager
from pathlib import Path, PurePosixPath
from typing import IO, TypeAlias

from scopemap.engine.errors import check_bytes, reporting

LARGEST_FILE_BYTES = 256 << 20
_MOST_MEMBERS = 200_000
_LARGEST_HEADER_BYTES = 1 << 20
_LONG_NAMES = (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK)
_HEADERS = (*_LONG_NAMES, tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE)
ARCHIVES = (".tar.gz", ".tgz", ".tar")
"""Endings of the archives that are read, the preferred first."""


class FolderFiles:
    """Numbered files of the folder `path`."""

    def __init__(self, path: Path, files: dict[int, Path]) -> None:
        self.path, self._files = path, dict(sorted(files.items()))

    def read(self, number: int, most_bytes: int | None = None) -> bytes | None:
        """Return the content of this file, None where there is none; `InputError` above `most_bytes`."""
        file = self._files.get(number)
        if file is None:
            return None
        with reporting(f"reading {file}"):
            check_bytes(str(file), file.stat().st_size, most_bytes or LARGEST_FILE_BYTES)
            return file.read_bytes()

    def numbers(self) -> list[int]:
        """Return all numbers, ascending."""
        return list(self._files)

    def stored(self) -> list[int]:
        """Return all numbers in the order in which reading all of them is fast."""
        return self.numbers()


class ArchiveFiles:
    """Numbered files of the tar archive `path`. Reading raises `InputError` where it is damaged or breaks off."""

    def __init__(self, path: Path, prefix: str, suffixes: tuple[str, ...]) -> None:
        self.path, self._prefix, self._suffixes = path, prefix, suffixes
        self._found: dict[int, tarfile.TarInfo] = {}
        self._tar: tarfile.TarFile | None = None
        self._last_offset, self._passed = -1, 0
        self._complete = False
        self._waiting: dict[int, tuple[int, int]] = {}  # offset and size in the temporary file
        self._spool: IO[bytes] | None = None
        self._read_to = 0
        # Frames are read ahead in a thread of their own, truth in another; the stream is one.
        self._lock = threading.Lock()

    def read(self, number: int, most_bytes: int | None = None) -> bytes | None:
        """Return the content of the file with this number, None where there is none; `InputError` as of a folder."""
        with self._lock, self._reporting():
            while number not in self._found and not self._complete:
                found = self._advance()
                if found is not None and found > number:
                    self._let_wait(found)
            member = self._found.get(number)
            if member is None:
                return None
            check_bytes(f"{self.path}, {member.name}", member.size, most_bytes or LARGEST_FILE_BYTES)
            if number in self._waiting and self._spool is not None:
                offset, size = self._waiting[number]
                self._spool.seek(offset)
                return zlib.decompress(self._spool.read(size))
            if member.offset < self._read_to:  # from the start again, but for no other file
                self._read_to = 0
            for other, passed in sorted(self._found.items(), key=lambda item: item[1].offset):
                if self._read_to <= passed.offset < member.offset and other > number:
                    self._let_wait(other)
            return self._content(member)

    def numbers(self) -> list[int]:
        """Return all numbers, ascending; the archive is read to its end for it."""
        return sorted(self.stored())

    def stored(self) -> list[int]:
        """Return all numbers in the order of the archive: in another one it is decompressed again and again."""
        with self._lock, self._reporting():
            while not self._complete:
                self._advance()
            return list(self._found)

    def _content(self, member: tarfile.TarInfo) -> bytes:
        stream = None if self._tar is None else self._tar.extractfile(member)
        content = b"" if stream is None else stream.read()
        if len(content) < member.size:
            raise EOFError(f"{member.name} breaks off")
        self._read_to = member.offset + 1
        return content

    def _let_wait(self, number: int) -> None:
        """Put the content of a file that is passed on the way to a smaller number into the temporary file."""
        member = self._found[number]
        if self.path.suffix == ".tar" or number in self._waiting or member.size > LARGEST_FILE_BYTES:
            return
        packed = zlib.compress(self._content(member), level=1)
        self._spool = self._spool or tempfile.TemporaryFile()  # noqa: SIM115
        self._waiting[number] = (self._spool.seek(0, 2), len(packed))
        self._spool.write(packed)

    def _advance(self) -> int | None:
        """Read the next header; return its number where it is that of a file that was not there yet."""
        self._tar = self._tar or tarfile.open(self.path, tarinfo=_BoundedMember)  # noqa: SIM115
        member = self._tar.next()
        if member is None:
            self._complete = True
            return None
        # Sizes below zero lead `tarfile` back to headers that it has read (CVE-2025-8194).
        if member.size < 0 or member.offset <= self._last_offset:
            raise EOFError(f"{member.name} has no valid size")
        self._last_offset = member.offset
        # Empty members compress a thousandfold, and `tarfile` keeps them all.
        self._passed += 1
        if self._passed > _MOST_MEMBERS:
            raise EOFError(f"it holds more than {_MOST_MEMBERS} members")
        number = _number_of(member.name, self._prefix, self._suffixes)
        if number is None or not member.isreg() or number in self._found:
            return None
        self._found[number] = member
        return number

    def _reporting(self) -> AbstractContextManager[None]:
        return reporting(f"reading {self.path}: the archive is damaged or incomplete; download it again")


class _BoundedMember(tarfile.TarInfo):
    """A member whose long name and other headers, which `tarfile` reads at once, are of a size that headers have."""

    def _proc_member(self, tarfile_: tarfile.TarFile) -> tarfile.TarInfo:
        if self.type in _HEADERS and not 0 <= self.size <= _LARGEST_HEADER_BYTES:
            raise EOFError(f"a header claims {self.size} bytes")
        return super()._proc_member(tarfile_)  # type: ignore[misc]


NumberedFiles: TypeAlias = FolderFiles | ArchiveFiles


def find_numbered(
    folder: Path, places: tuple[str, ...], prefix: str, suffixes: tuple[str, ...]
) -> NumberedFiles | None:
    """Return the files PREFIX<number>SUFFIX in the first of `places` below `folder` that has them, or None.

    A place is a folder, or an archive of the same name with an ending of `ARCHIVES`; the folder is preferred.
    """
    for place in places:
        inside = folder / place
        files = sorted((file for file in inside.iterdir() if file.is_file()) if inside.is_dir() else [], reverse=True)
        numbered = {number: file for file in files if (number := _number_of(file.name, prefix, suffixes)) is not None}
        if numbered:
            return FolderFiles(inside, numbered)
        archive = next((file for end in ARCHIVES if (file := folder / (place + end)).is_file()), None)
        if archive is not None:
            return ArchiveFiles(archive, prefix, suffixes)
    return None


def _number_of(name: str, prefix: str, suffixes: tuple[str, ...]) -> int | None:
    path = PurePosixPath(name)
    match = re.fullmatch(re.escape(prefix) + r"\D*(\d{1,12})", path.stem)
    return int(match[1]) if match and path.suffix.lower() in suffixes else None
