"""Pose errors: known figures, agreement with evo, identities, lost frames, association."""

from __future__ import annotations

import copy
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_trajectories import as_trajectory, vector_a

from scopemap.errors import AlignmentError
from scopemap.evaluation.pose_errors import (
    ErrorSummary,
    frame_pairs,
    path_pairs,
    relative_errors,
    rotation_errors_rad,
    translation_errors_mm,
)
from scopemap.evaluation.poses import associate, evaluate_poses, match, paper_report
from scopemap.geometry.align import Similarity, align_trajectories, umeyama
from scopemap.geometry.se3 import se3_exp, so3_exp
from scopemap.trajectory import Trajectory

MODES = ("none", "origin", "se3", "sim3")


def aligned_a(mode: str) -> tuple[np.ndarray, np.ndarray, float]:
    estimated, reference = vector_a()
    if mode == "scale only":
        scale = umeyama(estimated[:, :3, 3], reference[:, :3, 3], with_scale=True).scale
        return Similarity(scale, np.eye(3), np.zeros(3)).transform_poses(estimated), reference, scale
    aligned, similarity = align_trajectories(estimated, reference, mode)
    return aligned, reference, similarity.scale


def last_digit(*values: float) -> object:
    """Figures given to six decimals, to the last of them."""
    return pytest.approx(values, abs=5.1e-7)


@pytest.mark.parametrize(
    ("mode", "translation", "rotation_deg", "one_frame", "ten_consecutive", "ten_all"),
    [
        ("none", (10.058219, 9.198764), (56.728720, 56.726869), (0.557375, 0.521526), 4.796169, 4.766312),
        ("se3", (5.585285, 5.280142), (1.107530, 1.067505), (0.557375, 0.521526), 4.796169, 4.766312),
        ("sim3", (0.308821, 0.299139), (1.107530, 1.067505), (0.437467, 0.424599), 0.493046, 0.552066),
        ("origin", (8.782756, 8.196073), (1.385196, 1.297134), (0.557375, 0.521526), 4.796169, 4.766312),
        ("scale only", (17.469604, 16.816942), (56.728720, 56.726869), (0.437467, 0.424599), 0.493046, 0.552066),
    ],
)
def test_vector_a(
    mode: str,
    translation: tuple[float, float],
    rotation_deg: tuple[float, float],
    one_frame: tuple[float, float],
    ten_consecutive: float,
    ten_all: float,
) -> None:
    aligned, reference, _ = aligned_a(mode)
    ape = ErrorSummary.of(np.linalg.norm(translation_errors_mm(aligned, reference), axis=1))
    angle = ErrorSummary.of(np.degrees(rotation_errors_rad(aligned, reference)))
    assert (ape.rmse, ape.mean) == last_digit(*translation)
    assert (angle.rmse, angle.mean) == last_digit(*rotation_deg)
    rpe_mm, rpe_rad = relative_errors(aligned, reference, frame_pairs(60, 1))
    assert (ErrorSummary.of(rpe_mm).rmse, ErrorSummary.of(rpe_mm).mean) == last_digit(*one_frame)
    assert (np.degrees(ErrorSummary.of(rpe_rad).rmse),) == last_digit(1.183157)
    for pairs, count, rmse in (
        (frame_pairs(60, 10, consecutive=True), 5, ten_consecutive),
        (frame_pairs(60, 10), 50, ten_all),
    ):
        assert len(pairs) == count
        assert (ErrorSummary.of(relative_errors(aligned, reference, pairs)[0]).rmse,) == last_digit(rmse)


@pytest.mark.parametrize(
    ("mode", "length_mm", "consecutive", "count", "rmse"),
    [
        ("none", 5, True, 4, 7.042906),
        ("sim3", 5, True, 9, 0.510224),
        ("none", 1, False, 28, 1.154832),
        ("sim3", 1, False, 20, 0.521114),
    ],
)
def test_vector_a_over_path(mode: str, length_mm: float, consecutive: bool, count: int, rmse: float) -> None:
    aligned, reference, _ = aligned_a(mode)
    pairs = path_pairs(aligned[:, :3, 3], length_mm, consecutive=consecutive)
    assert len(pairs) == count
    assert (ErrorSummary.of(relative_errors(aligned, reference, pairs)[0]).rmse,) == last_digit(rmse)


def test_vector_a_lengths_scale_and_report() -> None:
    estimated, reference = (as_trajectory(poses) for poses in vector_a())
    assert (reference.path_length_mm, estimated.path_length_mm) == last_digit(48.895807, 21.356797)
    report = evaluate_poses(estimated, reference, "sim3")
    assert report.scale == pytest.approx(2.4976917, abs=5.1e-8)
    assert (report.ate_rmse_mm, report.ate_mean_mm, report.rotation_mean_deg) == last_digit(
        0.308821, 0.299139, 1.067505
    )
    assert (report.rpe_1_mm, report.rpe_1_deg, report.rpe_10_mm) == last_digit(0.437467, 1.183157, 0.552066)
    assert report.ate_hold_rmse_mm == report.ate_rmse_mm
    assert (report.tlr,) == last_digit(0.436782)
    # Rotation since the first frame is the rotation error after aligning the origins.
    assert (report.rotation_unaligned_mean_deg,) == last_digit(1.297134)
    assert (report.frames, report.tracked, report.align) == (60, 60, "sim3")


