"""The problem of bundle adjustment: reprojection errors of points on rays of their host keyframe, and derivatives.

A point p is on the ray of a pixel of its host keyframe h at depth exp(u_p). With T_h, T_t from world to camera, another
keyframe t observes it at project(T_t T_h^-1 exp(u_p) ray_p).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.se3 import inverse

_LEAST_Z = 1e-3  # guard: points nearer to the camera's plane, over their distance, are behind it
_AT_ONCE = 20_000  # guard: observations whose derivatives are in memory at once, 1 kB each


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

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All three."""
        return self.point, self.keyframe, self.pixel


Moved = Callable[[slice], np.ndarray]
"""Returns by how much (n, 3) mm the points of some observations have moved in the world since their hosts saw them."""


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

    @cached_property
    def first_seen(self) -> np.ndarray:
        """First observation of each point, and their number (P + 1,)."""
        first: np.ndarray = np.searchsorted(self.observations.point, np.arange(len(self.points.host) + 1))
        return first

    @cached_property
    def parts(self) -> list[slice]:
        """The points, in parts that are observed so often that the derivatives of one are in memory."""
        inner = np.searchsorted(self.first_seen, np.arange(_AT_ONCE, self.first_seen[-1], _AT_ONCE))
        ends = np.unique(np.concatenate([[0], inner, [len(self.points.host)]])).tolist()
        return [slice(*both) for both in pairwise(ends)]

    def seen(self, points: slice) -> slice:
        """Return the observations of successive points."""
        return slice(*self.first_seen[[points.start, points.stop]].tolist())

    @property
    def begin(self) -> State:
        """The state to begin with: `start`, or as tracked."""
        return self.tracked if self.start is None else self.start

    @cached_property
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


class Errors(NamedTuple):
    """Errors of all observations (N, 2) px, 0 behind the camera, and which are ahead of it (N,) bool."""

    error: np.ndarray
    ahead: np.ndarray


class Reprojection(NamedTuple):
    """Errors of n observations as in `Errors`, and what their derivatives need."""

    error: np.ndarray  # (n, 2) px
    ahead: np.ndarray  # (n,) bool
    point: np.ndarray  # (n, 3) in the observing camera
    in_host: np.ndarray  # (n, 3) in the host's
    R: np.ndarray  # (n, 3, 3) from the host to the observing camera
    pixel: np.ndarray  # (n, 2) px from the principal point


def reprojection_errors(problem: BundleProblem, state: State, moved: Moved | None = None) -> Errors:
    """Return the errors of all observations; moved : as `reproject` takes it."""
    error, ahead = np.zeros((len(problem.observations.point), 2)), np.zeros(len(problem.observations.point), bool)
    for points in problem.parts:
        some = problem.seen(points)
        error[some], ahead[some] = reproject(problem, state, points, moved)[:2]
    return Errors(error, ahead)


def reproject(problem: BundleProblem, state: State, points: slice, moved: Moved | None = None) -> Reprojection:
    """Return where some points of a state are projected, against where they were observed.

    moved : None where tissue is rigid.
    """
    some, T, focal = problem.seen(points), state.T_camera_world, np.exp(state.lens[0])
    number, observer, seen_at = (part[some] for part in problem.observations.columns)
    pixel = (problem.points.pixel[points] - state.lens[1:]) / focal
    rays = np.column_stack([pixel, np.ones(len(pixel))])
    in_host = (np.exp(state.log_depth[points])[:, None] * rays)[number - points.start]
    pairs, which = problem.pairs[0], problem.pairs[1][some]
    least = int(which.min(initial=len(pairs)))  # pairs are sorted by host, too
    pairs, which = pairs[least : which.max(initial=0) + 1], which - least
    between = T[pairs % len(T)] @ inverse(T)[pairs // len(T)]
    R = between[which, :3, :3]
    seen = np.einsum("nij,nj->ni", R, in_host) + between[which, :3, 3]
    if moved is not None:
        seen += np.einsum("nij,nj->ni", T[observer, :3, :3], moved(some))
    ahead = seen[:, 2] > _LEAST_Z * np.linalg.norm(seen, axis=1)
    pixel = focal * seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None]
    error = np.where(ahead[:, None], pixel - (seen_at - state.lens[1:]), 0.0)
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
        in_host = focal * seen.in_host[:, :2] / seen.in_host[:, 2:]
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
