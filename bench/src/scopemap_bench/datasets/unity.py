"""Poses as Unity writes them: left-handed with y up, and tables `tX,tY,tZ,rX,rY,rZ,rW,time(s)` of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.frame import TruthQuality
from scopemap.trajectory.formats.poses import poses_by_row
from scopemap.trajectory.formats.text import fields_of, text_lines
from scopemap_bench.datasets.layouts import LayoutFolder

_HEADER = ["tx", "ty", "tz", "rx", "ry", "rz", "rw", "time(s)"]
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def mirrored(T: np.ndarray) -> np.ndarray:
    """Return poses (..., 4, 4) of the left-handed world with y up in OpenCV's axes, both camera and world: M T M."""
    return _MIRROR @ T @ _MIRROR


class UnityFolder(LayoutFolder):
    """A folder of images rendered with Unity, numbered as the rows of a table of poses."""

    numbered = True
    quality: TruthQuality = "exact"

    def _read_table(self, file: Path, mm_per_unit: float) -> int:
        """Read the poses and time stamps of a table, its columns between commas or semicolons; return its rows' number.

        Its header may be missing. The last row may be cut off, as in published files: it is left out with a warning, as
        times are that do not increase. Raises `InputError`, with the line, for anything else that is no such table.
        """
        lines = "\n".join(text_lines(file)).rstrip().splitlines()
        has_header = bool(lines) and any(name in lines[0].lower() for name in _HEADER)
        if has_header and fields_of(lines[0].lower()) != _HEADER:
            raise InputError(f"{file}, line 1: expected the columns {','.join(_HEADER)}, found {lines[0][:80]!r}")
        where = [f"{file}, line {number}" for number in range(1, len(lines) + 1)]
        rows: list[list[float]] = []
        for place, line in list(zip(where, lines, strict=True))[has_header:]:
            try:
                rows.append([float(field) for field in fields_of(line)])
                if len(rows[-1]) != len(_HEADER):
                    raise ValueError(f"found {len(rows.pop())} columns where {len(_HEADER)} numbers were expected")
            except ValueError as error:
                # Only at the end: a row left out in between would shift the poses of all images after it.
                if place != where[-1] or not rows:
                    raise InputError(f"{place}: {error}") from None
                self._warn(f"{place}: {error}: the last row is cut off and was left out")
        if not rows:
            raise InputError(f"reading {file}: it holds no pose")
        values = np.array(rows)
        by_row = poses_by_row(values[:, :7], mm_per_unit, where[has_header:])
        self.poses = {row: mirrored(T) for row, T in by_row.items()}
        known = np.flatnonzero(np.isfinite(values[:, 7]))
        times_s = np.interp(np.arange(len(rows)), known, values[known, 7]) if known.size else np.zeros(2)
        self.stamped = bool((np.diff(times_s) > 0).all())
        if self.stamped:
            # Images beyond the last row follow it at the assumed rate.
            last = len(rows) - 1
            self.times_s = {n: float(times_s[min(n, last)]) + max(n - last, 0) / self.rate_hz for n in self.numbers}
            self.notes[0] = f"time stamps: those of {file.name}"
        else:
            self._warn(f"{file}: the times do not increase and were left out")
        return len(rows)