VECTOR_B = {
    "se3": {
        "mean": (3.669195, 2.341892, 2.333184),
        "rmse": (4.145455, 2.594043, 2.698434),
        "final": (1.230978, 1.221572, 3.921726),
        "max": (6.096605, 4.355449, 5.292149),
        "below_mean_percent": (45.0, 48.333, 50.0),
        "total": (4.288062, 7.161335, 40.0),
        "tlr": 0.436782,
    },
    "sim3": {
        "mean": (0.189220, 0.127828, 0.159267),
        "rmse": (0.210457, 0.141311, 0.176379),
        "final": (0.073127, 0.139029, 0.162390),
        "max": (0.309066, 0.216446, 0.263024),
        "below_mean_percent": (43.333, 40.0, 41.667),
        "total": (0.225936, 0.423998, 45.0),
        "tlr": 1.090946,
    },
}


@pytest.mark.parametrize("mode", ["se3", "sim3"])
def test_vector_b(mode: str) -> None:
    aligned, reference, scale = aligned_a(mode)
    known = VECTOR_B[mode]
    error = translation_errors_mm(aligned, reference)
    axes = [asdict(ErrorSummary.of(np.abs(error[:, axis]))) for axis in range(3)]
    for name in ("mean", "rmse", "final", "max"):
        assert tuple(axis[name] for axis in axes) == last_digit(*known[name]), name
    shares = tuple(axis["below_mean_percent"] for axis in axes)
    assert shares == pytest.approx(known["below_mean_percent"], abs=5.1e-4)
    total = ErrorSummary.of(np.linalg.norm(error, axis=1))
    assert (total.final, total.max, total.below_mean_percent) == last_digit(*known["total"])
    report = paper_report(match(*(as_trajectory(poses) for poses in vector_a()), mode))
    assert (report.t_fin_mm, report.t_max_mm, report.t_below_avg_percent) == last_digit(*known["total"])
    degrees = np.degrees([report.r_avg_rad, report.r_fin_rad, report.r_max_rad])
    assert tuple(degrees) == last_digit(1.067505, 1.245602, 1.697826)
    assert report.r_below_avg_percent == pytest.approx(50.0)
    # The vector's ratio for Sim(3) is after scaling; the report's is always before.
    assert (report.tlr * scale,) == last_digit(known["tlr"])
    assert report.rmse_mm**2 == pytest.approx(report.t_avg_mm**2 + report.t_std_mm**2)
    assert report.lost_percent == 0


def test_three_figures_whose_source_is_off_in_the_last_digit_are_as_evo_has_them() -> None:
    from evo.core.trajectory import PosePath3D

    estimated, reference = (PosePath3D(poses_se3=list(poses)) for poses in vector_a())
    assert (reference.path_length,) == last_digit(48.895807)
    estimated.align(reference)
    z = np.abs(estimated.positions_xyz - reference.positions_xyz)[:, 2]
    assert (np.sqrt(np.mean(z**2)), z.max()) == last_digit(VECTOR_B["se3"]["rmse"][2], VECTOR_B["se3"]["max"][2])


def random_pair(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(12, 40))

    def walk() -> np.ndarray:
        T, poses = np.eye(4), []
        for _ in range(count):
            T = T @ se3_exp(np.concatenate([rng.normal(scale=0.2, size=3), rng.normal(scale=2, size=3)]))
            poses.append(T)
        return np.stack(poses)

    return walk(), walk()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), mode=st.sampled_from(MODES))
def test_agrees_with_evo(seed: int, mode: str) -> None:
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    estimated, reference = random_pair(seed)
    report = evaluate_poses(as_trajectory(estimated), as_trajectory(reference), mode)
    theirs, truth = (PosePath3D(poses_se3=list(copy.deepcopy(poses))) for poses in (estimated, reference))
    if mode == "origin":
        theirs.align_origin(truth)
    elif mode != "none":
        theirs.align(truth, correct_scale=mode == "sim3")

    def rmse(metric: metrics.PE, statistic: metrics.StatisticsType = metrics.StatisticsType.rmse) -> float:
        metric.process_data((truth, theirs))
        return metric.get_statistic(statistic)

    relation, mean = metrics.PoseRelation, metrics.StatisticsType.mean
    rpe = [
        metrics.RPE(kind, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        for delta in (1, 10)
        for kind in (relation.translation_part, relation.rotation_angle_deg)
    ]
    expected = [
        rmse(metrics.APE(relation.translation_part)),
        rmse(metrics.APE(relation.translation_part), mean),
        rmse(metrics.APE(relation.rotation_angle_deg), mean),
        *(rmse(metric) for metric in rpe),
    ]
    found = [report.ate_rmse_mm, report.ate_mean_mm, report.rotation_mean_deg]
    found += [report.rpe_1_mm, report.rpe_1_deg, report.rpe_10_mm, report.rpe_10_deg]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), consecutive=st.booleans())
