"""Other starts of bundle adjustment: an inside-out shape is found out, a right one is confirmed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.geometry.se3 import inverse, se3_exp
from scopemap.engine.mapping import other_starts
from scopemap.engine.mapping.bundle_adjustment import adjust_in_windows
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, Points, Priors
from scopemap.engine.mapping.judge import ShapeTest
from scopemap.engine.mapping.other_starts import with_other_starts

pytestmark = pytest.mark.slow

FOCAL_PX = 400.0  # 320 px wide: 44 degrees, as a laparoscope's
SEEN_PX = np.array([160.0, 128.0])
NOISE_PX = 0.2


def _scene(
    keyframes: int, step_mm: float = 1.5, relief: float = 0.15, seed: int = 0, *, moves_mm: float = 0.0
) -> tuple[BundleProblem, np.ndarray]:
    """Return a camera that moves sideways over a relief, and the true ln depth of its points.

    moves_mm : how far each point moves on its own between keyframes.
    """
    rng = np.random.default_rng(seed)
    T_world_camera = np.stack(
        [
            se3_exp(np.array([0, 0.002 * np.sin(k), 0, step_mm * k, 0.2 * step_mm * np.sin(0.7 * k), 0]))
            for k in range(keyframes)
        ]
    )
    T = inverse(T_world_camera)
    pixel = rng.uniform(-SEEN_PX, SEEN_PX, (keyframes, 150, 2))
    host = np.repeat(np.arange(keyframes), 150)
    rays = np.concatenate([pixel.reshape(-1, 2) / FOCAL_PX, np.ones((len(host), 1))], 1)
    # The surface is z = 70 (1 + relief sin(y / 12)) over the world's x and y; points on it by fixed-point iteration.
    log_depth = np.full(len(host), np.log(70.0))
    for _ in range(50):
        points = _world(T_world_camera, host, rays, log_depth)
        wanted = 70 * (1 + relief * np.sin(points[:, 1] / 12 + points[:, 0] / 40))
        log_depth += np.log(wanted / points[:, 2])
    points = _world(T_world_camera, host, rays, log_depth)
    rows = []
    for k in range(keyframes):
        moved = points + rng.normal(0, moves_mm, points.shape) if moves_mm else points
        seen = moved @ T[k, :3, :3].T + T[k, :3, 3]
        there = FOCAL_PX * seen[:, :2] / seen[:, 2:]
        gap = np.abs(host - k)
        for point in np.flatnonzero((np.abs(there) < SEEN_PX).all(1) & (gap > 0) & (gap <= 5)):
            rows.append((point, k, *(there[point] + rng.normal(0, NOISE_PX, 2))))
    found = np.array(sorted(rows))
    observations = Observations(found[:, 0].astype(int), found[:, 1].astype(int), found[:, 2:])
    estimated = Points(host, pixel.reshape(-1, 2), log_depth, np.full(len(host), 0.2))
    pairs = np.arange(keyframes - 1)[:, None] + [0, 1]
    return BundleProblem(T, estimated, observations, Priors(), pairs, FOCAL_PX, correlated=4.0), log_depth


def _world(T_world_camera: np.ndarray, host: np.ndarray, rays: np.ndarray, log_depth: np.ndarray) -> np.ndarray:
    T = T_world_camera[host]
    return np.einsum("nij,nj->ni", T[:, :3, :3], np.exp(log_depth)[:, None] * rays) + T[:, :3, 3]


def _tracked_by(problem: BundleProblem, log_depth: np.ndarray) -> BundleProblem:
    """Return the problem with this estimated depth (P,), and with poses that fit it as tracking would find them."""
    held = replace(problem.points, log_depth=log_depth, sigma=np.full(len(log_depth), 0.01))
    T = adjust_in_windows(replace(problem, points=held)).state.T_camera_world
    points = replace(problem.points, log_depth=log_depth, sigma=np.full(len(log_depth), 0.2))
    return replace(problem, T_camera_world=T, points=points)


def _inside_out(problem: BundleProblem) -> np.ndarray:
    host, log_depth = problem.points.host, problem.points.log_depth
    medians = np.array([np.median(log_depth[host == k]) for k in np.unique(host)])
    mirrored: np.ndarray = 2 * medians[host] - log_depth
    return mirrored


def _correlation(problem: BundleProblem, one: np.ndarray, other: np.ndarray) -> float:
    host = problem.points.host
    reliefs = [each - np.array([each[host == k].mean() for k in np.unique(host)])[host] for each in (one, other)]
    return float(np.corrcoef(*reliefs)[0, 1])


def _tested(problem: BundleProblem) -> tuple[np.ndarray, ShapeTest]:
    found, test = with_other_starts(problem, adjust_in_windows(problem))
    return found.state.log_depth, test


def test_a_right_shape_is_determined() -> None:
    problem, true = _scene(12)
    own = adjust_in_windows(problem)
    found, test = with_other_starts(problem, own)
    assert found is own
    assert test.outcome == "determined"
    assert not test.replaced
    assert test.correlation > 0.98
    assert [notice.code for notice in test.notices] == ["shape-determined"]
    assert _correlation(problem, found.state.log_depth, true) > 0.98


def test_an_inside_out_shape_gives_way_to_the_one_that_two_starts_find() -> None:
    right, true = _scene(12)
    problem = _tracked_by(right, _inside_out(right))
    own = adjust_in_windows(problem)
    assert _correlation(problem, own.state.log_depth, true) < 0, "the wrong valley must hold the search"
    log_depth, test = _tested(problem)
    assert test.outcome == "decided"
    assert test.replaced
    assert test.error_px < 0.85 * test.other_px
    assert _correlation(problem, log_depth, true) > 0.98


def test_the_scale_of_a_keyframe_is_that_of_its_points() -> None:
    right, _ = _scene(12)
    problem = _tracked_by(right, _inside_out(right))
    found, test = with_other_starts(problem, adjust_in_windows(problem))
    assert test.replaced
    change = found.state.log_depth - problem.points.log_depth
    for k in range(12):
        assert found.state.log_scale[k] == pytest.approx(np.median(change[problem.points.host == k]))


def test_where_another_start_wins_in_the_middle_of_many_keyframes_all_are_solved_from_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(other_starts, "MOST_KEYFRAMES", 8)
    right, true = _scene(12)
    problem = _tracked_by(right, _inside_out(right))
    log_depth, test = _tested(problem)
    assert test.outcome == "decided"
    assert test.replaced
    assert _correlation(problem, log_depth, true) > 0.95


def test_tissue_that_moves_determines_nothing() -> None:
    problem, _ = _scene(8, step_mm=0.15, moves_mm=0.4)
    own = adjust_in_windows(problem)
    found, test = with_other_starts(problem, own)
    assert found is own
    assert test.is_contradicted
    assert [notice.code for notice in test.notices] == ["shape-not-determined"]


def test_a_camera_at_rest_is_not_tested() -> None:
    problem, _ = _scene(6, step_mm=0.0)
    own = adjust_in_windows(problem)
    found, test = with_other_starts(problem, own)
    assert found is own
    assert test == ShapeTest()


def test_what_no_rigid_scene_explains_cannot_be_determined() -> None:
    problem, _ = _scene(12)
    _, test = with_other_starts(problem, adjust_in_windows(problem), is_rigid=False)
    assert test.outcome == "not determined"


@pytest.mark.parametrize(
    ("outcome", "error_px", "contradicted", "refuses_window"),
    [
        ("not determined", 0.30, True, True),
        ("not determined", 0.25, False, True),
        ("decided", 0.30, False, False),
        ("not tested", np.nan, False, False),
    ],
)
def test_a_shape_is_contradicted_where_another_one_explains_the_views_as_well(
    outcome: str, error_px: float, contradicted: bool, refuses_window: bool
) -> None:
    test = ShapeTest(outcome, error_px=error_px, other_px=0.31)  # type: ignore[arg-type]
    assert test.is_contradicted == contradicted
    assert test.refuses_window == refuses_window
    # In the end only poses that do not fit the views either stay as tracked.
    assert [test.refuses(sigma_px) for sigma_px in (0.3, 0.6)] == [False, contradicted]
