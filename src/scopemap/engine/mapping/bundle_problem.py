"""The problem of bundle adjustment: reprojection errors of points on rays of their host keyframe, and derivatives.

A point p is on the ray of a pixel of its host keyframe h at depth exp(u_p). With T_h, T_t from world to camera, another
keyframe t observes it at project(T_t T_h^-1 exp(u_p) ray_p).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.se3 import inverse

_LEAST_Z = 1e-3  # guard: points nearer to the camera's plane, over their distance, are behind it


@dataclass(frozen=True)
class Points:
    """P points, sorted by host.

    host : (P,) int, number of the keyframe whose pixel they are. pixel : (P, 2) from the principal point, px, y times
    fx / fy. log_depth : (P,) ln of the estimated depth, mm. sigma : (P,) its standard deviation, so the relative error
    of the depth.
    """

    host: np.ndarray
    pixel: np.ndarray
    log_depth: np.ndarray
    sigma: np.ndarray

    @property
    def median_mm(self) -> float:
        """Median of the estimated depths, mm."""
        return float(np.exp(np.median(self.log_depth)))


@dataclass(frozen=True)
class Observations:
    """N observations, sorted by point: point (N,) int, keyframe (N,) int, pixel (N, 2) as in `Points`."""

    point: np.ndarray
    keyframe: np.ndarray
    pixel: np.ndarray


class Priors(NamedTuple):
    """Standard deviations of what is known beforehand.

    scale : of ln of a keyframe's depth scale, 0 holds it. rotation_rad, translation_share : of the tracked motion
    between neighbouring keyframes, rad and share of the typical depth.
    """

    scale: float = 0.1
    rotation_rad: float = 0.05
    translation_share: float = 0.1


@dataclass(frozen=True)
class BundleProblem:
    """What is adjusted.

    T_camera_world : (K, 4, 4) as tracked. points, observations, priors : as named. neighbours : (C, 2) int, pairs of
    keyframes between which the motion was tracked. focal_px : fx, as expected where the lens is unknown. start : where
    to begin, None: as tracked. lens_sigma : (3,) standard deviations of `State.lens` from what is expected, None: it is
    known. least_sigma_px : of the reprojection errors. correlated : so many observations count as one, since errors of
    flow are alike at neighbouring corners. held : so many first keyframes keep pose and scale; the first one keeps its
    pose in any case.
    """

    T_camera_world: np.ndarray
    points: Points
    observations: Observations
    priors: Priors
    neighbours: np.ndarray
    focal_px: float
    start: State | None = None
    lens_sigma: np.ndarray | None = None
    least_sigma_px: float = 0.1
    correlated: float = 1.0
    held: int = 0

    @cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of host and observer (Q,), host K + observer, and which of them each observation (N,) has."""
        host, count = self.points.host[self.observations.point], len(self.T_camera_world)
        pairs, which = np.unique(host * count + self.observations.keyframe, return_inverse=True)
        return pairs, which

    @property
    def begin(self) -> State:
        """The state to begin with: `start`, or as tracked."""
        return self.tracked if self.start is None else self.start

    @property
    def unit_mm(self) -> float:
        """Typical depth, the unit of translations."""
        return self.points.median_mm

    @property
    def tracked(self) -> State:
        """The state as tracked."""
        count, lens = len(self.T_camera_world), np.array([np.log(self.focal_px), 0.0, 0.0])
        return State(self.T_camera_world, np.zeros(count), self.points.log_depth, lens)


class State(NamedTuple):
    """T_camera_world (K, 4, 4), ln of the depth scales (K,), ln of the depths (P,).

    lens : (3,) ln f, and how far the principal point is from where it was taken to be, px.
    """

    T_camera_world: np.ndarray
    log_scale: np.ndarray
    log_depth: np.ndarray
    lens: np.ndarray
    sigma_px: float = float("nan")


class Reprojection(NamedTuple):
    """Errors of all observations, and what their derivatives need."""

    error: np.ndarray  # (N, 2) px, 0 behind the camera
    ahead: np.ndarray  # (N,) bool
    point: np.ndarray  # (N, 3) in the observing camera
    in_host: np.ndarray  # (N, 3) in the host's
    R: np.ndarray  # (N, 3, 3) from the host to the observing camera
    pixel: np.ndarray  # (N, 2) px from the principal point


def reproject(problem: BundleProblem, state: State, moved: np.ndarray | None = None) -> Reprojection:
    """Return where the points of a state are projected, against where they were observed.

    moved : (N, 3) mm, by how much a point has moved in the world when it is observed; None: tissue is rigid.
    """
    points, observations, T = problem.points, problem.observations, state.T_camera_world
    focal = np.exp(state.lens[0])
    rays = np.column_stack([(points.pixel - state.lens[1:]) / focal, np.ones(len(points.host))])
    in_host = (np.exp(state.log_depth)[:, None] * rays)[observations.point]
    pairs, which = problem.pairs
    between = T[pairs % len(T)] @ inverse(T)[pairs // len(T)]
    R = between[which, :3, :3]
    seen = np.einsum("nij,nj->ni", R, in_host) + between[which, :3, 3]
    if moved is not None:
        seen += np.einsum("nij,nj->ni", T[observations.keyframe, :3, :3], moved)
    ahead = seen[:, 2] > _LEAST_Z * np.linalg.norm(seen, axis=1)
    pixel = focal * seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None]
    error = np.where(ahead[:, None], pixel - (observations.pixel - state.lens[1:]), 0.0)
    return Reprojection(error, ahead, seen, in_host, R, pixel)


def jacobians(
    problem: BundleProblem, state: State, seen: Reprojection
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives of pixels by twists of the observing camera and of the host (N, 2, 6), ln depth and lens.

    By ln depth (N, 2); by the lens (N, 2, 3), (N, 2, 0) where it is known. Translations are in units of the typical
    depth.
    """
    focal, z = np.exp(state.lens[0]), np.where(seen.ahead, seen.point[:, 2], 1.0)
    by_point = np.zeros((len(z), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = focal / z
    by_point[:, :, 2] = -seen.pixel / z[:, None]
    by_lens = np.zeros((len(z), 2, 0))
    if problem.lens_sigma is not None:
        in_host = problem.points.pixel[problem.observations.point] - state.lens[1:]
        by_corner = (by_point @ seen.R)[..., :2] * (seen.in_host[:, 2] / focal)[:, None, None]
        by_focal = seen.pixel[..., None] - by_corner @ in_host[..., None]
        by_lens = np.concatenate([by_focal, np.eye(2) - by_corner], -1)
    by_host = by_point @ seen.R
    by_depth = np.einsum("nij,nj->ni", by_host, seen.in_host)
    unit_mm = problem.unit_mm
    return _by_twist(by_point, seen.point, unit_mm), -_by_twist(by_host, seen.in_host, unit_mm), by_depth, by_lens


def _by_twist(by_point: np.ndarray, points: np.ndarray, unit_mm: float) -> np.ndarray:
    """Derivative (N, 2, 6) by a twist (rotation, translation) of points (N, 3), from that by the points (N, 2, 3)."""
    # d(exp(w) X)/dw = -hat(X), and a row vector times -hat(X) is the cross product X x row.
    return np.concatenate([np.cross(points[:, None], by_point), unit_mm * by_point], -1)
