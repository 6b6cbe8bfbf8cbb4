"""What the views ask of the lens: whether its focal length and principal point agree with them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scopemap.mapping.bundle_adjustment import WINDOW, adjust, linearised
from scopemap.mapping.bundle_problem import BundleProblem, State
from scopemap.notices import Notice

_RESIDUAL_SIGMA = np.array([0.3, 0.2, 0.2])  # prior standard deviations of ln f, and of the principal point over f
_RESIDUAL_DEPTH = 3.0  # factor of the estimated depth's deviation there: errors of a network bend the lens, too
_SIGNIFICANT = 5.0  # standard deviations: a right lens of a real clip had 3.4, the least noticed wrong one 6.7
_FOCAL_CHANGE = 0.03  # of ln f, above which the views contradict the lens; a focal length off by 2 % bends little
_FOCAL_SIGMA = 0.05  # of ln f, above which the views say too little of the lens to confirm it
_POINT_CHANGE = 0.05  # of the principal point over f: right lenses up to 0.03, one off by 5 % of the width from 0.09


class LensResidual(NamedTuple):
    """What the observations ask of the lens: changes of ln f, and of cx and cy over f; NaN: undetermined.

    A change is 0 where it is not significant. sigma : standard deviation of ln f.
    """

    log_focal: float = float("nan")
    x: float = float("nan")
    y: float = float("nan")
    sigma: float = float("nan")

    @property
    def notices(self) -> list[Notice]:
        """Whether the observations contradict the lens, or do not tell it."""
        found = []
        if abs(self.log_focal) > _FOCAL_CHANGE:
            found.append(Notice("camera-contradicted", {"change": math.expm1(self.log_focal)}))
        if math.hypot(self.x, self.y) > _POINT_CHANGE:
            found.append(Notice("camera-off-centre", {"x": self.x, "y": self.y}))
        if self.sigma > _FOCAL_SIGMA:
            found.append(Notice("camera-unconfirmed", {"sigma": self.sigma}))
        return found


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
    return LensResidual() if evidence is None else evidence.residual


def lens_evidence(problem: BundleProblem, solution: State) -> LensEvidence | None:
    """Return what the observations tell of the lens, all else adjusted with it from the solution.

    None where it is undetermined, and with more keyframes than are adjusted at once.
    """
    if not len(problem.observations.point) or len(problem.T_camera_world) > WINDOW:
        return None
    unit = np.array([1.0, problem.focal_px, problem.focal_px])
    points = replace(problem.points, sigma=_RESIDUAL_DEPTH * problem.points.sigma)
    free = replace(problem, start=solution, points=points, lens_sigma=_RESIDUAL_SIGMA * unit)
    state = adjust(free, max_iterations=40, min_decrease=1e-4).state  # a wrong lens may be far away
    try:
        covariance = np.linalg.pinv(linearised(free, state).reduced()[0], hermitian=True)[-3:, -3:]
        information = np.linalg.inv(covariance / np.outer(unit, unit))
    except np.linalg.LinAlgError:
        return None
    asked = information @ ((state.lens - problem.tracked.lens) / unit)
    return LensEvidence(information - np.diag(_RESIDUAL_SIGMA**-2), asked)
