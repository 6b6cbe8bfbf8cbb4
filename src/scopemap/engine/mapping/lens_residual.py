"""What the views ask of the lens: whether its focal length and principal point agree with them.

How far off a lens may be depends on the motion: a focal length off by 2 % changes the shape of a colon by 1.5 %, and by
6 % that of an organ that a laparoscope moves past. So what counts is by how much the lens that the views ask for would
change the surface and the path.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import umeyama
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.bundle_adjustment import WINDOW, adjust, linearised
from scopemap.engine.mapping.bundle_problem import BundleProblem, State
from scopemap.engine.notices import Notice

# By hand: prior standard deviations of ln f, and of the principal point over f.
_RESIDUAL_SIGMA = np.array([0.3, 0.2, 0.2])
# By hand: factor of the estimated depth's deviation there: errors of a network bend the lens, too.
_RESIDUAL_DEPTH = 3.0
_SIGNIFICANT = 5.0  # standard deviations: a right lens of a real clip had 3.4, the least noticed wrong one 6.7
_FOCAL_SIGMA = 0.05  # by hand: of ln f, above which the views say too little of the lens to confirm it
_MOST_SURFACE = 0.035  # 5 % of the table of verdicts, less 1.5 %
_MOST_PATH = 0.03
"""Changes of surface and path above which the views contradict the lens: the 5 % and 3 % above which the table of
verdicts calls a result wrong, less the 1.5 % by which surfaces are off with a right lens."""
_LEAST_POINTS = 10  # by hand: of a keyframe whose shape is compared
_ITERATIONS = 40  # by hand: a wrong lens may be far away
_MIN_DECREASE = 1e-4  # by hand: relative, of the cost, that ends the adjustment


class LensResidual(NamedTuple):
    """What the observations ask of the lens: changes of ln f, and of cx and cy over f; NaN: undetermined.

    A change is 0 where it is not significant. sigma : standard deviation of ln f. surface, path : by how much the lens
    that is asked for would change the shape (`shape_change`).
    """

    log_focal: float = float("nan")
    x: float = float("nan")
    y: float = float("nan")
    sigma: float = float("nan")
    surface: float = float("nan")
    path: float = float("nan")

    @property
    def notices(self) -> list[Notice]:
        """Whether the observations contradict the lens, or do not tell it."""
        found = []
        if self.surface > _MOST_SURFACE or self.path > _MOST_PATH:
            change = {"change": math.expm1(self.log_focal), "x": self.x, "y": self.y}
            found.append(Notice("camera-contradicted", {**change, "surface": self.surface, "path": self.path}))
        if self.sigma > _FOCAL_SIGMA:
            found.append(Notice("camera-unconfirmed", {"sigma": self.sigma}))
        return found

    def with_effect(self, problem: BundleProblem, solution: State) -> LensResidual:
        """Return it with its effect on the shape of a solution, adjusted again with the lens that is asked for."""
        change = np.array(self[:3]) * [1.0, problem.focal_px, problem.focal_px]
        if not change.any() or not np.isfinite(change).all():
            return self._replace(surface=0.0, path=0.0)
        start = solution._replace(lens=problem.tracked.lens + change)
        other = adjust(replace(_loosely(problem), start=start), max_iterations=_ITERATIONS, min_decrease=_MIN_DECREASE)
        surface, path = shape_change(problem, solution, other.state)
        return self._replace(surface=surface, path=path)


class LensEvidence(NamedTuple):
    """Information (3, 3) of observations on the changes of `LensResidual`, and it times the changes they ask (3,)."""

    information: np.ndarray
    asked: np.ndarray

    def and_also(self, other: LensEvidence | None) -> LensEvidence:
        """Return the evidence of other observations, too."""
        return self if other is None else LensEvidence(self.information + other.information, self.asked + other.asked)

    @property
    def residual(self) -> LensResidual:
        """The changes; they are significant from five standard deviations."""
        covariance = np.linalg.pinv(self.information + np.diag(_RESIDUAL_SIGMA**-2), hermitian=True)
        change, deviation = covariance @ self.asked, np.sqrt(np.diag(covariance))
        log_focal, x, y = np.where(np.abs(change) > _SIGNIFICANT * deviation, change, 0.0).tolist()
        return LensResidual(log_focal, x, y, float(deviation[0]))


def lens_residual(problem: BundleProblem, solution: State) -> LensResidual:
    """Return what the observations ask of the lens; all is NaN where `lens_evidence` is None."""
    evidence = lens_evidence(problem, solution)
    return LensResidual() if evidence is None else evidence.residual.with_effect(problem, solution)


def lens_evidence(problem: BundleProblem, solution: State) -> LensEvidence | None:
    """Return what the observations tell of the lens, all else adjusted with it from the solution.

    None where it is undetermined, and with more keyframes than are adjusted at once.
    """
    if not len(problem.observations.point) or len(problem.T_camera_world) > WINDOW:
        return None
    unit = np.array([1.0, problem.focal_px, problem.focal_px])
    free = replace(_loosely(problem), start=solution, lens_sigma=_RESIDUAL_SIGMA * unit)
    state = adjust(free, max_iterations=_ITERATIONS, min_decrease=_MIN_DECREASE).state
    try:
        covariance = np.linalg.pinv(linearised(free, state).matrix, hermitian=True)[-3:, -3:]
        information = np.linalg.inv(covariance / np.outer(unit, unit))
    except np.linalg.LinAlgError:
        return None
    asked = information @ ((state.lens - problem.tracked.lens) / unit)
    return LensEvidence(information - np.diag(_RESIDUAL_SIGMA**-2), asked)


def shape_change(problem: BundleProblem, one: State, other: State) -> tuple[float, float]:
    """Return by how much two solutions differ: of the surface and of the path, with the scale of the path.

    Of the surface: distance between two places of a point as its host sees them, turned to fit each other, over its
    distance; median over points, then over keyframes. Of the path: RMSE of positions after a Sim(3) alignment over its
    length. NaN without a path.
    """
    centres, others = (inverse(state.T_camera_world)[:, :3, 3] for state in (one, other))
    length = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    try:
        S_one_other = umeyama(others, centres, True, least_rank=1)
    except AlignmentError:
        return float("nan"), float("nan")
    path = float(np.sqrt(((S_one_other.transform_points(others) - centres) ** 2).sum(1).mean())) / length
    seen = np.zeros(len(problem.points.host), bool)
    seen[problem.observations.point] = True
    here, there = _in_host(problem, one), S_one_other.scale * _in_host(problem, other)
    changes = []
    for k in np.unique(problem.points.host):
        own = seen & (problem.points.host == k)
        if own.sum() >= _LEAST_POINTS:
            turned, _ = Rotation.align_vectors(here[own], there[own])
            off = np.linalg.norm(turned.apply(there[own]) - here[own], axis=1) / np.linalg.norm(here[own], axis=1)
            changes.append(float(np.median(off)))
    return float(np.median(changes)) if changes else float("nan"), path


def _in_host(problem: BundleProblem, state: State) -> np.ndarray:
    """Return the points (P, 3) of a state in their hosts' cameras, mm."""
    across = (problem.points.pixel - state.lens[1:]) / np.exp(state.lens[0])
    in_host: np.ndarray = np.exp(state.log_depth)[:, None] * np.column_stack([across, np.ones(len(across))])
    return in_host


def _loosely(problem: BundleProblem) -> BundleProblem:
    """Return the problem with points held less to their estimated depth."""
    return replace(problem, points=replace(problem.points, sigma=_RESIDUAL_DEPTH * problem.points.sigma))
