"""Text files of poses, one a line: TUM (8 numbers), KITTI (12), C3VD (16, or 17 with the time first)."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError, reporting
from scopemap.input.trajectory.poses import are_frame_numbers, file_of, from_quaternions, rigid, stamped
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

_TIMED_COLUMNS = 17


@dataclass(frozen=True)
class NumberTable:
    """The numbers of a text file.

    values : (N, C) float64. line_numbers : line of each row, from 1. comments : the comment lines.
    """

    path: Path
    values: np.ndarray
    line_numbers: np.ndarray
    comments: str

    @property
    def where(self) -> list[str]:
        """File and line of each row."""
        return [f"{self.path}, line {line}" for line in self.line_numbers]

    def unit(self, assumed: Unit) -> tuple[float, str]:
        """Return mm per unit, and the unit in words: what a comment states, else `assumed`."""
        stated = re.search(r"\bunit:\s*(mm|m)\b", self.comments)
        if stated is None:
            return MM_PER_UNIT[assumed], f"{assumed} (assumed)"
        return MM_PER_UNIT["m" if stated[1] == "m" else "mm"], f"{stated[1]} (stated)"

    def with_columns(self, count: int, form: str) -> NumberTable:
        """Return the table if its rows hold `count` numbers, as `form` does; raises `InputError`."""
        if self.values.shape[1] != count:
            raise InputError(
                f"{self.where[0]}: found {self.values.shape[1]} numbers where {form} has {count} in every line"
            )
        return self

    def rows(self, chosen: np.ndarray) -> NumberTable:
        """Return the table of the rows that `chosen` (bool mask or row numbers) picks."""
        return replace(self, values=self.values[chosen], line_numbers=self.line_numbers[chosen])

    def sorted_by_stamp(self) -> NumberTable:
        """Return the table in ascending order of its first column; raises `InputError` where a stamp is repeated."""
        table = self.rows(np.argsort(self.values[:, 0], kind="stable"))
        repeated = np.flatnonzero(np.diff(table.values[:, 0]) == 0)
        if repeated.size:
            raise InputError(f"{table.where[repeated[0] + 1]}: the time stamp of an earlier line is repeated")
        return table


def text_lines(path: Path) -> list[str]:
    """Return the lines of a text file, without a byte order mark; `InputError` where it cannot be read as text."""
    with reporting(f"cannot read {path}"):
        if path.exists() and not path.is_file():  # a pipe would be waited for
            raise ValueError("it is no file")
        return path.read_text(encoding="utf-8-sig").splitlines()


def fields_of(line: str) -> list[str]:
    """Return the fields of a line before a `#`, separated by spaces, commas or semicolons."""
    return re.sub("[,;]", " ", line.partition("#")[0]).split()


def read_rows(path: Path, *, missing: bool = False) -> list[tuple[int, list[float]]]:
    """Return line number, from 1, and numbers of each line that is neither empty nor a comment.

    `missing` allows NaN and infinity. Raises `InputError`, with the line, for other text, and where there is no row.
    """
    rows = []
    for number, line in enumerate(text_lines(path), start=1):
        fields = fields_of(line)
        try:
            row = [float(field) for field in fields]
        except ValueError as error:
            raise InputError(f"{path}, line {number}: expected numbers ({error}); mark comments by '#'") from None
        if not missing and not np.all(np.isfinite(row)):
            raise InputError(f"{path}, line {number}: a pose holds NaN or infinity; leave out frames without a pose")
        if row:
            rows.append((number, row))
    if not rows:
        raise InputError(f"reading {path}: it holds no pose")
    return rows


def read_numbers(path: Path, *, missing: bool = False) -> NumberTable:
    """Return the table in a text file; `InputError`, with the line, where rows differ in length. See `read_rows`."""
    rows = read_rows(path, missing=missing)
    width = len(rows[0][1])
    for number, row in rows:
        if len(row) != width:
            raise InputError(f"{path}, line {number}: found {len(row)} numbers where earlier lines have {width}")
    comments = "\n".join(line for line in text_lines(path) if line.lstrip().startswith("#"))
    return NumberTable(path, np.array([row for _, row in rows]), np.array([number for number, _ in rows]), comments)


def tum_poses(table: NumberTable, unit: Unit) -> tuple[np.ndarray, str]:
    """Return the poses (N, 4, 4), mm, of `stamp tx ty tz qx qy qz qw` rows, and their unit in words."""
    mm_per_unit, words = table.unit(unit)
    return from_quaternions(table.values[:, 4:], table.values[:, 1:4] * mm_per_unit, table.where), words


def read_tum(path: Path, unit: Unit) -> Trajectory:
    """Read TUM rows; stamps that are all integers are frame numbers, unless a comment says `time: s`."""
    table = read_numbers(file_of(path, ())).with_columns(8, "TUM").sorted_by_stamp()
    T, words = tum_poses(table, unit)
    stamps = table.values[:, 0]
    source = f"TUM, camera-to-world, {words}"
    if re.search(r"\btime:\s*s\b", table.comments) or not are_frame_numbers(stamps):
        return stamped(T, None, stamps, f"{source}, stamps are seconds")
    return stamped(T, stamps, None, f"{source}, whole stamps taken for frame numbers")


def read_kitti(path: Path, unit: Unit) -> Trajectory:
    """Read KITTI rows, the upper 3x4 of a camera-to-world pose each; row = frame number, from 0."""
    table = read_numbers(file_of(path, ())).with_columns(12, "KITTI")
    mm_per_unit, words = table.unit(unit)
    T = np.tile(np.eye(4), (len(table.values), 1, 1))
    T[:, :3] = table.values.reshape(-1, 3, 4)
    T[:, :3, 3] *= mm_per_unit
    return stamped(rigid(T, table.where), np.arange(len(T)), None, f"KITTI, camera-to-world, {words}, row = frame")


def read_c3vd(path: Path, unit: Unit) -> Trajectory:
    """Read C3VD's `pose.txt`, 16 numbers a line, always mm; `unit` is not used.

    C3VD stores the transposed matrix, its documentation says row-major; which of both is decided over all lines.
    C3VDv3 has the time before it, s, or the number of the frame where all are whole (github.com/DurrLab/C3VDv3).
    """
    table = read_numbers(file_of(path, ("pose.txt",)))
    is_timed = table.values.shape[1] == _TIMED_COLUMNS
    table = table.sorted_by_stamp() if is_timed else table.with_columns(16, "C3VD's pose.txt")
    T = table.values[:, -16:].reshape(-1, 4, 4)
    if np.allclose(T[:, :3, 3], 0):
        T, order = np.swapaxes(T, 1, 2), "stored transposed"
    elif np.allclose(T[:, 3, :3], 0):
        order = "row-major"
    else:
        raise InputError(f"cannot read poses from {table.path}: neither the last row nor the last column is 0 0 0 1")
    T, source = rigid(T, table.where), f"C3VD pose.txt, {order}, camera-to-world, mm"
    if not is_timed:
        return stamped(T, np.arange(len(T)), None, f"{source}, row = frame")
    if are_frame_numbers(table.values[:, 0]):
        return stamped(T, table.values[:, 0], None, f"{source}, whole stamps taken for frame numbers")
    return stamped(T, None, table.values[:, 0], f"{source}, stamps are seconds")


def read_poses(path: Path) -> np.ndarray:
    """Return the camera-to-world poses (N, 4, 4), mm, of C3VD's `pose.txt`; see `read_c3vd`. Raises `InputError`."""
    return read_c3vd(Path(path), "mm").T_world_camera
