"""Parts of a problem: some of its points, or successive keyframes alone.

Points that were left out of an adjustment judge it, placed by their own observations in the keyframes that it found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scopemap.engine.geometry.least_squares import robust_sigma_2d
from scopemap.engine.mapping.bundle_adjustment import with_points
from scopemap.engine.mapping.bundle_problem import (
    BundleProblem,
    Observations,
    Points,
    State,
    reprojection_errors,
)

_RESCALINGS = 3  # by hand: of the robust standard deviation


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


def halves(problem: BundleProblem, most: int) -> tuple[BundleProblem, BundleProblem]:
    """Return the problems of points to adjust and of as many others to judge by, at most so many of a keyframe each."""
    observed = np.unique(problem.observations.point)
    step = max(2, -(-len(observed) // (most * len(problem.T_camera_world))))
    adjusted, left_out = np.zeros((2, len(problem.points.host)), bool)
    adjusted[observed[::step]] = left_out[observed[step // 2 :: step]] = True
    return part_of(problem, adjusted), part_of(problem, left_out)


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


def successive_state(problem: BundleProblem, state: State, first: int, end: int) -> State:
    """Return the state of the keyframes from `first` to before `end`, and of the points that they host."""
    T, log_scale = state.T_camera_world[first:end], state.log_scale[first:end]
    own = _hosted(problem, first, end)
    return state._replace(T_camera_world=T, log_scale=log_scale, log_depth=state.log_depth[own])


def _hosted(problem: BundleProblem, first: int, end: int) -> np.ndarray:
    """Return which points (P,) bool these keyframes host."""
    return (problem.points.host >= first) & (problem.points.host < end)


def placed(part: BundleProblem, keyframes: State) -> State:
    """Return the state of points that their own observations place in the keyframes of a solution."""
    state = keyframes._replace(log_depth=part.points.log_depth + keyframes.log_scale[part.points.host])
    for _ in range(_RESCALINGS):
        seen = reprojection_errors(part, state)
        sigma_px = robust_sigma_2d(np.linalg.norm(seen.error, axis=1), part.least_sigma_px)
        state = with_points(part, state._replace(sigma_px=sigma_px))
    return state
