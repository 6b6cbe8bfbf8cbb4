"""What all formats share: poses are checked to be rigid, made exactly so, and put into a `Trajectory`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import orthonormalised
from scopemap.input.trajectory.trajectory import ASSUMED_FRAMES_PER_S, Trajectory

_RIGID_TOLERANCE = 1e-2
# Of any unit: the moon is nearer. From 1e154 on squares of positions overflow, and errors are no numbers.
_FARTHEST_MM = 1e12


def rigid(T: np.ndarray, where: list[str]) -> np.ndarray:
    """Return poses (N, 4, 4) with exact rotations; `InputError`, with its `where`, at the first that is not rigid."""
    wrong = np.flatnonzero(~np.isfinite(T).all(axis=(1, 2)))
    if wrong.size:
        raise InputError(f"{where[wrong[0]]}: a pose holds NaN or infinity; leave out frames without a pose")
    check_near(T[:, :3, 3], where)
    R = T[:, :3, :3]
    deviation = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    bottom = np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
    wrong = np.flatnonzero((deviation > _RIGID_TOLERANCE) | (np.linalg.det(R) < 0) | (bottom > _RIGID_TOLERANCE))
    if wrong.size:
        raise InputError(
            f"{where[wrong[0]]}: not a rigid motion (R^T R is off the identity by {deviation[wrong[0]]:.3g}, det R = "
            f"{np.linalg.det(R[wrong[0]]):.3g}); poses must be without scale"
        )
    # Files hold six digits or so, and the inverse by transposition needs exact rotations.
    return orthonormalised(T)


def check_near(positions_mm: np.ndarray, where: list[str]) -> None:
    """Raise `InputError`, with its `where`, at the first of positions (N, 3), mm, that no camera has."""
    wrong = np.flatnonzero((np.abs(positions_mm) > _FARTHEST_MM).any(axis=1))  # NaN has a sentence of its own
    if wrong.size:
        farthest = np.abs(positions_mm[wrong[0]]).max()
        raise InputError(f"{where[wrong[0]]}: a position of {farthest:.3g} mm is none of a camera; correct the number")


def from_quaternions(xyzw: np.ndarray, positions: np.ndarray, where: list[str]) -> np.ndarray:
    """Return motions (N, 4, 4) of unit quaternions (N, 4), scalar last, and translations (N, 3); checks the lengths."""
    norms = np.linalg.norm(xyzw, axis=1)
    wrong = np.flatnonzero(~(np.abs(norms - 1.0) <= _RIGID_TOLERANCE))
    if wrong.size:
        raise InputError(f"{where[wrong[0]]}: the quaternion has length {norms[wrong[0]]:.3g} instead of 1")
    check_near(positions, where)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    if len(positions):
        T[:, :3, :3] = Rotation.from_quat(xyzw).as_matrix()
        T[:, :3, 3] = positions
    return T


def stamped(T: np.ndarray, indices: np.ndarray | None, times_s: np.ndarray | None, source: str) -> Trajectory:
    """Return camera-to-world poses (N, 4, 4), mm, as a trajectory without lost frames.

    Without `indices` (N,) rows are counted and match nothing; without `times_s` (N,) there are 30 frames per s.
    """
    numbers = np.arange(len(T), dtype=np.int64) if indices is None else indices.astype(np.int64)
    times_s = numbers / ASSUMED_FRAMES_PER_S if times_s is None else times_s
    status = np.array(["initial"] + ["ok"] * (len(T) - 1))
    return Trajectory(numbers, times_s, T, status, has_indices=indices is not None, source=source)


def file_of(path: Path, names: tuple[str, ...]) -> Path:
    """Return `path`, or the first of the files `names` in the folder `path`; `InputError` where there is none."""
    if not path.is_dir():
        return path
    found = next((path / name for name in names if (path / name).is_file()), None)
    if found is None:
        wanted = f"looked for {' and '.join(names)}" if names else "this kind is read from a file"
        raise InputError(f"cannot read a trajectory from the folder {path}: {wanted}")
    return found
