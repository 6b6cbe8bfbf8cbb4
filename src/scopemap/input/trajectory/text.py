"""Text files of poses, one a line: TUM and EuRoC (8 numbers), KITTI (12), C3VD (16, or 17 with the time first)."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError, reporting
from scopemap.input.trajectory.columns import TUM_ORDER, W_FIRST, Columns, are_frame_numbers, named_columns, stamps_s
from scopemap.input.trajectory.poses import file_of, from_quaternions, rigid, stamped
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit, numbers_file

_TIMED_COLUMNS = 17
EUROC_FILES = ("mav0/state_groundtruth_estimate0/data.csv", "state_groundtruth_estimate0/data.csv")
_LONGEST_QUOTE = 40
# Every number has the comma but a whole one, such as a time of 0, or a power, such as Excel's 1E-05.
_DECIMAL_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")
_FEWEST_OF_POSE = 7
_UNIT_LENGTH = 1e-2  # tolerance of a quaternion's length


@dataclass(frozen=True)
class NumberTable:
    """The numbers of a text file.

    values : (N, C) float64. line_numbers : line of each row, from 1. comments : the comment lines. columns : what a
    header names them; None: there is none that names those of a pose.
    """

    path: Path
    values: np.ndarray
    line_numbers: np.ndarray
    comments: str
    columns: Columns | None = None

    @property
    def where(self) -> list[str]:
        """File and line of each row."""
        return [f"{self.path}, line {line}" for line in self.line_numbers]

    def unit(self, assumed: Unit) -> tuple[float, str]:
        """Return mm per unit, and the unit in words: what a comment states, else `assumed`."""
        stated = re.search(r"\bunits?\s*[:=]\s*(mm|m)\b", self.comments)
        unit = stated[1] if stated is not None else "" if self.columns is None else self.columns.unit
        if not unit:
            return MM_PER_UNIT[assumed], f"{assumed} (assumed)"
        return MM_PER_UNIT["m" if unit == "m" else "mm"], f"{unit} (stated)"

    @property
    def time_unit(self) -> str:
        """The unit of time stamps that a comment or the header states; ""."""
        stated = re.search(r"\btime:\s*(ns|us|ms|s)\b", self.comments)
        return stated[1] if stated is not None else "" if self.columns is None else self.columns.time_unit

    def as_tum(self, form: str, order: tuple[int, ...] = TUM_ORDER) -> NumberTable:
        """Return the table of time, position and quaternion, scalar last: by its header, without one by `order`.

        Raises `InputError` where there is no header, and not the 8 numbers that `form` has.
        """
        table = self if self.columns is not None else self.with_columns(8, form)
        order = order if self.columns is None else self.columns.order
        return replace(table, values=self.values[:, list(order)])

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
        content = path.read_bytes()
        is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # what PowerShell's > writes
        try:
            return content.decode("utf-16" if is_utf16 else "utf-8-sig").splitlines()
        except UnicodeDecodeError:
            raise ValueError("it is no text: poses are read from text files of numbers, docs/formats.md") from None


def fields_of(line: str) -> list[str]:
    """Return the fields of a line before a `#`, separated by spaces, commas or semicolons."""
    return re.sub("[,;]", " ", line.partition("#")[0]).split()


def read_rows(path: Path, *, missing: bool = False) -> list[tuple[int, list[float]]]:
    """Return line number, from 1, and numbers of each line that is neither empty nor a comment.

    `missing` allows NaN and infinity. Raises `InputError`, with the line, for other text, and where there is no row.
    """
    rows: list[tuple[int, list[float]]] = []
    for number, line in enumerate(text_lines(path), start=1):
        fields = fields_of(line)
        if not rows and named_columns(line) is not None:  # a header, marked as a comment or not
            continue
        if _has_decimal_commas(line):
            raise InputError(f"{path}, line {number}: it has decimal commas ({line.split()[0][:40]}): write points")
        row = [_number(field, f"{path}, line {number}") for field in fields]
        if not missing and not np.all(np.isfinite(row)):
            raise InputError(f"{path}, line {number}: a pose holds NaN or infinity; leave out frames without a pose")
        if row:
            rows.append((number, row))
    if not rows:
        raise InputError(f"reading {path}: it holds no pose")
    return rows


def _number(field: str, where: str) -> float:
    try:
        return float(field)
    except ValueError:
        found = f"expected numbers, found {field[:_LONGEST_QUOTE]!r}"
        raise InputError(f"{where}: {found}; mark comments by '#'") from None


def _has_decimal_commas(line: str) -> bool:
    """Return whether a line has the numbers of a pose, each written with a comma for the point."""
    words = line.partition("#")[0].replace(";", " ").split()
    return len(words) >= _FEWEST_OF_POSE and "," in line and all(map(_DECIMAL_COMMA.fullmatch, words))


def read_numbers(path: Path, *, missing: bool = False) -> NumberTable:
    """Return the table in a text file; `InputError`, with the line, where rows differ in length. See `read_rows`."""
    rows = read_rows(path, missing=missing)
    width = len(rows[0][1])
    for number, row in rows:
        if len(row) != width:
            raise InputError(f"{path}, line {number}: found {len(row)} numbers where earlier lines have {width}")
    lines = text_lines(path)[: rows[-1][0]]
    comments = "\n".join(line for line in lines if line.lstrip().startswith("#"))
    columns = next((found for line in lines[: rows[0][0] - 1] if (found := named_columns(line)) is not None), None)
    if columns is not None and columns.count != width:
        fault = f"found {width} numbers where the header names {columns.count} columns"
        raise InputError(f"{path}, line {rows[0][0]}: {fault}; correct the header or remove it")
    values, numbers = np.array([row for _, row in rows]), np.array([number for number, _ in rows])
    return NumberTable(path, values, numbers, comments, columns)


def tum_poses(table: NumberTable, unit: Unit) -> tuple[np.ndarray, str]:
    """Return the poses (N, 4, 4), mm, of `stamp tx ty tz qx qy qz qw` rows, and unit and order of columns in words."""
    mm_per_unit, words = table.unit(unit)
    order = "" if table.columns is None else table.columns.words
    with np.errstate(over="ignore"):  # refused as a position that no camera has
        positions_mm = table.values[:, 1:4] * mm_per_unit
    T = from_quaternions(table.values[:, 4:], positions_mm, table.where)
    return T, ", ".join(filter(None, (words, order)))


def read_tum(path: Path, unit: Unit) -> Trajectory:
    """Read TUM rows, or those of a file whose header names the columns of a pose.

    Whole stamps that may count frames are their numbers, unless the file states a unit of time.
    """
    table = read_numbers(file_of(path, ()))
    form = "TUM" if table.columns is None or table.columns.order == TUM_ORDER else "text with a header"
    return _stamped_poses(table.as_tum("TUM"), unit, form)


def read_euroc(path: Path, unit: Unit) -> Trajectory:
    """Read EuRoC's data.csv: time in ns, position, quaternion with the scalar first, and more, which is not used."""
    table = read_numbers(file_of(path, EUROC_FILES))
    if table.columns is None and table.values.shape[1] == _TIMED_COLUMNS:
        table = replace(table, values=table.values[:, :8])
    table = table.as_tum("EuRoC", W_FIRST)
    return _stamped_poses(table, unit, "EuRoC", table.time_unit or "ns")


