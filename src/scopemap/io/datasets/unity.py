"""Poses as Unity writes them: left-handed with y up, and tables `tX,tY,tZ,rX,rY,rZ,rW,time(s)` of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.trajectory.formats.poses import poses_by_row
from scopemap.trajectory.formats.text import fields_of, text_lines

_HEADER = ["tx", "ty", "tz", "rx", "ry", "rz", "rw", "time(s)"]
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class UnityTable:
    """The content of a table, by row from 0, which is the image's number.

    poses : camera-to-world (4, 4), mm, OpenCV axes; a row that holds NaN has none. times_s : of all rows; empty where
    they do not increase, interpolated where one is missing. count : number of rows. warnings : faults of the file.
    """

    poses: dict[int, np.ndarray]
    times_s: list[float]
    count: int
    warnings: list[str] = field(default_factory=list)

    def times_of(self, numbers: list[int], rate_hz: float) -> dict[int, float]:
        """Return the time stamps of images, s; those beyond the last row follow it at `rate_hz`."""
        last = len(self.times_s) - 1
        return {n: self.times_s[min(n, last)] + max(n - last, 0) / rate_hz for n in numbers} if self.times_s else {}


def mirrored(T: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) of the left-handed world with y up in OpenCV's axes, both camera and world: M T M."""
    return _MIRROR @ T @ _MIRROR


def read_unity_table(file: Path, mm_per_unit: float) -> UnityTable:
    """Read a table with columns between commas or semicolons; the header may be missing.

    The last row may be cut off, as in published files: it is left out with a warning. Raises `InputError`, with the
    line, for anything else that is no such table.
    """
    lines = "\n".join(text_lines(file)).rstrip().splitlines()
    first = 1
    if lines and any(name in lines[0].lower() for name in _HEADER):
        first = 2
        if fields_of(lines[0].lower()) != _HEADER:
            raise InputError(f"{file}, line 1: expected the columns {','.join(_HEADER)}, found {lines[0][:80]!r}")
    where = [f"{file}, line {number}" for number in range(first, len(lines) + 1)]
    rows: list[list[float]] = []
    warnings: list[str] = []
    for place, line in zip(where, lines[first - 1 :], strict=True):
        try:
            rows.append(_row(line))
        except ValueError as error:
            # Only at the end: a row left out in between would shift the poses of all images after it.
            if place != where[-1] or not rows:
                raise InputError(f"{place}: {error}") from None
            warnings.append(f"{place}: {error}: the last row is cut off and was left out")
    if not rows:
        raise InputError(f"reading {file}: it holds no pose")
    values = np.array(rows)
    poses = {row: mirrored(T) for row, T in poses_by_row(values[:, :7], mm_per_unit, where).items()}
    known = np.flatnonzero(np.isfinite(values[:, 7]))
    times_s = np.interp(np.arange(len(rows)), known, values[known, 7]) if known.size else np.empty(0)
    if not times_s.size or (np.diff(times_s) <= 0).any():
        times_s = np.empty(0)
        warnings.append(f"{file}: the times do not increase and were left out")
    return UnityTable(poses, times_s.tolist(), len(rows), warnings)


def _row(line: str) -> list[float]:
    row = [float(field) for field in fields_of(line)]
    if len(row) != len(_HEADER):
        raise ValueError(f"found {len(row)} columns where {len(_HEADER)} numbers were expected")
    return row
