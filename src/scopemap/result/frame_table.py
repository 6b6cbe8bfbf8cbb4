"""FrameTable: one row for each frame of a run, from tracking through the checkpoint to frames.csv and back."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import InputError, reporting
from scopemap.engine.frame import RowTable
from scopemap.engine.tracking.causes import LossCause
from scopemap.input.source import SkippedFrame
from scopemap.input.trajectory.trajectory import OTHER_MAP, ROTATION_ONLY, SKIPPED, STATUSES, TRACKED, Trajectory

LOST = -1
ELSEWHERE = -2
NOT_USED = -3
ROTATED = -4
"""Place of a frame in no submap of the result: lost; in a submap too small to be saved; skipped; lost but for its
rotation."""

_TEXTS = ("name", "reason")
_FORMATS = {
    # "d": a whole number, -1 = unknown; NaN is unknown for the others. Empty: text.
    "index": "d",
    "time_s": ".6f",
    "name": "",
    "status": "",
    "reason": "",
    "map": "d",
    "segment": "d",
    "keyframe": "d",
    "residual": ".5g",
    "inlier_share": ".5g",
    "correlation": ".5g",
    "overlap": ".5g",
    "iterations": "d",
    "depth_scale": ".5g",
    "warped_share": ".3f",
    "usable": ".4g",
    "sharpness": ".4g",
    "motion": ".4g",
    "quality": ".4g",
    "cause": "",
    "orientation": "",
    "moving_share": ".3f",
    "moving_x": ".3f",
    "moving_y": ".3f",
}
COLUMNS = list(_FORMATS)
"""The columns of frames.csv."""


def _kind_of(column: str) -> str:
    longest = {"status": max(map(len, (*STATUSES, SKIPPED))), "cause": max(map(len, LossCause))}
    if column in longest:
        return f"U{longest[column]}"
    return {"": "O", "d": "i8"}.get(_FORMATS[column], "f8")


ROW = np.dtype(
    [
        *((name, _kind_of(name)) for name in COLUMNS if name != "orientation"),
        ("relocalised", bool),
        ("median_depth_mm", np.float64),
        ("T_world_camera", np.float64, (4, 4)),
        ("rotation", np.float64, (3, 3)),
    ]
)
_TRACKED = [name for name in ROW.names or () if name not in (*_TEXTS, "segment")]
_STORED = np.dtype([*((name, ROW[name]) for name in _TRACKED), ("text", "i8", (3,))])
"""A row on disk, as tracked; `text` : where name and reason begin, and where they end."""


@dataclass(frozen=True, eq=False)
class FrameTable:
    """What is known of each frame of a run besides its images; `table["status"]` is a column, (N,).

    Columns as in frames.csv (docs/formats.md); -1, NaN or "" is unknown. `map` : as tracked, that of the tracker; in a
    result the number of the submap, 0 for the result and N for `maps/N`, -1 where the frame is in none. `segment` : in
    a result the number of the segment of this submap, -1 where the frame is in none. `cause` : as the tracker judged
    it; in a result by `causes_of_loss`. Beside these:

    relocalised : whether features found the lost camera again in this frame. median_depth_mm : as tracked.
    T_world_camera : (N, 4, 4), NaN where the frame has no pose in this submap, but for the rotation where that was
    followed. rotation : (N, 3, 3) of a lost frame whose rotation was followed, from its camera to that of the last
    tracked frame; NaN elsewhere.
    """

    rows: np.ndarray

    @classmethod
    def of(cls, rows: Iterable[Mapping[str, Any]]) -> FrameTable:
        """Return the table of rows by column; columns that are missing or None are unknown."""
        given = list(rows)
        found = np.zeros(len(given), ROW)
        for name in ROW.names or ():
            found[name] = "" if ROW[name].kind in "OU" else -1 if ROW[name].kind == "i" else np.nan
        found["relocalised"] = False
        table = cls(found)
        for number, row in enumerate(given):
            table.put(number, row)
        return table

    def put(self, number: int, row: Mapping[str, Any]) -> None:
        """Change columns of the row with this number; what is None, or no column, is left out."""
        for name, value in row.items():
            if value is not None and name in (ROW.names or ()):
                self.rows[name][number] = value

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, column: str) -> np.ndarray:
        found: np.ndarray = self.rows[column]
        return found

    def with_skipped(self, frames: Iterable[SkippedFrame]) -> FrameTable:
        """Return the table with rows of frames that were read and not used."""
        known = ("index", "time_s", "name", "reason")
        skipped = [{name: getattr(one, name) for name in known} | {"status": SKIPPED} for one in frames]
        return FrameTable(np.concatenate([self.rows, FrameTable.of(skipped).rows]))

    def only(self, chosen: np.ndarray) -> FrameTable:
        """Return the rows that `chosen` (bool mask or row numbers) picks."""
        return FrameTable(self.rows[chosen])

    @property
    def tracked(self) -> np.ndarray:
        """(N,) bool, whether the frame has a pose in this submap."""
        return np.isin(self["status"], TRACKED)

    @property
    def lost(self) -> np.ndarray:
        """(N,) bool, whether the frame has no pose in any submap, though perhaps a rotation."""
        return np.isin(self["status"], ("lost", ROTATION_ONLY))

    @property
    def submap(self) -> np.ndarray:
        """(N,) int64, the number of the frame's submap, the table's own 0, or `LOST`, `ROTATED`, ..."""
        status = self["status"]
        outside = np.select([status == name for name in ("lost", ROTATION_ONLY, SKIPPED)], [LOST, ROTATED, NOT_USED], 0)
        elsewhere = np.where(self["map"] > 0, self["map"], ELSEWHERE)
        return np.where(self.tracked, 0, np.where(status == OTHER_MAP, elsewhere, outside))

    @property
    def counts(self) -> dict[str, int]:
        """How many frames were used, are tracked in this submap, lost, of these with a rotation, and tracked in another
        submap.
        """
        rotated, elsewhere = (int(np.sum(self["status"] == name)) for name in (ROTATION_ONLY, OTHER_MAP))
        lost = {"lost": int(self.lost.sum()), "rotation_only": rotated}
        return (
            {"frames": int(np.sum(self["status"] != SKIPPED)), "tracked": int(self.tracked.sum())}
            | lost
            | {"in_other_maps": elsewhere}
        )

    @property
    def trajectory(self) -> Trajectory:
        """The poses of the frames that were used, with their status."""
        used = self.rows[self["status"] != SKIPPED]
        return Trajectory(used["index"], used["time_s"], used["T_world_camera"], used["status"])

    def write(self, file: Path) -> None:
        """Write frames.csv, in the order of the numbers. Raises `OSError`."""
        columns = [self.cells(name) for name in COLUMNS]
        rows = list(zip(*columns, strict=True))
        # A file's name may hold bytes that are no UTF-8.
        with file.open("w", newline="", encoding="utf-8", errors="replace") as table:
            csv.writer(table).writerows(
                [COLUMNS, *(rows[number] for number in np.argsort(self["index"], kind="stable"))]
            )

    def cells(self, column: str) -> list[str]:
        """Return a column as frames.csv has it."""
        if column == "orientation":
            rotated = self["status"] == ROTATION_ONLY
            T = self["T_world_camera"]
            return [_quaternion(T[row, :3, :3]) if rotated[row] else "" for row in range(len(self))]
        values, form = self[column].tolist(), _FORMATS[column]
        if form == "d":
            return ["" if value == -1 else str(value) for value in values]
        return ["" if value != value else f"{value:{form}}" for value in values]

    @classmethod
    def read(cls, file: Path) -> FrameTable:
        """Read a frames.csv, which needs index, time_s and status; a frame has no pose but its rotation, if it has one.

        Raises `InputError` where it cannot be read.
        """
        with reporting(f"cannot read {file}: every row needs index, time_s and status"):
            if not file.is_file():  # a pipe would be waited for
                raise FileNotFoundError("there is no such file")
            # Names of files may hold what Python takes for the end of a line.
            with file.open(newline="", encoding="utf-8") as lines:
                texts = list(csv.DictReader(lines))
            table = cls.of([{}] * len(texts))
            table.rows["index"] = [int(row["index"]) for row in texts]
            table.rows["time_s"] = [float(row["time_s"]) for row in texts]
            table.rows["status"] = [row["status"] for row in texts]
            for name in {*COLUMNS} & {*(ROW.names or ())} - {"index", "time_s", "status"}:
                table.rows[name] = [_value(name, row.get(name) or "") for row in texts]
        used = table["index"][table["status"] != SKIPPED]
        if np.any(np.diff(used) <= 0) or not set(table["status"].tolist()) <= {*STATUSES, SKIPPED}:
            raise InputError(f"cannot read {file}: index must ascend and status be one of {', '.join(STATUSES)}")
        for row in np.flatnonzero(table["status"] == ROTATION_ONLY):
            with reporting(f"cannot read {file}: the orientation of frame {table['index'][row]} is no quaternion"):
                quaternion = [float(number) for number in texts[row]["orientation"].split()]
                table.rows["T_world_camera"][row, :3, :3] = Rotation.from_quat(quaternion).as_matrix()
        return table


class GrowingFrameTable:
    """Takes the row of each frame as tracked, and returns the table of all of them.

    table : where they are kept; as objects those of hours of video would take hundreds of megabytes.
    """

    def __init__(self, table: RowTable) -> None:
        self._rows, self._texts = table("frame_table", _STORED), table("frame_texts", np.dtype(np.uint8))

    @property
    def last_index(self) -> int:
        """Number of the last frame, -1 before the first."""
        return int(self._rows.read(len(self) - 1, 1)["index"][0]) if len(self) else -1

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self._rows)

    def append(self, row: Mapping[str, Any]) -> None:
        """Put a row in, by column as in `FrameTable.of`."""
        one = FrameTable.of([row]).rows
        stored = np.zeros(1, _STORED)
        for name in _TRACKED:
            stored[name] = one[name]
        # A file's name may hold bytes that are no UTF-8.
        texts = [one[name][0].encode("utf-8", "surrogateescape") for name in _TEXTS]
        stored["text"] = len(self._texts) + np.cumsum([0, *map(len, texts)])
        self._texts.append(np.frombuffer(b"".join(texts), np.uint8))
        self._rows.append(stored)

    def read(self) -> FrameTable:
        """Return all rows."""
        stored, texts = self._rows.read(), self._texts.read().tobytes()
        rows = np.zeros(len(stored), ROW)
        rows["segment"] = -1
        for name in _TRACKED:
            rows[name] = stored[name]
        for column, name in enumerate(_TEXTS):
            ends = stored["text"][:, column : column + 2].tolist()
            rows[name] = [texts[begin:end].decode("utf-8", "surrogateescape") for begin, end in ends]
        return FrameTable(rows)

    def thin(self) -> set[int]:
        """Forget every second one of the older half; return the numbers of these frames."""
        kept = np.ones(len(self), bool)
        kept[1 : len(self) // 2 : 2] = False
        forgotten = self._rows.read()["index"][~kept]
        self._rows.keep(kept)
        return set(forgotten.tolist())


def _value(column: str, text: str) -> str | int | float:
    """Return the value that a cell of frames.csv stands for."""
    if column == "cause":
        return LossCause(text)
    form = _FORMATS[column]
    if not form:
        return text
    return int(text or -1) if form == "d" else float(text or "nan")


def _quaternion(R: np.ndarray) -> str:
    return " ".join(f"{number:.6f}" for number in Rotation.from_matrix(R).as_quat(canonical=True))
