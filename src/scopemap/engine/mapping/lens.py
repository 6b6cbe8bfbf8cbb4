"""Another lens: with which focal length, and through which kind of lens, do left-out tracks fit best?

Half of the points are adjusted, once with the focal length held and once with it free; the other half is placed in the
keyframes of either (`lens_test`). Where the motion does not constrain the focal length, a wrong one leaves the same
errors, too: `LensTest.sigma` tells.

Where nobody has given a lens, pictures are taken as a pinhole camera's, and what a fisheye bends can ask for a focal
length that is far off: on C3VD's own pictures (cecum_t1_a, 126 degrees across a fisheye) for a third of the right one.
So corners are moved to where a pinhole would have seen them, had the lens been of another kind and focal length, the
adjustment is done again, and errors of left-out tracks are compared in pixels of the picture as it is (`LensKinds`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.polynomial import Polynomial

from scopemap.engine.mapping.bundle_adjustment import MOST_AT_ONCE, adjust, linearised
from scopemap.engine.mapping.bundle_problem import BundleProblem, BundleState, middle
from scopemap.engine.mapping.judge import LEAST_COMPARED, MOST_LENS_RATIO, LensTest, halves, left_out_px, placed

# Of the adjustment with the focal length free.
_PRIOR_SIGMA = 0.5  # by hand: of ln f, weak: 70 degrees are a factor of 2 from 110 ones
_FREE_ITERATIONS = 40  # by hand: a wrong lens may be far away
_FREE_MIN_DECREASE = 1e-4  # by hand: relative, of the cost, that ends the adjustment
# Of the kinds.
_FOCAL_RATIOS = np.geomspace(0.35, 1.4, 9) / 0.714
"""Focal lengths that are tried, over that of the assumed 70 degrees: pinholes of 110 to 39 degrees, fisheyes to 150."""
_POINTS = 50  # of a keyframe: through 27 lenses all points would take longer than the adjustment itself
_KIND_ITERATIONS = 15  # by hand: from poses that were adjusted through another lens
_KIND_MIN_DECREASE = 1e-3  # by hand: relative, of the cost, that ends an adjustment
_WIDEST_RAD = math.radians(86)  # a pinhole picture of rays farther out has no end
_ANGLES_RAD = np.linspace(0, _WIDEST_RAD, 1024)  # where lenses are inverted: every twelfth of a degree
_ON_AXIS = 1e-9  # guard: focal lengths from the axis


def lens_test(problem: BundleProblem, solution: BundleState) -> LensTest:
    """Return the test of the lens from a solution with it held; nothing is known with too few keyframes or points.

    Of more keyframes than are adjusted at once, those in the middle are tested.
    """
    problem, solution = middle(problem, solution, MOST_AT_ONCE)
    observed = np.unique(problem.observations.point)
    if len(observed) < 2 * LEAST_COMPARED or len(problem.T_camera_world) < 2:
        return LensTest()
    adjusted, left_out = halves(replace(problem, start=solution))
    search = partial(adjust, max_iterations=_FREE_ITERATIONS, min_decrease=_FREE_MIN_DECREASE)
    held = search(adjusted).state
    freed = replace(adjusted, start=held, log_focal_sigma=_PRIOR_SIGMA)
    free = search(freed).state
    try:
        deviation = linearised(freed, free).last_sigma
    except np.linalg.LinAlgError:
        return LensTest()
    change = free.log_focal - math.log(problem.focal_px)
    held_px, free_px, tracked_px = (left_out_px(left_out, placed(left_out, s)) for s in (held, free, left_out.tracked))
    return LensTest(held_px, free_px, change, deviation, tracked_px)


@dataclass(frozen=True)
class LensKinds:
    """The kinds that are tried, and the lens that pictures were straightened by.

    kinds : coefficients of `FisheyeCamera` by name; () is a pinhole. bend : those of the present lens.
    """

    kinds: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    bend: tuple[float, ...] = ()

    def better_than(self, test: LensTest, problem: BundleProblem, solution: BundleState) -> LensTest:
        """Return the test of the kind of lens through which left-out tracks fit clearly best; the one given: none does.

        test : of the focal length alone. problem, solution : with the present lens held.
        """
        if not self.kinds or math.isnan(test.held_px):
            return test
        problem, solution = middle(problem, solution, MOST_AT_ONCE)
        seen = _Seen(problem, solution, self.bend)
        best = {kind: seen.best_focal(bend) for kind, bend in self.kinds.items()}
        held_px = seen.error_px(self.bend, problem.focal_px)
        (kind, (error_px, focal_px)), *others = sorted(best.items(), key=lambda one: one[1])
        is_other = self.kinds[kind] != self.bend
        next_px = min((error for _, (error, _) in others), default=math.inf)
        if error_px > MOST_LENS_RATIO * (min(held_px, next_px) if is_other else held_px) or not (is_other or self.bend):
            return test
        through = seen.through(self.kinds[kind], focal_px)
        deviation, change = lens_test(through, through.begin).sigma, math.log(focal_px / problem.focal_px)
        return LensTest(held_px, error_px, change, deviation, test.tracked_px, kind if is_other else "")


class _Seen:
    """A problem, and what it is through other lenses."""

    def __init__(self, problem: BundleProblem, solution: BundleState, bend: tuple[float, ...]) -> None:
        points, seen, focal_px = problem.points, problem.observations, problem.focal_px
        self._corners, self._pixels = (_bent(pixel, bend, focal_px) for pixel in (points.pixel, seen.pixel))
        self._problem, self._start = problem, solution

    def through(self, bend: tuple[float, ...], focal_px: float) -> BundleProblem:
        """Return the problem, straightened by another lens."""
        corners, pixels = (_straight(pixel, bend, focal_px) for pixel in (self._corners, self._pixels))
        points = replace(self._problem.points, pixel=corners)
        seen = replace(self._problem.observations, pixel=pixels)
        start = self._start._replace(log_focal=math.log(focal_px))
        return replace(self._problem, points=points, observations=seen, focal_px=focal_px, start=start)

    def error_px(self, bend: tuple[float, ...], focal_px: float) -> float:
        """Return the error of left-out tracks through a lens, px of the picture, robust standard deviation."""
        adjusted, left_out = halves(self.through(bend, focal_px), _POINTS)
        state = placed(
            left_out, adjust(adjusted, max_iterations=_KIND_ITERATIONS, min_decrease=_KIND_MIN_DECREASE).state
        )
        return left_out_px(left_out, state, _shrink(left_out.observations.pixel, bend, focal_px))

    def best_focal(self, bend: tuple[float, ...]) -> tuple[float, float]:
        """Return the least error of left-out tracks through a kind of lens, and the focal length, px."""
        tried = {math.log(self._problem.focal_px * ratio): math.nan for ratio in _FOCAL_RATIOS}
        for log_focal in tried:
            tried[log_focal] = self.error_px(bend, math.exp(log_focal))
        step = math.log(_FOCAL_RATIOS[1] / _FOCAL_RATIOS[0])
        for _ in range(2):
            step /= 2
            best = min(tried, key=lambda log_focal: tried[log_focal])
            for log_focal in (best - step, best + step):
                tried[log_focal] = self.error_px(bend, math.exp(log_focal))
        best = min(tried, key=lambda log_focal: tried[log_focal])
        before, after = tried.get(best - step, math.nan), tried.get(best + step, math.nan)
        curvature = before + after - 2 * tried[best]
        if curvature > 0:
            best += step * (before - after) / (2 * curvature)
        return min(tried.values()), math.exp(best)


def angle_of_radius(bend: tuple[float, ...], radius: float) -> float:
    """Return the angle from the axis, rad, of a ray that a lens sees `radius` focal lengths from it; at most 86 deg."""
    return float(_angle(bend, np.array(radius)))


def _radius(bend: tuple[float, ...], angle: np.ndarray) -> np.ndarray:
    """Return the distance from the axis, focal lengths, of rays at an angle from it, rad."""
    return angle * Polynomial([1, *bend])(angle**2) if bend else np.tan(angle)


def _angle(bend: tuple[float, ...], radius: np.ndarray) -> np.ndarray:
    """Return the inverse of `_radius`; at most the widest angle."""
    return np.interp(radius, _radius(bend, _ANGLES_RAD), _ANGLES_RAD)


def _bent(pixel: np.ndarray, bend: tuple[float, ...], focal_px: float) -> np.ndarray:
    """Return where a lens sees what a pinhole camera sees at (N, 2) px from the axis."""
    radius = np.linalg.norm(pixel, axis=1) / focal_px
    return pixel * (_radius(bend, np.arctan(radius)) / np.maximum(radius, _ON_AXIS))[:, None]


def _straight(pixel: np.ndarray, bend: tuple[float, ...], focal_px: float) -> np.ndarray:
    """Return where a pinhole camera sees what a lens sees at (N, 2) px from the axis."""
    radius = np.linalg.norm(pixel, axis=1) / focal_px
    tangent = np.tan(_angle(bend, radius))
    return pixel * (tangent / np.maximum(radius, _ON_AXIS))[:, None]


def _shrink(straight: np.ndarray, bend: tuple[float, ...], focal_px: float) -> np.ndarray:
    """Return the length (N,) in the picture of one px of the pinhole camera, at (N, 2) px of it: geometric mean."""
    tangent = np.maximum(np.linalg.norm(straight, axis=1) / focal_px, _ON_AXIS)
    angle = np.arctan(tangent)
    if not bend:
        return np.ones(len(angle))
    radial = Polynomial([1, *bend])(angle**2) + 2 * angle**2 * Polynomial([1, *bend]).deriv()(angle**2)
    return np.sqrt(np.maximum(radial / (1 + tangent**2), 0) * _radius(bend, angle) / tangent)