def test_path_pairs_agree_with_evo(seed: int, consecutive: bool) -> None:
    from evo.core import filters

    poses, _ = random_pair(seed)
    theirs = filters.filter_pairs_by_path(list(poses), 7.0, tol=0.7, all_pairs=not consecutive)
    assert path_pairs(poses[:, :3, 3], 7.0, consecutive=consecutive).tolist() == [list(pair) for pair in theirs]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_perfect_and_sim3_of_the_truth_give_zero(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, truth = random_pair(seed)
    for mode in MODES:
        report = evaluate_poses(as_trajectory(truth), as_trajectory(truth), mode)
        errors = {key: value for key, value in asdict(report).items() if key.endswith(("_mm", "_deg"))}
        assert max(errors.values()) == pytest.approx(0, abs=1e-6)
        assert report.tlr == 1
    scale = rng.uniform(0.1, 10)
    moved = Similarity(scale, so3_exp(rng.normal(size=3)), rng.normal(scale=30, size=3)).transform_poses(truth)
    report = evaluate_poses(as_trajectory(moved), as_trajectory(truth), "sim3")
    assert [report.ate_rmse_mm, report.rotation_max_deg, report.rpe_10_mm] == pytest.approx([0, 0, 0], abs=1e-5)
    assert report.scale == pytest.approx(1 / scale)
    assert report.tlr == pytest.approx(scale)


def test_opposite_camera_axes_give_pi_after_alignment_and_nothing_unaligned() -> None:
    _, truth = vector_a()
    flipped = truth @ np.diag([1.0, -1.0, -1.0, 1.0])
    report = paper_report(match(as_trajectory(flipped), as_trajectory(truth), "none"))
    assert [report.r_avg_rad, report.r_max_rad, report.r_fin_rad] == pytest.approx([np.pi] * 3)
    assert report.t_max_mm == 0


def test_lost_frames_are_left_out_of_all_but_the_held_figure() -> None:
    _, truth = vector_a()
    lost = (20, 21, 22, 59)
    estimate = truth.copy()
    estimate[list(lost)] = se3_exp(np.full(6, 7.0))  # nonsense: it must not be looked at
    report = evaluate_poses(as_trajectory(estimate, lost), as_trajectory(truth), "origin")
    assert (report.frames, report.tracked) == (60, 56)
    assert report.ate_rmse_mm == pytest.approx(0, abs=1e-9)
    assert report.rpe_10_mm == pytest.approx(0, abs=1e-9)
    gaps = [
        np.linalg.norm(truth[k, :3, 3] - truth[held, :3, 3]) for k, held in ((20, 19), (21, 19), (22, 19), (59, 58))
    ]
    assert report.ate_hold_rmse_mm == pytest.approx(np.sqrt(np.sum(np.square(gaps)) / 60))
    assert paper_report(match(as_trajectory(estimate, lost), as_trajectory(truth), "origin")).lost_percent == (
        pytest.approx(100 * 4 / 60)
    )


def test_lost_frames_do_not_take_part_in_the_fit() -> None:
    estimate, truth = vector_a()
    lost = tuple(range(40, 60))
    found = evaluate_poses(as_trajectory(estimate, lost), as_trajectory(truth), "sim3")
    alone = evaluate_poses(as_trajectory(estimate[:40]), as_trajectory(truth[:40]), "sim3")
    assert (found.scale, found.ate_rmse_mm, found.tlr) == (alone.scale, alone.ate_rmse_mm, alone.tlr)
    assert found.ate_hold_rmse_mm > 5 * found.ate_rmse_mm


def test_the_papers_rpe_takes_its_pairs_from_the_reference() -> None:
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    estimated, reference = vector_a()
    report = paper_report(match(as_trajectory(estimated), as_trajectory(reference), "none"))
    theirs = metrics.RPE(
        metrics.PoseRelation.translation_part, 10.0, metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
    )
    theirs.process_data(tuple(PosePath3D(poses_se3=list(poses)) for poses in (reference, estimated)))
    statistics = theirs.get_all_statistics()
    found = (report.rpe_10_mm_path_mm, report.rpe_10_mm_path_std_mm)
    assert found == pytest.approx((statistics["mean"], statistics["std"]))


def test_frames_lost_from_the_start_and_frames_lost_in_the_truth() -> None:
    estimate, truth = vector_a()
    report = evaluate_poses(as_trajectory(estimate, (0, 1)), as_trajectory(truth, (30, 31)), "sim3")
    assert (report.frames, report.tracked) == (58, 56)
    assert np.isfinite(report.ate_hold_rmse_mm)


def test_fewer_than_eleven_frames_have_no_error_over_ten() -> None:
    estimate, truth = (poses[:8] for poses in vector_a())
    report = evaluate_poses(as_trajectory(estimate), as_trajectory(truth), "se3")
    assert np.isnan(report.rpe_10_mm)
    assert np.isfinite(report.rpe_1_mm)


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
    with pytest.raises(AlignmentError, match="only time stamps"):
        associate(replace(part, has_indices=False), truth, by="index")


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
