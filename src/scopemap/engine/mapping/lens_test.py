"""Lens test: does another focal length explain tracks that were left out of the adjustment better?

Half of the points are adjusted, once with the focal length held and once with it free; the other half is placed in the
keyframes of either. A right lens leaves the same errors there: the ratio of both was 0.998 to 1.002 on three real clips
with their calibration (C3VD cecum_t1_a and trans_t2_a, Hamlyn); with a lens 15 % too short 0.94 on cecum_t1_a. Where
the motion does not constrain the focal length, the ratio is 1 for a wrong one, too: `sigma` tells.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.least_squares import robust_sigma_2d
from scopemap.engine.mapping.bundle_adjustment import WINDOW, adjust, errors_px, linearised
from scopemap.engine.mapping.bundle_problem import BundleProblem, State
from scopemap.engine.mapping.left_out import part_of, placed
from scopemap.engine.notices import Notice

_PRIOR_SIGMA = 0.5  # by hand: of ln f, weak: 70 degrees are a factor of 2 from 110 ones
_LEAST_POINTS = 50  # by hand: with fewer left-out points nothing is compared
_MOST_RATIO = 0.97  # between right lenses and one 15 % too short, see above
_SIGNIFICANT = 3.0  # standard deviations that the focal length must change by
_LEAST_CHANGE = 0.02  # of ln f: changes the shape of a colon by 1.5 %, by which surfaces are off with a right lens
_MOST_ERROR_PX = 0.45
"""Of left-out tracks with the focal length free, above which a scene is not rigid enough: rigid clips that constrain
the lens had 0.14 to 0.41 px, moving ones 0.53 (laparoscopy_rvim) and 1.03 (colonoscopy_nflba_03)."""
# Of left-out errors by an adjustment over those as tracked: rigid real clips .88 to .99, a sinus whose scale of errors
# ran away 1.4.
_MOST_GROWTH = 1.05
_NOISE_PX = 0.05  # of either: that of exact phantoms, whose poses as tracked are as good
_FOCAL_SIGMA = 0.05  # by hand: of ln f, above which the motion says too little of the lens to confirm it
_ITERATIONS = 40  # by hand: a wrong lens may be far away
_MIN_DECREASE = 1e-4  # by hand: relative, of the cost, that ends the adjustment


class LensTest(NamedTuple):
    """What left-out tracks tell of the focal length; NaN: not tested.

    held_px, free_px, tracked_px : their errors, robust standard deviation, with the focal length held and free, and as
    tracked. log_focal : change of ln f that the adjusted half fits. sigma : its standard deviation. kind : of the lens
    that they fit, "": the present one.
    """

    held_px: float = math.nan
    free_px: float = math.nan
    log_focal: float = math.nan
    sigma: float = math.nan
    tracked_px: float = math.nan
    kind: str = ""

    @property
    def ratio(self) -> float:
        """Error of left-out tracks with the focal length free over that with it held."""
        return self.free_px / self.held_px

    @property
    def differs(self) -> bool:
        """Whether a rigid scene fits another lens."""
        is_significant = bool(self.kind) or abs(self.log_focal) > max(_LEAST_CHANGE, _SIGNIFICANT * self.sigma)
        return self.free_px <= _MOST_ERROR_PX and is_significant

    @property
    def is_worse(self) -> bool:
        """Whether the poses as tracked explain the left-out tracks better than the adjustment with the lens held."""
        return self.held_px > _MOST_GROWTH * self.tracked_px + _NOISE_PX

    @property
    def contradicts(self) -> bool:
        """Whether a rigid scene fits another lens clearly better."""
        return self.differs and self.ratio < _MOST_RATIO

    @property
    def notices(self) -> list[Notice]:
        """Whether the tracks contradict the lens, or the motion does not constrain it."""
        if self.contradicts:
            return [Notice("camera-contradicted", {"change": math.expm1(self.log_focal), "gain": 1 - self.ratio})]
        return [Notice("camera-unconfirmed", {"sigma": self.sigma})] if self.sigma > _FOCAL_SIGMA else []


def lens_test(problem: BundleProblem, solution: State) -> LensTest:
    """Return the test of the lens from a solution with it held; nothing is known with too few or too many keyframes."""
    observed = np.unique(problem.observations.point)
    if len(observed) < 2 * _LEAST_POINTS or not 2 <= len(problem.T_camera_world) <= WINDOW:
        return LensTest()
    is_adjusted, is_left_out = np.zeros((2, len(problem.points.host)), bool)
    is_adjusted[observed[::2]] = is_left_out[observed[1::2]] = True
    begun = replace(problem, start=solution)
    adjusted, left_out = part_of(begun, is_adjusted), part_of(begun, is_left_out)
    search = partial(adjust, max_iterations=_ITERATIONS, min_decrease=_MIN_DECREASE)
    held = search(adjusted).state
    freed = replace(adjusted, start=held, log_focal_sigma=_PRIOR_SIGMA)
    free = search(freed).state
    try:
        covariance = np.linalg.pinv(linearised(freed, free).matrix, hermitian=True)
    except np.linalg.LinAlgError:
        return LensTest()
    change = free.log_focal - math.log(problem.focal_px)
    errors_px = (_error_px(left_out, held), _error_px(left_out, free))
    sigma = math.sqrt(covariance[-1, -1])
    return LensTest(*errors_px, change, sigma, _error_px(left_out, left_out.tracked))


def _error_px(left_out: BundleProblem, keyframes: State) -> float:
    """Return the error of left-out points as the keyframes of a solution place them, robust standard deviation."""
    lengths_px = errors_px(left_out, placed(left_out, keyframes))
    return robust_sigma_2d(lengths_px[np.isfinite(lengths_px)])
