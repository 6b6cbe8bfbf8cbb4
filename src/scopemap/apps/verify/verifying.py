"""Verifies a result by the checksums in its folder."""

from __future__ import annotations

import platform
import re
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from scopemap.engine.errors import InputError, reporting
from scopemap.result.checksums import NEEDED, SUMS, digest_of, files_in, read_checksums
from scopemap.result.result import Result

_WRITTEN_LATER = {
    *(f"coverage/{name}" for name in ("coverage.json", "map.csv", "map.png", "coverage.ply")),
    *("against_video/frames.csv", "against_video/worst.png", "measurements.json"),
}
"""Files that `coverage`, `evaluate --against-video` and what is measured by hand add to a result or a submap."""
_EXPORTS = "exports/"
"""Folder of a result or a submap with what the window wrote."""
_SUBMAP = re.compile(r"^maps/\d+/")


@dataclass(frozen=True)
class Verified:
    """What has become of a result.

    whole : number of files that are as they were. damaged, missing : names of those that are not. added : names of
    files that are not the result's. bytes : of all files that were read. notes : how it came about, and what is other
    than on this machine. later : names of files that commands of scopemap add to a result.
    """

    whole: int
    damaged: list[str]
    missing: list[str]
    added: list[str]
    bytes: int
    notes: list[str] = field(default_factory=list)
    later: list[str] = field(default_factory=list)

    @property
    def is_whole(self) -> bool:
        """Whether nothing is damaged or missing."""
        return not (self.damaged or self.missing)


def verify_result(folder: Path) -> Verified:
    """Compare the files of a result with its checksums. Raises `InputError` where it has none, or they are damaged."""
    if not (folder / SUMS).is_file():
        raise InputError(f"verifying {folder}: there is no {SUMS}, so no finished run, or one of an earlier version")
    sums, damaged, missing, size = read_checksums(folder), [], [], 0
    if lacking := [name for name in NEEDED if name not in sums]:
        raise InputError(f"verifying {folder}: {SUMS} is damaged, it does not name {', '.join(lacking)}")
    for name, digest in sums.items():
        with reporting(f"verifying {folder / name}"):
            if not (folder / name).is_file():
                missing.append(name)
                continue
            size += (folder / name).stat().st_size
            if digest_of(folder / name) != digest:
                damaged.append(name)
    others = [name for name in files_in(folder) if name not in sums and name != SUMS]
    later = [name for name in others if _is_written_later(_SUBMAP.sub("", name))]
    added = [name for name in others if name not in later]
    whole = len(sums) - len(damaged) - len(missing)
    notes = [] if "provenance.json" in damaged else _notes(folder)
    return Verified(whole, damaged, missing, added, size, notes, later)


def _is_written_later(name: str) -> bool:
    return name in _WRITTEN_LATER or name.startswith(_EXPORTS)


def _notes(folder: Path) -> list[str]:
    """Return whether the run was interrupted, and versions that are others here."""
    provenance = Result(folder).provenance
    versions, last = dict(provenance.get("versions") or {}), provenance.get("interrupted_at_frame")
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
