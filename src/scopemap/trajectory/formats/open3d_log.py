"""Open3D's `.log` files: a line of three integers per pose, then four lines of its 4x4 matrix.

The form is Redwood's (redwood-data.org/indoor/fileformat.html); Open3D (io/file_format/FileLOG.cpp) writes `i i i+1`
and the camera-to-world matrix, the inverse of its `extrinsic`.

Endo-Depth-and-Motion (UZ-SLAMLab, apps/tracking_ours and apps/volumetric_fusion) writes `trajectory.log` with Open3D,
but puts its world-to-camera matrices (`c_pose_w`) where Open3D has camera-to-world; it tracks in metres, as it divides
depth in mm by 1000. The two look alike, so a `.log` is read only when its kind is named.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.poses import are_frame_numbers, file_of, rigid, stamped
from scopemap.trajectory.formats.text import fields_of, parse_row, text_lines
from scopemap.trajectory.trajectory import MM_PER_UNIT, Trajectory, Unit

LOG_FILE = "trajectory.log"
_WIDTHS = (3, 4, 4, 4, 4)


def read_open3d(path: Path, unit: Unit) -> Trajectory:
    """Read a log of camera-to-world poses, in `unit`; its first integers are the frames' numbers where they ascend."""
    T, indices = _read_log(file_of(path, (LOG_FILE,)), unit)
    return stamped(T, indices, None, f"Open3D log, camera-to-world, {unit} (assumed)")


def read_endo_depth(path: Path, unit: Unit) -> Trajectory:
    """Read a log of Endo-Depth-and-Motion: world-to-camera, always metres."""
    T, indices = _read_log(file_of(path, (LOG_FILE,)), "m")
    return stamped(inverse(T), indices, None, "Endo-Depth-and-Motion log, world-to-camera inverted, m")


def _read_log(path: Path, unit: Unit) -> tuple[np.ndarray, np.ndarray]:
    lines = [(number, fields_of(line)) for number, line in enumerate(text_lines(path), start=1)]
    lines = [(number, fields) for number, fields in lines if fields]
    if not lines or len(lines) % len(_WIDTHS):
        raise InputError(
            f"cannot read a trajectory from {path}: a log has five lines per pose, found {len(lines)} lines in all"
        )
    rows = []
    for row, (number, fields) in enumerate(lines):
        width = _WIDTHS[row % len(_WIDTHS)]
        if len(fields) != width:
            raise InputError(f"{path}, line {number}: found {len(fields)} numbers where a log has {width}")
        rows.append(parse_row(fields, f"{path}, line {number}"))
    blocks = [rows[start : start + len(_WIDTHS)] for start in range(0, len(rows), len(_WIDTHS))]
    T = np.array([block[1:] for block in blocks])
    T[:, :3, 3] *= MM_PER_UNIT[unit]
    numbers = np.array([block[0][0] for block in blocks])
    count_frames = are_frame_numbers(numbers) and bool(np.all(np.diff(numbers) > 0))
    where = [f"{path}, line {number}" for number, _ in lines[:: len(_WIDTHS)]]
    return rigid(T, where), numbers if count_frames else np.arange(len(T))
