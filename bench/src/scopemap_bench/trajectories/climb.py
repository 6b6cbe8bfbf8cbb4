"""Poses in CLiMB's layouts: the submaps of a submission's run, and a sequence's reference by COLMAP.

A run holds `camera_trajectory/cam_traj_map_000.txt`, a file per submap, of `timestamp, name_image, tx, ty, tz, qw, qx,
qy, qz`, camera-to-world. A reference is `SEQUENCE/results_txt/images.txt`; `scales.csv` beside SEQUENCE has its mm per
unit. Both count frames from 1, we from 0. Source: EndoCartoScope/climb-challenge, README.md,
submission_instructions/README.md.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import InputError, reporting
from scopemap.input.trajectory.colmap_poses import read_colmap
from scopemap.input.trajectory.poses import check_near, from_quaternions, stamped
from scopemap.input.trajectory.text import text_lines
from scopemap.input.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

CLIMB_FILES = ("camera_trajectory/cam_traj_map_*.txt", "results_txt/images.txt")
SCALES_FILE = "scales.csv"
_COLUMNS = ("timestamp", "name_image", "tx", "ty", "tz", "qw", "qx", "qy", "qz")
# The evaluation takes the digits before the first other character in one place, all digits of the name in another.
_IMAGE_NAME = re.compile(r"(\d{1,9})\D*?(\.\w+)?")


def read_climb(path: Path, unit: Unit) -> Trajectory:
    """Read a submission's run, its first submap with `others`, or a reference, which `scales.csv` brings to mm."""
    if (path / "results_txt").is_dir():
        return read_climb_reference(path)
    files = [path] if path.is_file() else sorted(path.glob(CLIMB_FILES[0]))
    if not files:
        raise InputError(f"cannot read a trajectory from {path}: looked for {' and '.join(CLIMB_FILES)}")
    first, *others = (read_submap(file, unit) for file in files)
    return replace(first, others=tuple(others))


def read_climb_reference(folder: Path) -> Trajectory:
    """Return the reference poses of the sequence in `folder`; without a scale its unit is taken as mm."""
    found = read_colmap(folder / "results_txt" / "images.txt", "mm")
    if found.indices[0] < 1:
        raise InputError(f"reading {folder}: images are numbered from 1, found one numbered {found.indices[0]}")
    scale = _scale_mm(folder.absolute())
    T = found.T_world_camera.copy()
    T[:, :3, 3] *= scale or 1.0
    check_near(T[:, :3, 3], [f"{folder}, image {index}" for index in found.indices])
    words = f"mm by {SCALES_FILE}" if scale else f"scale unknown (not in {SCALES_FILE}), mm (assumed)"
    source = f"CLiMB reference (COLMAP), world-to-camera inverted, {words}"
    return replace(found, T_world_camera=T, indices=found.indices - 1, source=source)


def _scale_mm(sequence: Path) -> float | None:
    """Return mm per unit of a sequence's reference; None where `scales.csv` does not list it."""
    file = sequence.parent / SCALES_FILE
    if not file.is_file():
        return None
    with reporting(f"reading {file}: every row needs sequence and scale_to_target"):
        scales = {row["sequence"].strip(): float(row["scale_to_target"]) for row in csv.DictReader(text_lines(file))}
        scale = scales.get(sequence.name)
        if scale is not None and not 0 < scale < np.inf:
            raise ValueError(f"the scale of {sequence.name} is {scale}")
        return scale


def read_submap(file: Path, unit: Unit = "mm") -> Trajectory:
    """Return the finite poses of a submap; `InputError`, with the line, for a row that the evaluation cannot score."""
    rows: dict[int, list[float]] = {}
    where: list[str] = []
    for frame, row, place in submap_rows(file):
        if frame in rows:
            raise InputError(f"{place}: frame {frame} is repeated")
        if np.isfinite(row[1:]).all():
            rows[frame] = row
            where.append(place)
    if not rows:
        raise InputError(f"reading {file}: it holds no pose")
    frames, values = np.array(list(rows)), np.array(list(rows.values()))
    T = from_quaternions(np.roll(values[:, 4:], -1, axis=1), values[:, 1:4] * MM_PER_UNIT[unit], where)
    order = np.argsort(frames)
    source = f"CLiMB submission, camera-to-world, {unit} (assumed)"
    return stamped(T[order], frames[order] - 1, values[order, 0], source)


def submap_rows(file: Path) -> Iterator[tuple[int, list[float], str]]:
    """Yield frame, from 1, the numbers timestamp tx ty tz qw qx qy qz, finite or not, and the place of each row."""
    for number, line in enumerate(text_lines(file), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            place = f"{file}, line {number}"
            yield *_row(line, place), place


def _row(line: str, where: str) -> tuple[int, list[float]]:
    """Return frame, from 1, and the numbers timestamp tx ty tz qw qx qy qz of a row; more columns are allowed."""
    fields = [field.strip() for field in line.split(",")]
    if len(fields) < len(_COLUMNS):
        raise InputError(f"{where}: found {len(fields)} fields, expected {len(_COLUMNS)}, separated by commas")
    name = _IMAGE_NAME.fullmatch(fields[1])
    if name is None or int(name[1]) < 1:
        raise InputError(f"{where}: the image name {fields[1]!r} must begin with its only number, the frame's, from 1")
    with reporting(f"{where}: expected numbers"):
        return int(name[1]), [float(field) for field in (fields[0], *fields[2:9])]


def write_submap(file: Path, trajectory: Trajectory) -> None:
    """Write the tracked frames of a trajectory, mm; lost frames have no row."""
    kept = trajectory.rows(trajectory.tracked)
    wxyz = np.roll(Rotation.from_matrix(kept.T_world_camera[:, :3, :3]).as_quat(canonical=True), 1, axis=1)
    rows = np.column_stack([kept.times_s, kept.indices + 1, kept.positions_mm, wxyz])
    np.savetxt(file, rows, fmt="%.6f,%06d.png" + ",%.9f" * 7, header=", ".join(_COLUMNS))
