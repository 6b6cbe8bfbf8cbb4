"""Other starts: does the shape that bundle adjustment finds depend on where the search begins?

A narrow lens that moves sideways sees a scene and its mirror image in depth, turned the other way, almost alike (the
Necker reversal; Belhumeur, Kriegman and Yuille, "The bas-relief ambiguity", IJCV 1999). The adjustment then stays in
the valley where the predicted depth put it, and all that is built on that depth agrees with it. Two other starts tell:

mirrored    ln depth of each keyframe's points mirrored about their median, keyframes as tracked
flat        no depth and no poses: all points equally far, keyframes added one after the other

Both hold points only loosely to their start. Where one of them ends in the same shape, the motion determines it. Else
the one with clearly smaller errors of tracks left out of all of them wins, if another one has met it. Else the shape is
not determined. Part of the points decides: some are adjusted, others are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.engine.mapping.bundle_adjustment import (
    BundleSolution,
    adjust_in_windows,
    adjust_one_by_one,
    log_depth_sigma,
)
from scopemap.engine.mapping.bundle_problem import BundleProblem, BundleState, Priors, middle
from scopemap.engine.mapping.judge import (
    KNOWN_SIGMA,
    LEAST_COMPARED,
    ShapeTest,
    halves,
    is_clearly_less,
    is_same_shape,
    left_out_px,
    placed,
)

MOST_KEYFRAMES = 60  # by hand
"""That are tested at first."""
_POINTS = 100  # by hand: of a keyframe that are adjusted, and as many that are left out
_LOOSE_SIGMA = 0.5  # by hand: standard deviation of ln depth by which other starts hold their points
# Of poses without a start: half a radian, half the depth.
_NO_POSES = Priors(scale=0.3, rotation_rad=0.5, translation_share=0.5)  # by hand
_LEAST_OF_KEYFRAME = 5  # by hand: fewer such points of a keyframe have no relief


@dataclass(frozen=True)
class _Shape:
    """Where a start ended: keyframes, left-out points (Q,) ln mm as these place them, which are known, and errors."""

    keyframes: BundleState
    host: np.ndarray
    log_depth: np.ndarray
    known: np.ndarray
    error_px: float

    def likeness(self, other: _Shape) -> tuple[float, float]:
        """Return the correlation and the mean absolute difference of two reliefs; NaN where little is known."""
        both, reliefs = self.known & other.known, []
        for k in np.unique(self.host):
            own = both & (self.host == k)
            if own.sum() >= _LEAST_OF_KEYFRAME:
                reliefs.append([shape.log_depth[own] - np.median(shape.log_depth[own]) for shape in (self, other)])
        if sum(len(one) for one, _ in reliefs) < LEAST_COMPARED:
            return float("nan"), float("nan")
        one, another = np.hstack(reliefs)
        return float(np.corrcoef(one, another)[0, 1]), float(np.abs(one - another).mean())

    def meets(self, other: _Shape) -> bool:
        """Return whether two shapes are the same."""
        return is_same_shape(*self.likeness(other))


def with_other_starts(
    problem: BundleProblem, found: BundleSolution, *, is_rigid: bool = True
) -> tuple[BundleSolution, ShapeTest]:
    """Return the solution of the start that wins, and what the starts tell.

    found : the solution from the problem's own start. It stays, but where another start clearly wins. is_rigid :
    whether it explains the observations; where it does not, it cannot win. Of many keyframes those in the middle are
    tested; all, where another start wins there.
    """
    tested, keyframes = middle(problem, found.state, MOST_KEYFRAMES)
    best, test = _test(tested, keyframes, is_rigid=is_rigid)
    if test.replaced and tested is not problem:
        best, test = _test(problem, found.state, is_rigid=is_rigid)
        if not test.replaced:  # parts of the map tell different things
            test = test._replace(outcome="not determined")
    return (_from(problem, best), test) if test.replaced else (found, test)


def _test(problem: BundleProblem, keyframes: BundleState, *, is_rigid: bool) -> tuple[BundleState, ShapeTest]:
    """Return the keyframes of the start that wins, the given ones where none does, and what the starts tell."""
    adjusted, left_out = halves(problem, _POINTS)
    if len(left_out.points.host) < LEAST_COMPARED or len(problem.T_camera_world) < 2:
        return keyframes, ShapeTest()
    own = _shape(left_out, keyframes)
    if own.known.sum() < LEAST_COMPARED:
        return keyframes, ShapeTest()
    mirrored = _shape(left_out, adjust_in_windows(_mirrored(adjusted)).state)
    if is_rigid and own.meets(mirrored):
        return keyframes, ShapeTest("determined", False, *own.likeness(mirrored), own.error_px)
    if not is_rigid and not is_clearly_less(mirrored.error_px, own.error_px):
        return keyframes, ShapeTest("not determined", False, *own.likeness(mirrored), own.error_px, mirrored.error_px)
    flat = _shape(left_out, adjust_one_by_one(_flat(adjusted)).state)
    if is_rigid and own.meets(flat) and own.error_px <= mirrored.error_px:
        # The mirrored one stayed in a valley of its own, which is worse.
        return keyframes, ShapeTest("decided", False, *own.likeness(flat), own.error_px, mirrored.error_px)
    if flat.meets(mirrored) and is_clearly_less(max(flat.error_px, mirrored.error_px), own.error_px):
        return flat.keyframes, ShapeTest("decided", True, *flat.likeness(mirrored), flat.error_px, own.error_px)
    nearest = max((mirrored, flat), key=lambda shape: np.nan_to_num(shape.likeness(own)[0], nan=-1.0))
    other_px = min(mirrored.error_px, flat.error_px)
    return keyframes, ShapeTest("not determined", False, *own.likeness(nearest), own.error_px, other_px)


def _shape(left_out: BundleProblem, keyframes: BundleState) -> _Shape:
    """Return the shape of left-out points as the keyframes of a solution place them."""
    loose = _loosely(left_out, left_out.points.log_depth)
    state = placed(loose, keyframes)
    known = log_depth_sigma(loose, state) < KNOWN_SIGMA
    return _Shape(keyframes, left_out.points.host, state.log_depth, known, left_out_px(loose, state))


def _loosely(problem: BundleProblem, log_depth: np.ndarray) -> BundleProblem:
    """Return the problem with points held loosely to these ln depths (P,), which its search begins with."""
    sigma = np.full(len(log_depth), _LOOSE_SIGMA)
    points, begin = replace(problem.points, log_depth=log_depth, sigma=sigma), problem.begin
    start = begin._replace(log_scale=np.zeros(len(begin.log_scale)), log_depth=log_depth)
    return replace(problem, points=points, start=start)


def _medians(host: np.ndarray, log_depth: np.ndarray) -> np.ndarray:
    """Return for each point (P,) the median of its host's points."""
    hosts, which = np.unique(host, return_inverse=True)
    return np.array([np.median(log_depth[host == k]) for k in hosts])[which]


