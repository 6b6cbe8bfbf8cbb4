"""Model of the cost of keyframes and points: normal equations from which the points are eliminated one by one.

A point touches few unknowns, so its share is made among these and added to the matrix once. Derivatives of one part of
the observations at a time are in memory, and are found again where a step is tried. Lourakis and Argyros, ICCV 2005;
Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, 6.1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import cho_factor, cho_solve

from scopemap.engine.mapping.bundle_problem import BundleProblem

_RIDGE = 1e-9  # guard: of the diagonal


class Linear(NamedTuple):
    """Derivatives and weights of n observations.

    columns : unknowns (n, U) that an observation touches beside its point. by : (n, 2, U) px.
    """

    columns: np.ndarray
    by: np.ndarray
    by_depth: np.ndarray  # (n, 2)
    error: np.ndarray  # (n, 2) px
    weight: np.ndarray  # (n,)


class Prior(NamedTuple):
    """Normal equations of unknowns alone: numbers (m,), second derivative (m, m), first derivative (m,)."""

    columns: np.ndarray
    A: np.ndarray
    b: np.ndarray


class _Normal(NamedTuple):
    """Normal equations.

    matrix : lower half of the second derivative (F, F) by the free unknowns, the points eliminated. gradient : first
    derivative (F,). by_points : what eliminating the points adds to its negative (F,). h, g : second and first
    derivatives (P,) by the points.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    by_points: np.ndarray
    h: np.ndarray
    g: np.ndarray


