"""The problem of bundle adjustment: reprojection errors of points on rays of their host keyframe, and derivatives.

A point p is on the ray of a pixel of its host keyframe h at depth exp(u_p). With T_h, T_t from world to camera, another
keyframe t observes it at project(T_t T_h^-1 exp(u_p) ray_p).

Some points of a problem, or successive keyframes alone, are a problem, too: `part_of`, `successive`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.kernels import Bool_1d, Float64_2d, Float64_3d, Int64_1d, kernel
from scopemap.engine.geometry.se3 import inverse

_LEAST_Z = 1e-3  # guard: points nearer to the camera's plane, over their distance, are behind it
_HELD_SIGMA = 0.01  # by hand: least standard deviation of ln depth of points that were adjusted before
PER_KEYFRAME = 7  # unknowns of a keyframe: rotation, translation, ln of its depth scale
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

    @cached_property
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


class Priors(NamedTuple):
    """Standard deviations of what is known beforehand.

    scale : of ln of a keyframe's depth scale, 0 holds it. rotation_rad, translation_share : of the tracked motion
    between neighbouring keyframes, rad and share of the typical depth.
    """

    scale: float = 0.1
    rotation_rad: float = 0.05
    translation_share: float = 0.1


TRACKED = Priors(scale=0.1, rotation_rad=math.radians(3.0), translation_share=0.1)  # by hand
"""Of keyframes as tracked."""
CORRELATED = 4.0  # by hand
"""So many observations of feature tracks count as one: errors of flow are alike at neighbouring corners."""


@dataclass(frozen=True)
class BundleProblem:
    """What is adjusted.

    T_camera_world : (K, 4, 4) as tracked. points, observations, priors : as named. neighbours : (C, 2) int, pairs of
    keyframes between which the motion was tracked. focal_px : fx, as expected where it is unknown. start : where to
    begin, None: as tracked. log_focal_sigma : standard deviation of ln fx, None: it is known. least_sigma_px : of the
    reprojection errors. correlated : so many observations count as one, since errors of flow are alike at neighbouring
    corners. held : so many first keyframes keep pose and scale; the first one keeps its pose in any case.
    """

    T_camera_world: np.ndarray
    points: Points
    observations: Observations
    priors: Priors
    neighbours: np.ndarray
    focal_px: float
    start: BundleState | None = None
    log_focal_sigma: float | None = None
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

    @cached_property
    def free(self) -> np.ndarray:
        """Which unknowns may change (F,): seven of each keyframe, the last its ln scale, then ln f if it is unknown."""
        keyframes = PER_KEYFRAME * len(self.T_camera_world)
        is_free = np.ones(self.unknowns, bool)
        is_free[: max(6, PER_KEYFRAME * self.held)] = False
        if self.priors.scale == 0:
            is_free[6:keyframes:PER_KEYFRAME] = False
        return np.flatnonzero(is_free)

    @property
    def unknowns(self) -> int:
        """How many unknowns there are beside the points."""
        return PER_KEYFRAME * len(self.T_camera_world) + (self.log_focal_sigma is not None)

    @cached_property
    def touched(self) -> tuple[np.ndarray, np.ndarray]:
        """Free unknowns that move each observation (N, U), and the scale of each point (P,); -1: one that is held.

        U is 12, the observer's pose and the host's, or 13 with ln f.
        """
        place = np.full(self.unknowns, -1, np.int32)
        place[self.free] = np.arange(len(self.free))
        seen, host = self.observations, PER_KEYFRAME * self.points.host
        first = np.column_stack([PER_KEYFRAME * seen.keyframe, host[seen.point]])
        columns = [place[first[:, n, None] + np.arange(6)] for n in range(2)]
        if self.log_focal_sigma is not None:
            columns.append(np.full((len(first), 1), place[-1]))
        return np.hstack(columns), place[host + 6].astype(np.int64)

    @property
    def begin(self) -> BundleState:
        """The state to begin with: `start`, or as tracked."""
        return self.tracked if self.start is None else self.start

    @cached_property
    def unit_mm(self) -> float:
        """Typical depth, the unit of translations."""
        return self.points.median_mm

    @property
    def tracked(self) -> BundleState:
        """The state as tracked."""
        log_scale, log_focal = np.zeros(len(self.T_camera_world)), math.log(self.focal_px)
        return BundleState(self.T_camera_world, log_scale, self.points.log_depth, log_focal)


class BundleState(NamedTuple):
    """The unknowns of bundle adjustment: poses and ln depth scale of keyframes, ln depth of points, ln of fx in px.

    T_camera_world : (K, 4, 4). log_scale : (K,). log_depth : (P,). sigma_px : robust standard deviation of the
    reprojection errors there, NaN: not known yet.
    """

    T_camera_world: np.ndarray
    log_scale: np.ndarray
    log_depth: np.ndarray
    log_focal: float
    sigma_px: float = float("nan")


def part_of(problem: BundleProblem, chosen: np.ndarray) -> BundleProblem:
    """Return the problem of some points alone, (P,) bool."""
    points, seen, start = problem.points, problem.observations, problem.start
    kept = chosen[seen.point]
    number = np.cumsum(chosen) - 1
    return replace(
        problem,
        points=Points(points.host[chosen], points.pixel[chosen], points.log_depth[chosen], points.sigma[chosen]),
        observations=Observations(number[seen.point[kept]], seen.keyframe[kept], seen.pixel[kept]),
        start=start and start._replace(log_depth=start.log_depth[chosen]),
    )


def held_to_result(
    points: Points, known: np.ndarray, log_depth: np.ndarray, log_scale: np.ndarray, sigma: np.ndarray
) -> Points:
    """Return the points of an adjustment with those that are known (P,) held to what was found of them before.

    log_depth, log_scale, sigma : (P,) ln depth that was found, ln scale of its host, and standard deviation of the
    former.
    """
    sigma = np.where(known, np.clip(sigma, _HELD_SIGMA, points.sigma), points.sigma)
    return replace(points, log_depth=np.where(known, log_depth - log_scale, points.log_depth), sigma=sigma)


def middle(problem: BundleProblem, state: BundleState, most: int) -> tuple[BundleProblem, BundleState]:
    """Return the problem and the state of at most so many keyframes, those in the middle."""
    count = len(problem.T_camera_world)
    if count <= most:
        return problem, state
    first = (count - most) // 2
    return successive(problem, first, first + most), successive_state(problem, state, first, first + most)


def successive(problem: BundleProblem, first: int, end: int) -> BundleProblem:
    """Return the problem of the keyframes from `first` to before `end` alone, with the points that they host.

    A keyframe that was tracked against one outside is held to the motion from the one before it.
    """
    part = part_of(problem, _hosted(problem, first, end))
    seen, pairs = part.observations, problem.neighbours
    inside = (seen.keyframe >= first) & (seen.keyframe < end)
    pairs = pairs[((pairs >= first) & (pairs < end)).all(1)] - first
    others = np.setdiff1d(np.arange(1, end - first), pairs[:, 1])
    pairs = np.concatenate([pairs, np.column_stack([others - 1, others])])
    return replace(
        part,
        T_camera_world=problem.T_camera_world[first:end],
        points=replace(part.points, host=part.points.host - first),
        observations=Observations(seen.point[inside], seen.keyframe[inside] - first, seen.pixel[inside]),
        neighbours=pairs,
        start=problem.start and successive_state(problem, problem.start, first, end),
    )


def successive_state(problem: BundleProblem, state: BundleState, first: int, end: int) -> BundleState:
    """Return the state of the keyframes from `first` to before `end`, and of the points that they host."""
    T, log_scale = state.T_camera_world[first:end], state.log_scale[first:end]
    own = _hosted(problem, first, end)
    return state._replace(T_camera_world=T, log_scale=log_scale, log_depth=state.log_depth[own])


def _hosted(problem: BundleProblem, first: int, end: int) -> np.ndarray:
    """Return which points (P,) bool these keyframes host."""
    return (problem.points.host >= first) & (problem.points.host < end)


class Errors(NamedTuple):
    """Errors of all observations (N, 2) px, 0 behind the camera, and which are ahead of it (N,) bool."""

    error: np.ndarray
    ahead: np.ndarray


class Reprojection(NamedTuple):
    """Errors of n observations as in `Errors`, and what their derivatives need.

    seen : (n, 3) points in the observing camera. pixel : (n, 2) px, from the principal point. in_host : (p, 3) points
    in their hosts' cameras, point : (n,) which of them is observed. between : (q, 4, 4) motions from a host to an
    observing camera, pair : (n,) which of them applies.
    """

    error: Float64_2d
    ahead: Bool_1d
    seen: Float64_2d
    pixel: Float64_2d
    in_host: Float64_2d
    point: Int64_1d
    between: Float64_3d
    pair: Int64_1d


def reprojection_errors(problem: BundleProblem, state: BundleState) -> Errors:
    """Return the errors of all observations."""
    error, ahead = np.zeros((len(problem.observations.point), 2)), np.zeros(len(problem.observations.point), bool)
    for points in problem.parts:
        some = problem.seen(points)
        error[some], ahead[some] = reproject(problem, state, points)[:2]
    return Errors(error, ahead)


def reproject(problem: BundleProblem, state: BundleState, points: slice) -> Reprojection:
    """Return where some points of a state are projected, against where they were observed."""
    some, T, focal = problem.seen(points), state.T_camera_world, math.exp(state.log_focal)
    number, pixel = problem.observations.point[some], problem.observations.pixel[some]
    rays = np.ones((points.stop - points.start, 3))
    rays[:, :2] = problem.points.pixel[points] / focal
    in_host, point = np.exp(state.log_depth[points])[:, None] * rays, number - points.start
    pairs, which = problem.pairs[0], problem.pairs[1][some]
    least = int(which.min(initial=len(pairs)))  # pairs are sorted by host, too
    pairs, pair = pairs[least : which.max(initial=0) + 1], which - least
    between = T[pairs % len(T)] @ inverse(T)[pairs // len(T)]
    error, ahead, seen, projected = _projected(between, pair, in_host, point, pixel, focal)
    return Reprojection(error, ahead, seen, projected, in_host, point, between, pair)


def jacobians(
    problem: BundleProblem, state: BundleState, points: slice, at: Reprojection, *, of_depth_alone: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (n, 2, U) of pixels by the unknowns of `touched`, and by ln depth of the points (n, 2).

    Twists of the observing camera and of the host, translations in units of the typical depth, then ln f where it is
    unknown. at : what `reproject` returned for these points. of_depth_alone : U is 0.
    """
    corners, focal = problem.points.pixel[points], math.exp(state.log_focal)
    count = 0 if of_depth_alone else problem.touched[0].shape[1]
    return _derivatives(at, corners, focal, problem.unit_mm, count)


