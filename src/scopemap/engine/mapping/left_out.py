"""Points that were left out of an adjustment: placed by their own observations in the keyframes that it found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scopemap.engine.geometry.least_squares import robust_sigma_2d
from scopemap.engine.mapping.bundle_adjustment import with_points
from scopemap.engine.mapping.bundle_problem import (
    BundleProblem,
    Moved,
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


def placed(part: BundleProblem, keyframes: State, moved: Moved | None = None) -> State:
    """Return the state of points that their own observations place in the keyframes of a solution.

    moved : as `reproject` takes it.
    """
    state = keyframes._replace(log_depth=part.points.log_depth + keyframes.log_scale[part.points.host])
    for _ in range(_RESCALINGS):
        seen = reprojection_errors(part, state, moved)
        sigma_px = robust_sigma_2d(np.linalg.norm(seen.error, axis=1), part.least_sigma_px)
        state = with_points(part, state._replace(sigma_px=sigma_px), moved)
    return state
