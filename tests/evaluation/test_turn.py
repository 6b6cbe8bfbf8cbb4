"""What the turn of an alignment does not determine: rotation and surface figures are withheld, others are not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.geometry.align import align_trajectories, umeyama
from scopemap.engine.geometry.se3 import rotation_angle_rad, se3, se3_exp, so3_exp
from scopemap.evaluation.doubts import evaluate_poses
from scopemap.evaluation.poses import match, rotation_errors_rad
from scopemap.evaluation.turn import turn_bound_rad
from scopemap_bench.evaluation.paper import paper_figures
from tests.apps.evaluate.test_cli_evaluate import run
from tests.support.sample_trajectories import as_trajectory, write_c3vd, write_run

FRAMES = 60
# Axis of the path, a turn about it of 25 degrees, and the true rotation errors of the estimate.
ALONG, ABOUT_RAD, TRUE_DEG = np.array([0.0, 0.0, 1.0]), np.radians(25), 0.4
SIDEWAYS_MM = {"nearly straight": 2.0, "well-conditioned": 100.0}


def pair(sideways_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """An estimate and the truth: a withdrawal of 52 mm, an error of 0.4 degrees, and positions off by up to 1 mm.

    The error of the positions is that of a turn about a path that goes 2 mm sideways.
    """
    t = np.linspace(0, 1, FRAMES)
    bend = np.stack([np.sin(2 * np.pi * t), 0.7 * np.sin(np.pi * t), 0 * t], axis=1)
    path_mm = np.stack([0 * t, 0 * t, 52 * t], axis=1) + sideways_mm * bend
    turned = SIDEWAYS_MM["nearly straight"] * (bend @ (so3_exp(ABOUT_RAD * ALONG) - np.eye(3)).T)
    drift = np.cumsum(np.random.default_rng(3).normal(size=(FRAMES, 3)), axis=0)
    off_mm = turned + 0.5 * drift / np.abs(drift).max()
    truth = np.stack([se3(so3_exp(np.array([0.1 * s, 0.2 * s, 0.3])), p) for s, p in zip(t, path_mm, strict=True)])
    wrong = se3(so3_exp(np.radians(TRUE_DEG) * np.array([0.0, 0.6, 0.8])), np.zeros(3))
    estimate = truth @ np.where(np.arange(FRAMES)[:, None, None] > 0, wrong, np.eye(4))
    estimate[:, :3, 3] += off_mm
    return estimate, truth


def test_a_turn_by_chance_is_no_rotation_error() -> None:
    estimate, truth = (as_trajectory(poses) for poses in pair(SIDEWAYS_MM["nearly straight"]))
    aligned, _ = align_trajectories(estimate.T_world_camera, truth.T_world_camera, "sim3", by_orientations=True)
    assert np.degrees(rotation_errors_rad(aligned, truth.T_world_camera)).mean() > 15  # what would be printed
    matched = match(estimate, truth, "sim3")
    report, paper = evaluate_poses(estimate, truth, "sim3"), paper_figures(matched)
    assert (report["straight"], report["turn"]) == ("", "not determined")
    withheld = [report[name] for name in ("rotation_mean_deg", "rotation_max_deg", "rotation_below_5_deg_percent")]
    withheld += [paper[f"r_{name}_deg"] for name in ("avg", "std", "rmse", "fin", "max")]
    withheld += [paper["r_below_avg_percent"], paper["r_axes_deg"]["z"]["mean"]]
    assert np.isnan(withheld).all()
    assert report["turn_bound_deg"] > 15
    # What needs no alignment is known.
    known = [report["rotation_unaligned_mean_deg"], paper["r_unaligned_deg"], paper["r_fin_origin_deg"]]
    assert known == pytest.approx([TRUE_DEG] * 3, rel=0.05)
    assert np.isfinite([report["ate_rmse_mm"], report["rpe_10_deg"], report["tlr"]]).all()


@pytest.mark.parametrize("align", ["sim3", "se3", "origin", "none"])
def test_a_well_conditioned_path_keeps_its_figures(align: str) -> None:
    estimate, truth = (as_trajectory(poses) for poses in pair(SIDEWAYS_MM["well-conditioned"]))
    report = evaluate_poses(estimate, truth, align)
    assert report["turn"] == ""
    assert report["rotation_mean_deg"] == pytest.approx(TRUE_DEG, abs=1)


def test_a_large_error_of_a_well_conditioned_path_is_one() -> None:
    estimate, truth = pair(SIDEWAYS_MM["well-conditioned"])
    estimate[10:] = estimate[10:] @ se3(so3_exp(np.array([0.4, 0, 0])), np.zeros(3))
    report = evaluate_poses(as_trajectory(estimate), as_trajectory(truth), "sim3")
    assert report["turn"] == ""
    assert report["rotation_mean_deg"] > 15


@pytest.mark.parametrize("shape", SIDEWAYS_MM)
def test_a_mesh_is_not_measured_where_the_turn_moves_it(shape: str, tmp_path: Path) -> None:
    estimate, truth = pair(SIDEWAYS_MM[shape])
    world = se3_exp(np.array([0.3, -0.2, 0.5, 9.0, -4.0, 2.0]))
    # A wall beside the path, 50 mm away, which a turn about the path moves by 20 mm.
    wall = trimesh.creation.box([1, 40, 60])
    wall.apply_translation([50, 0, 26])
    data = write_c3vd(tmp_path / "truth", truth)
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in wall.vertices)
    faces = "".join("f " + " ".join(f"{v + 1}/1" for v in face) + "\n" for face in wall.faces)
    (data / "coverage_mesh.obj").write_text(corners + "vt 1 0\nvt 2 0\n" + faces)
    folder = write_run(tmp_path / "run", as_trajectory(world @ estimate))
    wall.copy().apply_transform(world).export(folder / "mesh.ply")
    result = run(folder, "--truth", data, "--json")
    figures = json.loads(result.stdout)
    known = shape == "well-conditioned"
    assert figures["surface"]["turn"] == ("" if known else "not determined")
    for value in (figures["mesh_accuracy_mm"], figures["surface"]["f_2mm"], figures["rotation_mean_deg"]):
        assert (value is not None) == known
    assert figures["surface"]["observed_share"] == 1
    assert ("do not determine the alignment's turn" in result.stderr) != known


def turns_over_bound(path: np.ndarray, errors: Callable[[], np.ndarray]) -> np.ndarray:
    """Turns of alignments of 40 paths with errors, over their bounds."""
    ratios = []
    for _ in range(40):
        off = path + errors()
        found = umeyama(off, path, with_scale=True)
        turn = float(rotation_angle_rad(found.R[None])[0])
        ratios.append(turn / turn_bound_rad(found.transform_points(off), path))
    return np.array(ratios)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), sideways=st.floats(0.02, 1))
def test_turns_by_drift_are_within_their_bound(seed: int, sideways: float) -> None:
    rng = np.random.default_rng(seed)
    path = np.linalg.svd(np.cumsum(rng.normal(size=(100, 3)), 0), full_matrices=False)[0] * [200, 200 * sideways, 9]

    def drift() -> np.ndarray:
        walk = np.cumsum(rng.normal(size=path.shape), 0)
        return 0.1 * sideways * walk / np.abs(walk).max()

    ratios = turns_over_bound(path, drift)
    assert np.max(ratios) < 1
    # Of their order: a bound ten times as large would withhold everything. Of 400 such draws the least was .086.
    assert np.max(ratios) > 0.05
    white = turns_over_bound(path, lambda: 0.1 * sideways * rng.normal(size=path.shape))
    assert np.sqrt(np.mean(white**2)) < 0.05  # of 400 draws at most .025; by drift .04 to .19


def test_where_positions_do_not_decide_the_turn_about_a_path_they_do_not_blur_it() -> None:
    path = np.zeros((50, 3))
    path[:, 2] = np.linspace(0, 50, 50)
    off = path + 0.3 * np.random.default_rng(0).normal(size=path.shape)
    assert turn_bound_rad(off, path) == np.inf
    assert turn_bound_rad(off, path, about_path=False) < 0.18
    assert turn_bound_rad(path, path) == 0