@dataclass(frozen=True)
class ReducedModel:
    """Model of the cost around a state; steps are the unknowns, then ln depth of the points.

    linear : returns the derivatives of the observations of some points. priors : of the unknowns. off, held : (P,)
    error of each point's ln depth against the estimate, and its weight. scale : (P,) unknown of its host's ln scale,
    which moves the estimate. free : (F,) numbers of the unknowns that may change. unknowns : their number.
    """

    problem: BundleProblem
    cost: float
    linear: Callable[[slice], Linear]
    priors: Sequence[Prior]
    off: np.ndarray
    held: np.ndarray
    scale: np.ndarray
    free: np.ndarray
    unknowns: int

    @cached_property
    def _normal(self) -> _Normal:
        free, points, first = len(self.free), len(self.off), self.problem.first_seen
        normal = _Normal(np.zeros((free, free)), *np.zeros((2, free)), *np.zeros((2, points)))
        place = np.full(self.unknowns, -1)
        place[self.free] = np.arange(free)
        for some in self.problem.parts:
            own = _Normal(*normal[:3], normal.h[some], normal.g[some])
            start = first[some.start : some.stop + 1] - first[some.start]
            scale, off, held = place[self.scale[some]], self.off[some], self.held[some]
            linear = self.linear(some)
            _add_points(own, start, scale, off, held, linear._replace(columns=place[linear.columns]))
        for prior in self.priors:
            kept = np.flatnonzero(place[prior.columns] >= 0)
            own_place = place[prior.columns[kept]]
            normal.matrix[np.ix_(own_place, own_place)] += prior.A[np.ix_(kept, kept)]
            normal.gradient[own_place] += prior.b[kept]
        normal.matrix[np.diag_indices(free)] *= 1 + _RIDGE
        return normal

    @property
    def matrix(self) -> np.ndarray:
        """Lower half of the second derivative (F, F) by the free unknowns, the points eliminated; a step spoils it."""
        return self._normal.matrix

    @cached_property
    def gradient(self) -> np.ndarray:
        """First derivative (unknowns + P,); 0 for those that are held."""
        return self._step(self._normal.gradient, self._normal.g)

    def _step(self, free: np.ndarray, points: np.ndarray) -> np.ndarray:
        step = np.zeros(self.unknowns + len(points))
        step[self.free], step[self.unknowns :] = free, points
        return step

    def _changes(self, step: np.ndarray) -> Iterator[tuple[slice, Linear, np.ndarray]]:
        """Yield each part with what a step without its points changes, px."""
        for some in self.problem.parts:
            linear = self.linear(some)
            yield some, linear, np.einsum("nau,nu->na", linear.by, step[linear.columns])

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step to the minimum."""
        normal, number = self._normal, self.problem.observations.point
        # LAPACK reads by columns: the lower half is the upper one there, and nothing is copied.
        factor = cho_factor(normal.matrix.T, overwrite_a=True, check_finite=False)
        solved = cho_solve(factor, normal.by_points - normal.gradient, check_finite=False)
        step = self._step(solved, np.zeros(len(normal.g)))
        shift = normal.g - self.held * step[self.scale]
        for some, linear, change in self._changes(step):
            slope = linear.weight * (linear.by_depth * change).sum(1)
            own = number[self.problem.seen(some)] - some.start
            shift[some] += np.bincount(own, slope, some.stop - some.start)
        step[self.unknowns :] = -shift / normal.h
        return step

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        points, number = step[self.unknowns :], self.problem.observations.point
        total = float(self.held @ (points - step[self.scale]) ** 2)
        for some, linear, change in self._changes(step):
            change = change + linear.by_depth * points[number[self.problem.seen(some)]][:, None]
            total += float(linear.weight @ (change**2).sum(1))
        return total + sum(float(step[prior.columns] @ prior.A @ step[prior.columns]) for prior in self.priors)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_points(
    normal: _Normal, start: np.ndarray, scale: np.ndarray, off: np.ndarray, held: np.ndarray, linear: Linear
) -> None:
    """Add the observations of points, and what holds them, without the points.

    start : first observation of each point and their number (P + 1,). scale : (P,) unknown of its host's ln scale. All
    unknowns are numbered among those that are free; -1: they are not.
    """
    size = len(normal.gradient)
    # A point touches few unknowns: its sums are made among these, and added to the matrix once.
    columns, place = np.empty(size, np.int64), np.full(size, -1)
    most = 0
    for p in range(len(scale)):
        most = max(most, start[p + 1] - start[p])
    rows = np.zeros((2 * most, size))
    by, error, b, E = np.empty(len(rows)), np.empty(len(rows)), np.zeros(size), np.zeros(size)
    for p in range(len(scale)):
        used, count, has_scale = 0, 0, scale[p] >= 0
        h, g = held[p], held[p] * off[p]
        if has_scale:
            columns[0], place[scale[p]], count = scale[p], 0, 1
        for k in range(start[p], start[p + 1]):
            root = np.sqrt(linear.weight[k])
            for axis in range(2):
                by[used], error[used] = root * linear.by_depth[k, axis], root * linear.error[k, axis]
                h += by[used] ** 2
                g += by[used] * error[used]
                for i in range(linear.columns.shape[1]):
                    value, column = root * linear.by[k, axis, i], linear.columns[k, i]
                    if value == 0 or column < 0:
                        continue
                    if place[column] < 0:
                        place[column], columns[count] = count, column
                        count += 1
                    rows[used, place[column]] += value
                used += 1
        A = np.zeros((count, count))
        if has_scale:
            A[0, 0], b[0], E[0] = held[p], -held[p] * off[p], -held[p]
        for row in range(used):
            for i in range(count):
                value = rows[row, i]
                if value == 0:
                    continue
                b[i] += error[row] * value
                E[i] += by[row] * value
                for j in range(i + 1):
                    A[i, j] += value * rows[row, j]
        normal.h[p], normal.g[p] = h, g
        for i in range(count):
            normal.gradient[columns[i]] += b[i]
            normal.by_points[columns[i]] += E[i] / h * g
            for j in range(i + 1):
                row, column = max(columns[i], columns[j]), min(columns[i], columns[j])
                normal.matrix[row, column] += A[i, j] - E[i] / h * E[j]
            for row in range(used):
                rows[row, i] = 0.0
        for i in range(count):
            place[columns[i]], b[i], E[i] = -1, 0.0, 0.0
