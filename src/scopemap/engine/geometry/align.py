"""Alignment of trajectories: similarity of estimated to true world (Umeyama, IEEE TPAMI 13(4), 1991, eq. 34-43)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scopemap.engine.errors import AlignmentError, check_shape
from scopemap.engine.geometry.se3 import inverse, so3_exp

AlignMode = Literal["none", "origin", "se3", "sim3", "scale"]

# Singular values below this share of the largest are rounding, not motion.
_RANK_TOLERANCE = 1e-12
# Below this ratio of the variances along its second and first axis a path is nearly a straight line: errors of its
# positions turn the rotation about it by any angle.
_STRAIGHT = 1e-3  # by hand


@dataclass(frozen=True)
class Similarity:
    """Takes points x to `scale * R x + t`; R (3, 3), t (3,) mm.

    straight : whether the turn about a nearly straight path was fitted to the orientations, not to the positions.
    """

    scale: float
    R: np.ndarray
    t: np.ndarray
    straight: bool = False

    @classmethod
    def identity(cls) -> Similarity:
        """Return the similarity that changes nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    def inverse(self) -> Similarity:
        """Return the similarity that undoes this one."""
        return Similarity(1 / self.scale, self.R.T, -self.R.T @ self.t / self.scale)

    def after(self, first: Similarity) -> Similarity:
        """Return the similarity that does `first` and then this one."""
        return Similarity(self.scale * first.scale, self.R @ first.R, self.transform_points(first.t))

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Return points of shape (..., 3), mm, moved to the reference world."""
        return self.scale * points @ self.R.T + self.t

    def transform_poses(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Return poses of shape (N, 4, 4) moved to the reference world; the scale acts on positions only."""
        moved = np.array(T_world_camera, dtype=np.float64)
        moved[..., :3, :3] = self.R @ moved[..., :3, :3]
        moved[..., :3, 3] = self.transform_points(moved[..., :3, 3])
        return moved


def umeyama(points_from: np.ndarray, points_to: np.ndarray, with_scale: bool, *, least_rank: int = 2) -> Similarity:
    """Return the similarity with the least squared error between (N, 3), mm, matched rows (Umeyama 1991, eq. 34-43).

    A straight line or a single place leaves the rotation free: `AlignmentError`, with the singular values. least_rank :
    1 takes a line, too, about which any turn fits.
    """
    check_shape("points_from", points_from, (None, 3))
    check_shape("points_to", points_to, (len(points_from), 3))
    mean_from, mean_to = points_from.mean(axis=0), points_to.mean(axis=0)
    centred_from, centred_to = points_from - mean_from, points_to - mean_to
    covariance = centred_to.T @ centred_from / len(points_from)
    U, D, Vt = np.linalg.svd(covariance)
    _refuse_degenerate(D, float(np.linalg.norm(points_from) * np.linalg.norm(points_to)) / len(points_from), least_rank)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U * signs @ Vt
    scale = float(D @ signs / np.mean(np.sum(centred_from**2, axis=1))) if with_scale else 1.0
    return Similarity(scale, R, mean_to - scale * R @ mean_from)


def _refuse_degenerate(singular_values: np.ndarray, magnitude: float, least_rank: int) -> None:
    moving = singular_values[0] > _RANK_TOLERANCE * magnitude
    rank = int(np.sum(singular_values > _RANK_TOLERANCE * singular_values[0])) if moving else 0
    if rank < least_rank:
        values = ", ".join(f"{value:.3g}" for value in singular_values)
        raise AlignmentError(
            f"cannot fit a rotation: the positions are {'on one line' if rank else 'in one place'} (singular values of "
            f"their covariance: {values}); align by 'origin' or 'none' instead"
        )


def align_trajectories(
    estimated: np.ndarray,
    reference: np.ndarray,
    mode: AlignMode,
    *,
    first: int | None = None,
    by_orientations: bool = False,
) -> tuple[np.ndarray, Similarity]:
    """Return the estimated poses moved onto the reference, and the similarity that moved them.

    Both are (N, 4, 4) float64 camera-to-world, mm, matched row by row. `none` moves nothing, `origin` puts the first
    poses onto each other, `se3` and `sim3` fit the positions (`umeyama`), `scale` takes the scale of the `sim3` fit and
    neither rotates nor translates. `first` fits the first rows only (evo's `--n_to_align`) and moves all.
    `by_orientations` fits the turn about the path, where either is nearly straight, to the orientations.
    Raises `AlignmentError` where the fit is degenerate, `mode` is unknown, or `first` is given to a mode that fits
    nothing.
    """
    check_shape("estimated", estimated, (None, 4, 4))
    check_shape("reference", reference, (len(estimated), 4, 4))
    if first is not None and mode in ("none", "origin"):
        raise AlignmentError(
            f"cannot fit the first {first} frames: alignment '{mode}' fits none; use se3, sim3 or scale"
        )
    if first is not None and first < 3:
        raise AlignmentError(f"cannot fit the first {first} frames: a rotation needs at least 3 positions")
    similarity = _fit(estimated[:first], reference[:first], mode, by_orientations)
    return similarity.transform_poses(estimated), similarity


def _fit(estimated: np.ndarray, reference: np.ndarray, mode: AlignMode, by_orientations: bool) -> Similarity:
    if mode == "none":
        return Similarity.identity()
    if mode == "origin":
        T = reference[0] @ inverse(estimated[0])
        return Similarity(1.0, T[:3, :3], T[:3, 3])
    if mode in ("se3", "sim3", "scale"):
        positions, least_rank = (estimated[:, :3, 3], reference[:, :3, 3]), 1 if by_orientations else 2
        found = umeyama(*positions, with_scale=mode != "se3", least_rank=least_rank)
        if by_orientations and mode != "scale":
            found = _turned(found, estimated, reference)
        return replace(found, R=np.eye(3), t=np.zeros(3)) if mode == "scale" else found
    raise AlignmentError(f"unknown alignment '{mode}': choose none, origin, se3, sim3 or scale")


def _turned(found: Similarity, estimated: np.ndarray, reference: np.ndarray) -> Similarity:
    """Return the similarity turned about the path, where either is nearly straight, so that orientations agree best.

    The turn by t about the unit vector a that maximises the trace of R_turn^T M, M = sum of R_reference R_estimated^T,
    which is cos t (tr M - a^T M a) + sin t (a . v) + a^T M a, v the vector of M - M^T.
    """
    centre = reference[:, :3, 3].mean(0)
    paths = (found.transform_points(estimated[:, :3, 3]), reference[:, :3, 3])
    spreads, axes = zip(*(np.linalg.svd(path - path.mean(0), full_matrices=False)[1:] for path in paths), strict=True)
    ratios = [spread[1] / spread[0] for spread in spreads]
    axis = axes[int(np.argmin(ratios))][0]
    if not min(ratios) ** 2 < _STRAIGHT:
        return found
    M = np.einsum("nij,nkj->ik", reference[:, :3, :3], found.R @ estimated[:, :3, :3])
    v = np.array([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])
    turn = so3_exp(np.arctan2(axis @ v, np.trace(M) - axis @ M @ axis) * axis)
    return Similarity(found.scale, turn @ found.R, centre + turn @ (found.t - centre), straight=True)