def _mirrored(problem: BundleProblem) -> BundleProblem:
    """Return the problem from a start with the points of each keyframe mirrored in ln depth about their median."""
    log_depth = problem.begin.log_depth
    return _loosely(problem, 2 * _medians(problem.points.host, log_depth) - log_depth)


def _flat(problem: BundleProblem) -> BundleProblem:
    """Return the problem from a start without depth or poses."""
    flat = _loosely(problem, np.full(len(problem.points.host), np.median(problem.begin.log_depth)))
    T = np.repeat(problem.begin.T_camera_world[:1], len(problem.T_camera_world), axis=0)
    in_turn = np.arange(len(T) - 1)[:, None] + [0, 1]
    assert flat.start is not None
    start = flat.start._replace(T_camera_world=T)
    return replace(flat, T_camera_world=T, priors=_NO_POSES, neighbours=in_turn, start=start)


def _from(problem: BundleProblem, keyframes: BundleState) -> BundleSolution:
    """Return the solution of all points from keyframes that another start has found.

    Points are held loosely to the depth at which these place them. A keyframe's scale is then the median change of the
    estimated depth of its points.
    """
    host, estimated = problem.points.host, problem.points.log_depth
    at = placed(_loosely(problem, estimated), keyframes).log_depth
    loose = _loosely(problem, at)
    assert loose.start is not None
    loose = replace(
        loose,
        T_camera_world=keyframes.T_camera_world,
        start=loose.start._replace(T_camera_world=keyframes.T_camera_world),
    )
    found = adjust_in_windows(loose)
    change, log_scale = found.state.log_depth - estimated, found.state.log_scale.copy()
    hosts = np.unique(host)
    log_scale[hosts] = [np.median(change[host == k]) for k in hosts]
    return found._replace(state=found.state._replace(log_scale=log_scale))
