"""Pose errors: known figures, agreement with evo, identities, lost frames, association."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import align_trajectories
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.evaluation.doubts import evaluate_poses
from scopemap.evaluation.poses import (
    ErrorSummary,
    associate,
    below_percent,
    frame_pairs,
    match,
    path_pairs,
    relative_errors,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.result.trajectories import read_trajectory
from tests.support.sample_trajectories import as_trajectory, evo_pair, last_digit, random_pair, vector_a

MODES = ("none", "origin", "se3", "sim3", "scale")


def test_vector_a_lengths_scale_and_report() -> None:
    estimated, reference = (as_trajectory(poses) for poses in vector_a())
    assert (reference.path_length_mm, estimated.path_length_mm) == last_digit(48.895807, 21.356797)
    report = evaluate_poses(estimated, reference, "sim3")
    assert report["scale"] == pytest.approx(2.4976917, abs=5.1e-8)
    assert (report["ate_rmse_mm"], report["ate_mean_mm"], report["rotation_mean_deg"]) == last_digit(
        0.308821, 0.299139, 1.067505
    )
    assert (report["rpe_1_mm"], report["rpe_1_deg"], report["rpe_10_mm"]) == last_digit(0.437467, 1.183157, 0.552066)
    assert report["ate_hold_rmse_mm"] == report["ate_rmse_mm"]
    assert (report["tlr"],) == last_digit(0.436782)
    # Rotation since the first frame is the rotation error after aligning the origins.
    assert (report["rotation_unaligned_mean_deg"],) == last_digit(1.297134)
    assert (report["frames"], report["tracked"], report["align"]) == (60, 60, "sim3")


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from(MODES), first=st.sampled_from([None, 4, 9]))
def test_absolute_errors_agree_with_evo(seed: int, mode: str, first: int | None) -> None:
    from evo.core import metrics

    estimated, reference = random_pair(seed)
    first = None if mode in ("none", "origin") else first
    matched = match(as_trajectory(estimated), as_trajectory(reference), mode, first=first)
    distance = translation_errors_mm(matched.aligned, matched.reference)
    angle_deg = np.degrees(rotation_errors_rad(matched.aligned, matched.reference))
    relation = metrics.PoseRelation
    for errors, kind in ((distance, relation.translation_part), (angle_deg, relation.rotation_angle_deg)):
        theirs = metrics.APE(kind)
        theirs.process_data(evo_pair(estimated, reference, mode, first))
        np.testing.assert_allclose(errors, theirs.error, rtol=1e-6, atol=1e-6)
        summary = asdict(ErrorSummary.of(errors))
        expected = theirs.get_all_statistics()
        assert {key: summary[key] for key in expected} == pytest.approx(expected, rel=1e-6)
    report = evaluate_poses(as_trajectory(estimated), as_trajectory(reference), mode, first=first)
    found = (report["ate_rmse_mm"], report["ate_median_mm"], report["ate_max_mm"], report["rotation_mean_deg"])
    ate, rotation_deg = ErrorSummary.of(distance), np.nan if report["turn"] else np.mean(angle_deg)
    assert found == pytest.approx((ate.rmse, ate.median, ate.max, rotation_deg), nan_ok=True)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    mode=st.sampled_from(MODES),
    delta=st.sampled_from([("frames", 1), ("frames", 10), ("frames", 4), ("meters", 7.0), ("meters", 20.0)]),
    from_reference=st.booleans(),
)
def test_relative_errors_agree_with_evo(seed: int, mode: str, delta: tuple[str, float], from_reference: bool) -> None:
    from evo.core import filters, metrics

    estimated, reference = random_pair(seed)
    aligned, _ = align_trajectories(estimated, reference, mode)
    unit, length = delta
    positions = (reference if from_reference else aligned)[:, :3, 3]
    if unit == "frames":
        pairs = frame_pairs(len(aligned), int(length))
    else:
        pairs = path_pairs(positions, length)
    relation = metrics.PoseRelation
    for errors, kind in zip(
        relative_errors(aligned, reference, pairs),
        (relation.translation_part, relation.rotation_angle_rad),
        strict=True,
    ):
        options = {"all_pairs": True, "pairs_from_reference": from_reference}
        theirs = metrics.RPE(kind, length, metrics.Unit[unit], **options)
        try:
            theirs.process_data(evo_pair(estimated, reference, mode))
        except filters.FilterException:  # no pair: evo refuses, we have no errors
            assert len(pairs) == 0
            continue
        assert [second for _, second in pairs.tolist()] == theirs.delta_ids
        np.testing.assert_allclose(errors, theirs.error, rtol=1e-6, atol=1e-7)


def test_lost_frames_are_left_out_of_all_but_the_held_figure() -> None:
    _, truth = vector_a()
    lost = (20, 21, 22, 59)
    estimate = truth.copy()
    estimate[list(lost)] = se3_exp(np.full(6, 7.0))  # nonsense: it must not be looked at
    report = evaluate_poses(as_trajectory(estimate, lost), as_trajectory(truth), "origin")
    assert (report["frames"], report["tracked"]) == (60, 56)
    assert report["ate_rmse_mm"] == pytest.approx(0, abs=1e-9)
    assert report["rpe_10_mm"] == pytest.approx(0, abs=1e-9)
    gaps = [
        np.linalg.norm(truth[k, :3, 3] - truth[held, :3, 3]) for k, held in ((20, 19), (21, 19), (22, 19), (59, 58))
    ]
    assert report["ate_hold_rmse_mm"] == pytest.approx(np.sqrt(np.sum(np.square(gaps)) / 60))
    assert (report["longest_tracked"], report["frames_until_loss"]) == (36, 20)
    assert report["coverage"] == pytest.approx(56 / 60)


def test_lost_frames_do_not_take_part_in_the_fit() -> None:
    estimate, truth = vector_a()
    lost = tuple(range(40, 60))
    found = evaluate_poses(as_trajectory(estimate, lost), as_trajectory(truth), "sim3")
    alone = evaluate_poses(as_trajectory(estimate[:40]), as_trajectory(truth[:40]), "sim3")
    assert (found["scale"], found["ate_rmse_mm"], found["tlr"]) == (alone["scale"], alone["ate_rmse_mm"], alone["tlr"])
    assert found["ate_hold_rmse_mm"] > 5 * found["ate_rmse_mm"]


def test_the_error_over_path_takes_its_pairs_from_the_reference_and_skips_lost_frames() -> None:
    from evo.core import metrics

    estimated, reference = vector_a()
    report = evaluate_poses(as_trajectory(estimated), as_trajectory(reference), "none")
    relation = metrics.PoseRelation
    found = (report["rpe_10mm_path_mm"], report["rpe_10mm_path_deg"])
    for value, kind in zip(found, (relation.translation_part, relation.rotation_angle_deg), strict=True):
        theirs = metrics.RPE(kind, 10.0, metrics.Unit.meters, all_pairs=True, pairs_from_reference=True)
        theirs.process_data(evo_pair(estimated, reference, "none"))
        assert value == pytest.approx(theirs.get_statistic(metrics.StatisticsType.rmse))
    nonsense = reference.copy()
    nonsense[20:25] = se3_exp(np.full(6, 7.0))
    report = evaluate_poses(as_trajectory(nonsense, (20, 21, 22, 23, 24)), as_trajectory(reference), "none")
    assert report["rpe_10mm_path_mm"] == pytest.approx(0, abs=1e-9)


def test_shares_below_fixed_limits_are_strict_and_the_same_for_all_methods() -> None:
    assert below_percent(np.array([0.5, 1.0, 1.5, 4.0]), 1.0) == 25
    assert np.isnan(below_percent(np.empty(0), 1.0))
    _, truth = vector_a()
    estimate = truth.copy()
    estimate[:12, 0, 3] += 0.9
    estimate[12:30, 0, 3] += 1.5
    estimate[30:36, 0, 3] += 4.5
    estimate[36:, 0, 3] += 9
    estimate[:15] = estimate[:15] @ se3_exp(np.array([0, 0, np.radians(1.5), 0, 0, 0]))
    report = evaluate_poses(as_trajectory(estimate), as_trajectory(truth), "none")
    below = (report["ate_below_1_mm_percent"], report["ate_below_2_mm_percent"], report["ate_below_5_mm_percent"])
    assert below == pytest.approx((20, 50, 60))
    turned = (report["rotation_below_1_deg_percent"], report["rotation_below_2_deg_percent"])
    assert (*turned, report["rotation_below_5_deg_percent"]) == pytest.approx((75, 100, 100))


def test_coverage_counts_missing_frames_like_lost_ones_but_only_within_the_span() -> None:
    estimate, truth = (as_trajectory(poses) for poses in vector_a())
    part = estimate.rows(np.array([10, 11, 12, 13, 17, 18, 19]))
    report = evaluate_poses(part, truth, "se3")
    assert report["coverage"] == pytest.approx(7 / 10)
    assert (report["frames"], report["reference_frames"], report["longest_tracked"]) == (7, 60, 7)
    by_time = match(replace(part, has_indices=False), truth, "se3")
    assert (by_time.reference_in_span, by_time.coverage) == (10, report["coverage"])
    unknown = replace(truth, status=np.where(np.arange(60) == 15, "lost", truth.status))
    assert evaluate_poses(part, unknown, "se3")["coverage"] == pytest.approx(7 / 9)


def test_too_few_matches_are_refused() -> None:
    estimate, truth = (as_trajectory(poses) for poses in vector_a())
    elsewhere = replace(estimate, indices=estimate.indices + 58)
    with pytest.raises(AlignmentError, match=r"2 tracked frames match.*58\.\.117 and 0\.\.59"):
        evaluate_poses(elsewhere, truth, "none")
    with pytest.raises(AlignmentError, match="0 tracked frames match"):
        evaluate_poses(as_trajectory(vector_a()[0], tuple(range(60))), truth, "none")
    timed = replace(estimate, times_s=estimate.times_s + 1e9, has_indices=False)
    with pytest.raises(AlignmentError, match="time stamps are"):
        evaluate_poses(timed, truth, "none")


def test_association_by_index_takes_what_both_have() -> None:
    _, truth = (as_trajectory(poses) for poses in vector_a())
    part = truth.rows(np.arange(10, 60, 7))
    rows = associate(part, truth)
    assert rows[0].tolist() == list(range(8))
    assert rows[1].tolist() == list(range(10, 60, 7))


def stamped(times_s: list[float]) -> Trajectory:
    poses = np.stack([np.eye(4)] * len(times_s))
    return replace(as_trajectory(poses), times_s=np.array(times_s), has_indices=False)


def test_association_by_time_is_nearest_one_to_one_and_bounded() -> None:
    estimate = stamped([0.000, 0.004, 0.100, 0.511, 0.900])
    reference = stamped([0.003, 0.110, 0.500, 0.901, 2.000])
    rows = associate(estimate, reference)
    # 0.000 loses 0.003 to 0.004; 0.100 is just within 0.01 s; 0.511 is not.
    assert rows[0].tolist() == [1, 2, 4]
    assert rows[1].tolist() == [0, 1, 3]
    assert [len(r) for r in associate(estimate, reference.rows(np.zeros(5, dtype=bool)))] == [0, 0]


@pytest.mark.real
@pytest.mark.parametrize("name", ["c4v3", "t1v1", "t2v1", "t2v2"])
def test_true_rotations_on_straight_paths_are_seen_to_be_right(name: str, real_data: Path) -> None:
    truth = read_trajectory(real_data / "endoscopy" / "c3vd_camera_paths" / f"{name}.txt")
    rng, poses = np.random.default_rng(5), truth.T_world_camera.copy()
    # Errors along the path, as those of a tracker: smooth.
    off_mm = np.cumsum(rng.normal(size=(len(poses), 3)), 0)
    poses[:, :3, 3] += 0.066 * off_mm / np.sqrt((off_mm**2).mean())
    estimate = replace(truth, T_world_camera=se3_exp(np.array([0.3, -2.0, 0.5, 9.0, -4.0, 2.0])) @ poses)
    report = evaluate_poses(estimate, truth, "sim3")
    assert report["straight"] == "straight path"
    assert np.radians(report["rotation_max_deg"]) < 0.01
    assert report["ate_rmse_mm"] < 0.2
    by_positions, _ = align_trajectories(estimate.T_world_camera, truth.T_world_camera, "sim3")
    assert rotation_errors_rad(by_positions, truth.T_world_camera).mean() > 0.01
