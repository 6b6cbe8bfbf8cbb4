"""Open3D's `.log` files: a line of three integers per pose, then four lines of its 4x4 matrix.

The form is Redwood's (redwood-data.org/indoor/fileformat.html); Open3D (io/file_format/FileLOG.cpp) writes `i i i+1`
and the camera-to-world matrix. Endo-Depth-and-Motion (UZ-SLAMLab) writes `trajectory.log` with Open3D, but puts its
world-to-camera matrices, in metres, there. The two look alike, so a `.log` is read only when its kind is named.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.poses import are_frame_numbers, file_of, rigid, stamped
from scopemap.trajectory.formats.text import read_rows
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
    rows = read_rows(path)
    period = len(_WIDTHS)
    heads = rows[::period]
    if [len(numbers) for _, numbers in rows] != [*_WIDTHS] * len(heads):
        raise InputError(f"reading {path}: a log has lines of 3, 4, 4, 4 and 4 numbers for each pose")
    T = np.array([numbers for row, (_, numbers) in enumerate(rows) if row % period]).reshape(-1, 4, 4)
    T[:, :3, 3] *= MM_PER_UNIT[unit]
    indices = np.array([numbers[0] for _, numbers in heads])
    ascend = are_frame_numbers(indices) and bool(np.all(np.diff(indices) > 0))
    return rigid(T, [f"{path}, line {line}" for line, _ in heads]), indices if ascend else np.arange(len(T))
