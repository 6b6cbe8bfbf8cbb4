"""Named protocols: known figures, referees, identities, what each of them is blind to, and that no name is borrowed."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, se3_exp, so3_exp
from scopemap_bench.evaluation.protocol_words import PROTOCOL_WORDS
from scopemap_bench.evaluation.protocols import PROTOCOLS, af_figures
from tests.support.sample_trajectories import as_trajectory, evo_pair, last_digit, random_pair, vector_a

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=6, deadline=None)
# That of CLiMB counts submaps of 250 frames: tests/bench/climb/test_climb_figures.py.
OF_FEW_FRAMES = [name for name in PROTOCOLS if name != "climb"]


def measure(name: str, estimated: np.ndarray, reference: np.ndarray, lost: tuple[int, ...] = ()) -> dict[str, float]:
    return PROTOCOLS[name](as_trajectory(estimated, lost), as_trajectory(reference))


def af_from_relative(estimated: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    return {f"af_{name}": value for name, value in af_figures(estimated, reference).items()}


def of_vector_a(name: str) -> dict[str, float]:
    return measure(name, *vector_a())


def evo_statistics(estimated: np.ndarray, reference: np.ndarray, *, scale: bool) -> dict[str, dict[str, float]]:
    """What evo makes of 4x4 matrices, aligned by SE3 or Sim3: APE, and RPE over 1 frame."""
    from evo.core import metrics

    pair = evo_pair(estimated, reference, "sim3" if scale else "se3")
    relation, found = metrics.PoseRelation, {}
    for unit, kind in (("mm", relation.translation_part), ("deg", relation.rotation_angle_deg)):
        for name, metric in (("ape", metrics.APE(kind)), ("rpe", metrics.RPE(kind))):
            metric.process_data(pair)
            found[f"{name}_{unit}"] = metric.get_all_statistics()
    return found


# ---- names


def test_the_help_names_the_protocols_that_there_are() -> None:
    assert set(PROTOCOL_WORDS) == set(PROTOCOLS)


@pytest.mark.parametrize("name", OF_FEW_FRAMES)
def test_too_few_frames_are_refused(name: str) -> None:
    estimated, reference = vector_a()
    with pytest.raises(AlignmentError, match="2 tracked frames match"):
        measure(name, estimated[:2], reference)


# ---- identities


def error_figures(report: dict[str, float]) -> dict[str, float]:
    return {key: value for key, value in report.items() if key.endswith(("_mm", "_deg", "_rad"))}


@pytest.mark.parametrize("name", OF_FEW_FRAMES)
def test_the_truth_itself_has_no_error(name: str) -> None:
    _, truth = vector_a()
    assert max(error_figures(measure(name, truth, truth)).values()) == pytest.approx(0, abs=1e-6)


@few
@given(seeds)
def test_scale_and_world_of_the_truth_go_unnoticed_where_the_protocol_says_so(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, truth = vector_a()
    moved = Similarity(rng.uniform(0.1, 10), so3_exp(rng.normal(size=3)), rng.normal(scale=30, size=3))
    blind = {"af": "af", "free-surgs": "free_surgs", "simcol": "simcol", "oneslam": "oneslam"}
    blind |= {"evo": "evo_sim3", "surgcut3r": "surgcut3r_first_camera"}
    for name, prefix in blind.items():
        figures = error_figures(measure(name, moved.transform_poses(truth), truth))
        errors = [value for key, value in figures.items() if key.startswith(prefix)]
        assert errors
        assert max(errors) == pytest.approx(0, abs=1e-5), name
    rigid = Similarity(1.0, moved.R, moved.t).transform_poses(truth)
    assert measure("endogslam", rigid, truth)["endogslam_ate_mean_mm"] == pytest.approx(0, abs=1e-6)
    robust = error_figures(measure("robust-pose-estimator", rigid, truth))
    assert max(robust.values()) == pytest.approx(0, abs=1e-6)


def test_lost_frames_are_left_out() -> None:
    estimated, reference = vector_a()
    nonsense, lost = estimated.copy(), (3, 4, 20, 59)
    nonsense[list(lost)] = se3_exp(np.full(6, 7.0))
    kept = np.setdiff1d(np.arange(60), lost)
    for name in OF_FEW_FRAMES:
        found = measure(name, nonsense, reference, lost)
        assert found == pytest.approx(measure(name, estimated[kept], reference[kept]), abs=1e-9), name


# ---- evo and what follows it


@few
@given(seeds)
def test_evo_protocol_agrees_with_evo(seed: int) -> None:
    estimated, reference = random_pair(seed)
    figures = measure("evo", estimated, reference)
    robust = measure("robust-pose-estimator", estimated, reference)
    for mode in ("se3", "sim3"):
        theirs = evo_statistics(estimated, reference, scale=mode == "sim3")
        for measured, statistics in theirs.items():
            kind, unit = measured.replace("rpe", "rpe_1_frame").rsplit("_", 1)
            for statistic in ("rmse", "mean", "median", "std", "min", "max"):
                found = figures[f"evo_{mode}_{kind}_{statistic}_{unit}"]
                assert found == pytest.approx(statistics[statistic], rel=1e-6, abs=1e-7)
        if mode == "se3":
            assert robust["robust_pose_estimator_ate_rmse_mm"] == pytest.approx(theirs["ape_mm"]["rmse"])
            assert robust["robust_pose_estimator_rpe_1_frame_mean_mm"] == pytest.approx(theirs["rpe_mm"]["mean"])
            mean_deg = np.degrees(robust["robust_pose_estimator_rpe_1_frame_mean_rad"])
            assert mean_deg == pytest.approx(theirs["rpe_deg"]["mean"])


def test_oneslam_on_vector_a_takes_its_pairs_from_the_estimate() -> None:
    figures = of_vector_a("oneslam")
    assert (figures["oneslam_ape_rmse_mm"], figures["oneslam_ape_rmse_deg"]) == last_digit(0.308821, 1.107530)
    assert figures["oneslam_rpe_pairs"] == 20
    assert (figures["oneslam_rpe_1_mm_path_rmse_mm"],) == last_digit(0.521114)


# ---- AF


def relative(T_world_camera: np.ndarray) -> np.ndarray:
    world_to_camera = np.linalg.inv(T_world_camera)
    return np.stack([b @ np.linalg.inv(a) for a, b in pairwise(world_to_camera)])


def test_af_divides_by_the_number_of_positions_and_counts_the_first_identity() -> None:
    forward, sideways = np.eye(4), np.eye(4)
    forward[2, 3], sideways[0, 3] = 3.0, 3.0
    sideways[:3, :3] = so3_exp(np.array([0, 0.1, 0.0]))
    # Two motions are one window of 3 positions; at right angles no scale helps: sqrt(3^2 + 6^2) / 3.
    straight = np.stack([np.diag([1.0, 1, 1, 1])] * 2)
    straight[:, 0, 3] = 1
    figures = af_from_relative(straight, np.stack([forward] * 2))
    assert figures["af_ate_mean_mm"] == pytest.approx(np.sqrt(45) / 3)
    assert figures["af_windows"] == 1
    turned = af_from_relative(np.stack([sideways] * 2), np.stack([forward] * 2))
    assert turned["af_re_mean_rad"] == pytest.approx((0 + 0.1 + 0.2) / 3)
    assert np.isnan(turned["af_ate_ci95_low_mm"])


def test_af_windows_are_full_but_the_last_two_and_the_interval_is_students() -> None:
    estimated, reference = (relative(poses) for poses in random_pair(3, 12))
    ates = []
    for k in range(10):
        lines = []
        for motions in (estimated[k : k + 4], reference[k : k + 4]):
            products = [np.eye(4)]
            for T in motions:
                products.append(products[-1] @ T)
            lines.append(np.array([T[:3, 3] for T in products]))
        s = np.vdot(*lines) / np.vdot(lines[0], lines[0])
        ates.append(np.sqrt(((s * lines[0] - lines[1]) ** 2).sum()) / len(lines[0]))
    figures = af_from_relative(estimated, reference)
    assert (figures["af_ate_mean_mm"], figures["af_ate_std_mm"]) == pytest.approx((np.mean(ates), np.std(ates)))
    low, high = stats.t.interval(0.95, df=9, loc=np.mean(ates), scale=stats.sem(ates))
    assert (figures["af_ate_ci95_low_mm"], figures["af_ate_ci95_high_mm"]) == pytest.approx((low, high))


@pytest.mark.parametrize(
    ("sequence", "known"),
    [("1", (0.077612, 0.053581, 0.003063, 0.001834)), ("2", (0.048651, 0.028520, 0.003077, 0.002032))],
)
def test_af_reproduces_the_published_curves(sequence: str, known: tuple[float, ...]) -> None:
    """EndoDAC's poses on SCARED: `splits/endovis/curve/{gt,pred}_poses_sequence{1,2}.npz` of BeileiCui/EndoDAC."""
    folder = os.environ.get("SCOPEMAP_AF_CURVES")
    if not folder:
        pytest.skip("set SCOPEMAP_AF_CURVES to the folder splits/endovis/curve of BeileiCui/EndoDAC to run this test")
    motions = [np.load(Path(folder) / f"{kind}_poses_sequence{sequence}.npz")["data"] for kind in ("pred", "gt")]
    figures = af_from_relative(*(T.astype(np.float64) for T in motions))
    found = tuple(figures[f"af_{name}"] for name in ("ate_mean_mm", "ate_std_mm", "re_mean_rad", "re_std_rad"))
    assert found == pytest.approx(known, abs=1e-6)