def _stamped_poses(table: NumberTable, unit: Unit, form: str, time_unit: str = "") -> Trajectory:
    table, time_unit = table.sorted_by_stamp(), time_unit or table.time_unit
    stamps, (T, words) = table.values[:, 0], tum_poses(table, unit)
    source = f"{form}, camera-to-world, {words}"
    if not time_unit and are_frame_numbers(stamps):
        return stamped(T, stamps, None, f"{source}, whole stamps taken for frame numbers")
    times_s, stated = stamps_s(stamps, time_unit)
    return stamped(T, None, times_s, f"{source}, {stated}")


def is_euroc(table: NumberTable) -> bool:
    """Return whether rows without a header are EuRoC's 17 numbers: the fifth to eighth are a quaternion.

    C3VD's pose with its time before it has as many, and a row or column of 0 0 0 1.
    """
    if table.values.shape[1] != _TIMED_COLUMNS:
        return False
    matrices = table.values[:, 1:].reshape(-1, 4, 4)
    homogeneous = any(np.allclose(last, [0, 0, 0, 1]) for last in (matrices[:, 3], matrices[:, :, 3]))
    return not homogeneous and bool(np.all(np.abs(np.linalg.norm(table.values[:, 4:8], axis=1) - 1) <= _UNIT_LENGTH))


def read_kitti(path: Path, unit: Unit) -> Trajectory:
    """Read KITTI rows, the upper 3x4 of a camera-to-world pose each.

    Row = frame number, from 0, unless a file beside it states the numbers.
    """
    table = read_numbers(file_of(path, ())).with_columns(12, "KITTI")
    mm_per_unit, words = table.unit(unit)
    T = np.tile(np.eye(4), (len(table.values), 1, 1))
    T[:, :3] = table.values.reshape(-1, 3, 4)
    T[:, :3, 3] *= mm_per_unit
    numbers, rows = _frames_of_lines(table)
    return stamped(rigid(T, table.where), numbers, None, f"KITTI, camera-to-world, {words}, {rows}")


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
        numbers, rows = _frames_of_lines(table)
        return stamped(T, numbers, None, f"{source}, {rows}")
    if are_frame_numbers(table.values[:, 0]):
        return stamped(T, table.values[:, 0], None, f"{source}, whole stamps taken for frame numbers")
    times_s, words = stamps_s(table.values[:, 0])
    return stamped(T, None, times_s, f"{source}, {words}")


def _frames_of_lines(table: NumberTable) -> tuple[np.ndarray, str]:
    """Return the frame numbers (N,) of lines that state none, and in words whence: a file beside them, or the count."""
    file = numbers_file(table.path)
    if not file.is_file():
        return np.arange(len(table.values)), "row = frame"
    numbers = read_numbers(file).with_columns(1, "a list of frame numbers").values[:, 0]
    if len(numbers) != len(table.values):
        fault = f"it numbers {len(numbers)} lines, {table.path.name} has {len(table.values)}"
        raise InputError(f"reading {file}: {fault}; export again, or remove it")
    if not are_frame_numbers(numbers) or np.any(np.diff(numbers) <= 0):
        raise InputError(f"reading {file}: expected ascending frame numbers, a line each")
    return numbers, f"frame numbers by {file.name}"


def read_poses(path: Path) -> np.ndarray:
    """Return the camera-to-world poses (N, 4, 4), mm, of C3VD's `pose.txt`; see `read_c3vd`. Raises `InputError`."""
    return read_c3vd(Path(path), "mm").T_world_camera
