"""Tissue that moves by one curve is recovered with its shape; tissue at rest is left to the rigid adjustment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from drawn_bundle import FOCAL_PX, tracked

from scopemap.engine.geometry.align import umeyama
from scopemap.engine.geometry.se3 import inverse, se3_exp, transform
from scopemap.engine.geometry.skinning import skin_of
from scopemap.engine.mapping import FrameCorrection
from scopemap.engine.mapping.bundle_adjustment import PER_KEYFRAME as PER_KEYFRAME_UNKNOWNS
from scopemap.engine.mapping.bundle_adjustment import adjust, errors_px
from scopemap.engine.mapping.bundle_problem import BundleProblem, Observations, Points, Priors
from scopemap.engine.mapping.deformation_graph import (
    MotionPrior,
    camera_without_curve,
    hat_functions,
    periodic_rate,
    spread_nodes,
)
from scopemap.engine.mapping.frame_correction import TissueMotion
from scopemap.engine.mapping.nonrigid_adjustment import NonRigidSolution, adjust_moving_tissue
from scopemap.engine.mapping.nonrigid_problem import NonRigidProblem, NonRigidState, linearised, retracted

KEYFRAMES, PER_KEYFRAME, GAPS = 16, 120, (1, 2, 3, 5)
BREATH = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(KEYFRAMES) / 9)
NOISE_PX = 0.15


def _moved(rest: np.ndarray, breath: float) -> np.ndarray:
    """Tissue (n, 3) mm at rest, 4 mm up on one side, down on the other, and forth in the middle."""
    x, y = rest[:, 0] / 25, rest[:, 1] / 25
    return rest + breath * np.column_stack([0.5 * np.cos(y), 4 * np.sin(1.3 * x), 1.5 * np.cos(x + y)])


def _poked(rest: np.ndarray, share: float) -> np.ndarray:
    """Tissue (n, 3) mm that is pushed by 5 mm at one place, and at rest 12 mm from it."""
    near = np.exp(-((rest[:, :2] - [7, -5]) ** 2).sum(1) / 50)
    return rest + share * near[:, None] * [3.0, 2.0, 3.5]


def _scene(
    curve: np.ndarray,
    false_share: float = 0.0,
    noise_px: float = NOISE_PX,
    moved: Callable[[np.ndarray, float], np.ndarray] = _moved,
    per_keyframe: int = PER_KEYFRAME,
) -> tuple[BundleProblem, np.ndarray]:
    """A bundle problem with wrong depth and nearly right poses, and the true points (P, K, 3) over time."""
    rng = np.random.default_rng(5)
    count = len(curve)
    forward = 0.3 * np.minimum(np.arange(count), KEYFRAMES)
    twists = [
        np.append(rng.normal(0, 0.01, 3), [4 * np.sin(0.6 * k), 3 * np.cos(0.5 * k), forward[k]]) for k in range(count)
    ]
    T = np.stack([inverse(se3_exp(twist)) for twist in twists])
    T = T @ inverse(T[0])
    # Of all tissue at rest each keyframe sees other points.
    flat = rng.uniform(-22, 22, (count * per_keyframe, 2))
    rest = np.column_stack([flat, 42 + 5 * np.sin(flat[:, 0] / 9) * np.cos(flat[:, 1] / 7)])
    over_time = np.stack([moved(rest, breath) for breath in curve], 1)
    host, seen = np.repeat(np.arange(count), per_keyframe), []
    pixel, depth = np.empty((len(host), 2)), np.empty(len(host))
    for p, h in enumerate(host):
        x = transform(T[h], over_time[p, h])
        pixel[p], depth[p] = FOCAL_PX * x[:2] / x[2], x[2]
        for t in (h + sign * gap for gap in GAPS for sign in (-1, 1)):
            if 0 <= t < count:
                x = transform(T[t], over_time[p, t])
                seen.append((p, t, *(FOCAL_PX * x[:2] / x[2] + rng.normal(0, noise_px, 2))))
    table = np.array(seen)
    false = rng.random(len(table)) < false_share
    table[false, 2:] += rng.uniform(-9, 9, (false.sum(), 2))
    estimated = np.log(depth) + 0.2 * np.sin(pixel[:, 0] / 40) + 0.1 * np.cos(pixel[:, 1] / 30)
    points = Points(host, pixel, estimated, np.full(len(host), 0.2))
    observations = Observations(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
    line = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    T_tracked = tracked(T, rng, rotation_rad=0.002, translation_mm=0.1)
    return BundleProblem(T_tracked, points, observations, Priors(), line, FOCAL_PX, correlated=4.0), over_time


def _over_time(problem: BundleProblem, found: NonRigidSolution) -> np.ndarray:
    """The points (P, K, 3) of a solution at the times of all keyframes."""

    def in_world(T_camera_world: np.ndarray, log_depth: np.ndarray) -> np.ndarray:
        points = problem.points
        x = np.exp(log_depth)[:, None] * np.column_stack([points.pixel / FOCAL_PX, np.ones(len(log_depth))])
        return np.stack([transform(inverse(T_camera_world[h]), each) for h, each in zip(points.host, x, strict=True)])

    state, motion, host = found.found.state, found.deformation, problem.points.host
    number, at_host = np.arange(len(host)), in_world(state.T_camera_world, state.log_depth)
    skin = skin_of(motion.nodes, at_host)
    # Nodes lie on the adjusted surface, which those who move it have.
    assert not motion.basis.any() or np.median(np.linalg.norm(motion.nodes[:, None] - at_host, axis=-1).min(1)) < 2.5
    moved = skin.displaced(motion.displacement)
    return at_host[:, None] + (moved - moved[host, number]).transpose(1, 0, 2)


def _shape_error_mm(points: np.ndarray, true: np.ndarray) -> float:
    """Median distance after the Sim(3) of all points."""
    return float(np.median(np.linalg.norm(umeyama(points, true, True).transform_points(points) - true, axis=-1)))


def _adjusted(problem: BundleProblem) -> NonRigidSolution | None:
    return adjust_moving_tissue(problem, adjust(problem).state, np.arange(len(problem.T_camera_world)) / 2)


@pytest.fixture(scope="module")
def breathing() -> NonRigidSolution:
    found = _adjusted(_scene(BREATH)[0])
    assert found is not None
    return found


@pytest.mark.slow
def test_tissue_that_breathes_is_recovered_with_its_curve_and_shape(breathing: NonRigidSolution) -> None:
    found, (problem, true) = breathing, _scene(BREATH)
    assert found.left_out.px < 0.6 < 2.0 < found.left_out.rigid_px
    curve = found.deformation.basis[:, 0]
    assert abs(np.corrcoef(curve, BREATH)[0, 1]) > 0.9
    assert found.deformation.rate_per_min(np.arange(KEYFRAMES) / 2) == pytest.approx(120 / 9, rel=0.1)
    rigid = adjust(problem).state
    as_rigid = NonRigidSolution(
        found.found._replace(state=rigid), replace(found.deformation, basis=0 * curve[:, None]), found.left_out
    )
    errors = [
        _shape_error_mm(_over_time(problem, each).reshape(-1, 3), true.reshape(-1, 3)) for each in (found, as_rigid)
    ]
    assert errors[0] < 2.0
    assert errors[0] < errors[1] / 2
    assert np.isfinite(found.found.log_depth_sigma).all()


def test_beside_a_core_at_rest_the_part_that_moves_is_found() -> None:
    problem, true = _scene(np.clip((np.arange(KEYFRAMES) - 5) / 5, 0, 1), moved=_poked)
    rigid = adjust(problem).state
    assert rigid.sigma_px < 0.4
    found = _adjusted(problem)
    assert found is not None
    moving = np.linalg.norm(found.deformation.modes[0], axis=1) > 0
    assert 0 < moving.sum() < 30
    at = np.linalg.norm(found.deformation.nodes[:, :2] - [7, -5], axis=1)
    assert at[moving].mean() < 10 < at[~moving].mean()
    started = replace(problem, start=rigid)
    held = found._replace(
        found=found.found._replace(state=rigid), deformation=replace(found.deformation, modes=np.zeros((1, 60, 3)))
    )
    near = np.linalg.norm(true[:, 0, :2] - [7, -5], axis=1) < 6
    errors = [
        np.linalg.norm(points - true, axis=-1)[near].mean()
        for points in (_over_time(started, found), _over_time(started, held))
    ]
    assert errors[0] < 0.6 * errors[1]


def test_a_camera_does_not_breathe_with_the_tissue() -> None:
    rng, time_s = np.random.default_rng(6), np.arange(20) / 2
    breath, nodes = np.sin(2 * np.pi * time_s / 4), rng.uniform([-20, -20, 25], [20, 20, 65], (60, 3))
    mode = rng.normal(0, 1.5, nodes.shape)
    smooth = np.column_stack(
        [0.1 * np.sin(time_s / 7), 0 * time_s, 0 * time_s, 5 * np.cos(time_s / 9), time_s, 0 * time_s]
    )
    path = np.stack([se3_exp(twist) for twist in smooth])
    common = np.array([0.01, -0.02, 0.015, 1.0, -0.5, 0.8])
    about = np.eye(4)
    about[:3, 3] = nodes.mean(0)
    with_breath = np.stack([about @ se3_exp(share * common) @ inverse(about) for share in breath]) @ path
    moved = mode + np.cross(common[:3], nodes - nodes.mean(0)) + common[3:]
    T_world_world, without = camera_without_curve(with_breath, time_s, breath, nodes, moved, 2.5)
    before, after = (
        np.linalg.norm((T - path)[:, :3, 3], axis=1).max() for T in (with_breath, T_world_world @ with_breath)
    )
    assert after < 0.1 < 1.0 < before
    assert np.abs(without - mode).max() < 0.2
    unchanged, _ = camera_without_curve(path, time_s, breath, nodes, mode, 2.5)
    assert np.abs((unchanged @ path - path)[:, :3, 3]).max() < 0.1


def test_tissue_at_rest_is_left_to_the_rigid_adjustment_whatever_the_matches_are() -> None:
    still, _ = _scene(0 * BREATH)
    assert _adjusted(still) is None
    # False matches and noise take the shortcuts away: tracks left out refuse it.
    wrong, _ = _scene(0 * BREATH, false_share=0.15, noise_px=0.6)
    rigid = adjust(wrong).state
    assert rigid.sigma_px > 0.4
    assert (errors_px(wrong, rigid) > 2).mean() > 0.05
    assert _adjusted(wrong) is None


@pytest.mark.slow
def test_the_curve_of_many_keyframes_is_found_by_fewer_nodes() -> None:
    breath = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(80) / 9)
    problem, true = _scene(breath, per_keyframe=40)
    found = _adjusted(problem)
    assert found is not None
    assert abs(np.corrcoef(found.deformation.basis[:, 0], breath)[0, 1]) > 0.95
    assert found.left_out.px < 0.6
    assert _shape_error_mm(_over_time(problem, found).reshape(-1, 3), true.reshape(-1, 3)) < 2.0


@pytest.mark.parametrize("keyframes", [5, 301])
def test_few_and_many_keyframes_are_not_tried(keyframes: int) -> None:
    problem, _ = _scene(BREATH)
    T = np.concatenate([problem.T_camera_world] * 20)[:keyframes]
    kept = (problem.points.host[problem.observations.point] < 5) & (problem.observations.keyframe < 5)
    seen = problem.observations
    some = seen if keyframes > 300 else Observations(seen.point[kept], seen.keyframe[kept], seen.pixel[kept])
    many = replace(problem, T_camera_world=T, observations=some)
    assert adjust_moving_tissue(many, problem.tracked._replace(sigma_px=1.0), np.arange(keyframes) / 2) is None


def _small(free: bool) -> tuple[NonRigidProblem, NonRigidState]:
    """A problem with 8 nodes and 3 curves, free or given, away from its solution."""
    rigid, true = _scene(BREATH)
    nodes, rng = spread_nodes(true[:, 0], 8), np.random.default_rng(2)
    basis, at_host = hat_functions(KEYFRAMES, 3), true[np.arange(len(true)), rigid.points.host]
    prior = MotionPrior(0.1, 0.03, 0.01).normal_matrix(nodes, basis, rigid.unit_mm)
    problem = NonRigidProblem(rigid, nodes, basis, skin_of(nodes, at_host), prior, free)
    state = rigid.tracked._replace(sigma_px=0.7, log_scale=rng.normal(0, 0.02, KEYFRAMES))
    return problem, NonRigidState(state, rng.normal(0, 0.5, (3, 8, 3)), basis + free * rng.normal(0, 0.05, basis.shape))


@pytest.mark.parametrize("free", [False, True])
def test_the_gradient_is_that_of_the_cost(free: bool) -> None:
    problem, state = _small(free)
    model, rng = linearised(problem, state), np.random.default_rng(3)
    bounds = np.cumsum([6, PER_KEYFRAME_UNKNOWNS * KEYFRAMES - 6, 72, problem.curve_unknowns])  # then points
    for first, end in zip(bounds, [*bounds[1:], None], strict=True):
        step = np.zeros(len(model.gradient))
        step[first:end] = rng.normal(size=len(step[first:end]))
        ahead, behind = (linearised(problem, retracted(problem, state, s * step)).cost for s in (1e-6, -1e-6))
        assert (ahead - behind) / 2e-6 == pytest.approx(model.gradient @ step, rel=1e-4)


@pytest.mark.parametrize("free", [False, True])
def test_the_step_without_points_solves_the_normal_equations_of_all_unknowns(free: bool) -> None:
    model = linearised(*_small(free))
    step, rng = model.gauss_newton_step(), np.random.default_rng(4)
    assert model.curvature(step) == pytest.approx(-model.gradient @ step, rel=1e-5)
    other = rng.normal(size=len(step)) * np.abs(step).max()
    other[:6] = 0
    # H step = -gradient, seen from any other direction.
    mixed = 0.25 * (model.curvature(step + other) - model.curvature(step - other))
    assert 2 * mixed == pytest.approx(-2 * model.gradient @ other, rel=1e-4)


def test_only_what_repeats_itself_has_a_rate() -> None:
    time_s = np.arange(0, 10, 0.4)
    assert periodic_rate(time_s, np.sin(2 * np.pi * 0.3 * time_s)) == pytest.approx(0.3, rel=0.03)
    assert np.isnan(periodic_rate(time_s, np.clip(time_s - 4, 0, 2)))  # a push
    assert np.isnan(periodic_rate(time_s, np.sin(2 * np.pi * 0.1 * time_s)))  # one breath
    assert np.isnan(periodic_rate(time_s, 0 * time_s))


@pytest.mark.slow
def test_a_correction_states_the_motion_and_carries_it_into_another_world(breathing: NonRigidSolution) -> None:
    found = breathing
    index, at_rest = np.arange(KEYFRAMES), np.tile(np.eye(4), (KEYFRAMES, 1, 1))
    motion = TissueMotion(found.deformation, found.left_out, 20.0)
    correction = FrameCorrection(index, at_rest, np.zeros(KEYFRAMES), 0.2, depth_mm=40.0, tissue=motion)
    assert correction.notice.code == "mapping-tissue-moves"
    assert correction.notice.values["nodes"] == 60
    assert "20 times a minute" in correction.notice.text
    T = se3_exp(np.array([0.1, 0.2, 0.3, 5, 6, 7]))
    there = correction.in_world(T).tissue
    assert there is not None
    ends = found.deformation.nodes + found.deformation.displacement[3]
    assert there.deformation.nodes + there.deformation.displacement[3] == pytest.approx(transform(T, ends))