# ---- world to camera


@few
@given(seeds)
def test_endogslam_is_horns_fit_of_world_to_camera_translations(seed: int) -> None:
    estimated, reference = random_pair(seed)
    found = measure("endogslam", estimated, reference)
    for name, worlds in (
        ("endogslam_ate_mean_as_stored_mm", (estimated, reference)),
        ("endogslam_ate_mean_mm", [np.linalg.inv(poses[0]) @ poses for poses in (estimated, reference)]),
    ):
        p, q = (np.linalg.inv(poses)[:, :3, 3] for poses in worlds)
        p, q = p - p.mean(axis=0), q - q.mean(axis=0)
        turn, _ = Rotation.align_vectors(q, p)
        assert found[name] == pytest.approx(np.linalg.norm(turn.apply(p) - q, axis=1).mean())


@few
@given(seeds)
def test_free_surgs_is_evos_sim3_on_world_to_camera_matrices(seed: int) -> None:
    estimated, reference = random_pair(seed)
    figures = measure("free-surgs", estimated, reference)
    turned = [np.linalg.inv(np.linalg.inv(poses[0]) @ poses) for poses in (estimated, reference)]
    for prefix, poses in (("free_surgs", turned), ("free_surgs_c2w", (estimated, reference))):
        theirs = evo_statistics(*poses, scale=True)
        assert figures[f"{prefix}_ate_rmse_mm"] == pytest.approx(theirs["ape_mm"]["rmse"])
        assert figures[f"{prefix}_rpe_1_frame_mean_mm"] == pytest.approx(theirs["rpe_mm"]["mean"])
        assert figures[f"{prefix}_rpe_1_frame_mean_deg"] == pytest.approx(theirs["rpe_deg"]["mean"])


