"""Files at addresses such as s3://bucket/video.mp4: listed, and fetched when their turn comes, by fsspec."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from scopemap.errors import InputError, reporting

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

        return fsspec.url_to_fs(address)  # type: ignore[no-any-return]
    except ImportError as error:
        raise InputError(f"reading {address} needs a package ({error}): pip install -e '.[cluster]'") from None
    except ValueError as error:  # an unknown protocol
        raise InputError(f"reading {address}: {error}") from None


def _remote_file(system: Any, facts: dict[str, Any]) -> RemoteFile:
    version = next((str(facts[key]) for key in _VERSIONS if facts.get(key)), "")
    return RemoteFile(system.unstrip_protocol(facts["name"]), facts.get("size"), version)