@kernel
def _projected(
    between: Float64_3d, pair: Int64_1d, in_host: Float64_2d, point: Int64_1d, observed: Float64_2d, focal: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return error, ahead, seen and pixel of a `Reprojection`; observed : (n, 2)."""
    count = len(point)
    error, pixel, seen = np.zeros((count, 2)), np.empty((count, 2)), np.empty((count, 3))
    ahead = np.zeros(count, np.bool_)
    for n in range(count):
        q, p, square = pair[n], point[n], 0.0
        for i in range(3):
            place = between[q, i, 3]
            for j in range(3):
                place += between[q, i, j] * in_host[p, j]
            seen[n, i] = place
            square += place * place
        ahead[n] = seen[n, 2] > _LEAST_Z * np.sqrt(square)
        z = seen[n, 2] if ahead[n] else 1.0
        for i in range(2):
            pixel[n, i] = focal * seen[n, i] / z
            if ahead[n]:
                error[n, i] = pixel[n, i] - observed[n, i]
    return error, ahead, seen, pixel


@kernel
def _derivatives(
    at: Reprojection, corners: Float64_2d, focal: float, unit_mm: float, unknowns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `jacobians` does; corners : (p, 2) of the points, px from the centre. unknowns : 0, 12 or 13."""
    count, row, turned, X = len(at.point), np.zeros(3), np.zeros(3), np.zeros(3)
    by, by_depth = np.empty((count, 2, unknowns)), np.zeros((count, 2))
    for n in range(count):
        z = at.seen[n, 2] if at.ahead[n] else 1.0
        q, p = at.pair[n], at.point[n]
        for j in range(3):
            X[j] = at.in_host[p, j]
        for axis in range(2):
            # By the point in the observing camera, and in the host's.
            row[0], row[1], row[2] = 0.0, 0.0, -at.pixel[n, axis] / z
            row[axis] = focal / z
            for j in range(3):
                turned[j] = row[0] * at.between[q, 0, j] + row[1] * at.between[q, 1, j] + row[2] * at.between[q, 2, j]
                by_depth[n, axis] += turned[j] * X[j]
            if unknowns == 0:
                continue
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                # d(exp(w) X)/dw = -hat(X), and a row vector times -hat(X) is the cross product X x row.
                by[n, axis, i] = at.seen[n, j] * row[k] - at.seen[n, k] * row[j]
                by[n, axis, 6 + i] = turned[j] * X[k] - turned[k] * X[j]
                by[n, axis, 3 + i], by[n, axis, 9 + i] = unit_mm * row[i], -unit_mm * turned[i]
            if unknowns > 12:
                scale = X[2] / focal
                by[n, axis, 12] = at.pixel[n, axis]
                for j in range(2):
                    by[n, axis, 12] -= scale * turned[j] * corners[p, j]
    return by, by_depth