# ---- SurgCUT3R, SimCol3D


def test_surgcut3r_turns_nothing_and_drops_what_fills_no_window() -> None:
    _, truth = vector_a()
    truth = truth[:35]
    estimated = truth.copy()
    estimated[:, :3, 3] = 0.5 * truth[:, :3, 3] + [1, 2, 3]
    figures = measure("surgcut3r", estimated, truth)
    assert figures["surgcut3r_global_scale"] == pytest.approx(2)
    assert figures["surgcut3r_local_windows"] == 2
    assert max(error_figures(measure("surgcut3r", estimated, truth)).values()) == pytest.approx(0, abs=1e-9)
    estimated[33:, 0, 3] += 5  # after the second window of 16
    figures = measure("surgcut3r", estimated, truth)
    assert figures["surgcut3r_local_ate_rmse_mean_mm"] == pytest.approx(0, abs=1e-9)
    assert figures["surgcut3r_global_ate_rmse_mm"] > 1
    turned = se3_exp(np.array([0.4, 0, 0, 0, 0, 0])) @ truth
    figures = measure("surgcut3r", turned, truth)
    assert figures["surgcut3r_global_ate_rmse_mm"] > 0.1
    assert figures["surgcut3r_first_camera_global_ate_rmse_mm"] == pytest.approx(0, abs=1e-9)
    assert np.isnan(measure("surgcut3r", truth[:10], truth)["surgcut3r_local_ate_rmse_mean_mm"])


@few
@given(seeds)
def test_simcol_chains_motions_scales_them_once_and_takes_medians(seed: int) -> None:
    estimated, reference = random_pair(seed)
    p_steps, q_steps = ([inverse(a) @ b for a, b in pairwise(T)] for T in (estimated, reference))
    p_shift, q_shift = (np.array([T[:3, 3] for T in steps]) for steps in (p_steps, q_steps))
    scale = np.linalg.lstsq(p_shift.reshape(-1, 1), q_shift.ravel(), rcond=None)[0][0]
    P, Q, distance, rte_mm, rot_rad = np.eye(4), np.eye(4), [0.0], [], []
    for p, q in zip(p_steps, q_steps, strict=True):
        p = p.copy()
        p[:3, 3] *= scale
        P, Q = P @ p, Q @ q
        distance.append(np.linalg.norm(P[:3, 3] - Q[:3, 3]))
        rte_mm.append(np.linalg.norm((np.linalg.inv(q) @ p)[:3, 3]))
        rot_rad.append(Rotation.from_matrix(q[:3, :3].T @ p[:3, :3]).magnitude())
    figures = measure("simcol", estimated, reference)
    assert figures["simcol_scale"] == pytest.approx(scale)
    expected = (np.median(distance), np.median(rte_mm), np.degrees(np.median(rot_rad)))
    found = tuple(figures[f"simcol_{name}"] for name in ("ate_median_mm", "rte_median_mm", "rot_median_deg"))
    assert found == pytest.approx(expected)
