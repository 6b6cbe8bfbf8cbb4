"""Segments of a result: parts of its time with a surface of their own, in `surfaces/`."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.errors import reporting
from scopemap.engine.fusion.mesh_files import save_mesh, save_meshes_in_time
from scopemap.engine.notices import Level

SURFACES = "surfaces"
"""Folder of a result with the surfaces of its segments."""
_TABLE = "segments.csv"
GOOD_DISAGREEMENT = 0.05
"""Median relative difference between a surface's depth and that of its frames up to which it is good."""
_BEST_FIRST: tuple[Level, ...] = ("good", "doubtful", "bad")


@dataclass(frozen=True)
class SurfaceSegment:
    """A part of a result's time with a surface of its own; a row of segments.csv.

    segment : number, from 0, in order of time. first_frame, last_frame : numbers of its first and last frame. start_s,
    end_s : their times. level : good, doubtful or bad, the verdict on this part. depth_error : median relative
    difference between the depth of its surface and that of its frames; within_10_percent : mean share of the picture in
    which they differ by less; NaN: unknown.
    """

    segment: int
    first_frame: int
    last_frame: int
    start_s: float
    end_s: float
    level: Level
    depth_error: float
    within_10_percent: float

    @property
    def duration_s(self) -> float:
        """Seconds from its first frame to its last one."""
        return self.end_s - self.start_s

    @property
    def words(self) -> str:
        """Its time, "2.4 to 9.8 s"."""
        return f"{self.start_s:.1f} to {self.end_s:.1f} s"


COLUMNS = [field.name for field in fields(SurfaceSegment)]
_FORMATS = {"start_s": ".3f", "end_s": ".3f", "depth_error": ".4f", "within_10_percent": ".3f"}


def segment_of_facts(number: int, facts: dict[str, Any], level: Level) -> SurfaceSegment:
    """Return a segment by what `provenance.json` has of it in `segments`."""
    figures = facts["surface"]
    error, within = (float(figures.get(name, np.nan)) for name in ("depth_error", "within_10_percent_mean"))
    ends = (int(facts["first_frame"]), int(facts["last_frame"]), float(facts["start_s"]), float(facts["end_s"]))
    return SurfaceSegment(number, *ends, level, error, within)


def main_segment(segments: Sequence[SurfaceSegment]) -> int:
    """Return the number of the segment whose surface stands for the result: the longest of the best grade.

    Of segments of one level those grade better whose surface agrees with their frames as a good one does.
    """

    def place(one: SurfaceSegment) -> tuple[int, bool, int]:
        return _BEST_FIRST.index(one.level), not one.depth_error <= GOOD_DISAGREEMENT, one.first_frame - one.last_frame

    return min(segments, key=place).segment


def surface_file(folder: Path, segment: int) -> Path:
    """Return the file with the surface of a segment in the folder of a result."""
    return folder / SURFACES / f"segment_{segment:03d}.ply"


def write_segments(segments: Sequence[SurfaceSegment], folder: Path) -> None:
    """Write FOLDER/surfaces/segments.csv. Raises `OSError`."""
    (folder / SURFACES).mkdir(exist_ok=True)
    with (folder / SURFACES / _TABLE).open("w", newline="", encoding="utf-8") as table:
        rows = [[_cell(name, value) for name, value in zip(COLUMNS, astuple(one), strict=True)] for one in segments]
        csv.writer(table).writerows([COLUMNS, *rows])


def save_segments(
    segments: Sequence[SurfaceSegment], surfaces: Sequence[trimesh.Trimesh], folder: Path, *, comment: str
) -> None:
    """Write the table and the surfaces of segments, and where there are several FOLDER/mesh_over_time.glb.

    Raises `OSError`.
    """
    write_segments(segments, folder)
    for one, mesh in zip(segments, surfaces, strict=True):
        save_mesh(mesh, surface_file(folder, one.segment), comment=comment)
    if len(segments) > 1:
        starts_s = [one.start_s for one in segments]
        save_meshes_in_time(surfaces, starts_s, folder / "mesh_over_time.glb", comment=comment)


def read_segments(folder: Path) -> list[SurfaceSegment]:
    """Read FOLDER/surfaces/segments.csv; [] where there is none. Raises `InputError` where it is damaged."""
    file = folder / SURFACES / _TABLE
    if not file.is_file():
        return []
    with reporting(f"cannot read {file}"), file.open(newline="", encoding="utf-8") as table:
        return [_row(row) for row in csv.DictReader(table)]


def _row(row: dict[str, str]) -> SurfaceSegment:
    level = next((one for one in _BEST_FIRST if one == row["level"]), None)
    if level is None:
        raise ValueError(f"no level is called {row['level']!r}")
    number, first, last = (int(row[name]) for name in COLUMNS[:3])
    start_s, end_s, error, within = (float(row[name] or "nan") for name in (*COLUMNS[3:5], *COLUMNS[6:]))
    return SurfaceSegment(number, first, last, start_s, end_s, level, error, within)


def _cell(name: str, value: Any) -> str:
    return "" if value != value else format(value, _FORMATS.get(name, ""))
