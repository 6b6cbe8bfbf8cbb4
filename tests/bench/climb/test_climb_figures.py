"""The CLiMB protocol: a case worked out by hand, evo as referee, submaps, and the files that it reads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scopemap.cli.app import app
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import se3_exp, so3_exp
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.climb import figures as climb
from scopemap_bench.climb.figures import LEAST_FRAMES, climb_figures, climb_score
from scopemap_bench.trajectories.climb import read_climb_reference, read_submap, write_submap
from tests.support.drawn_climb import frames_of, path_of, write_foreign_run, write_reference

NAN = float("nan")
QUARTER_TURN = Similarity(10.0, so3_exp(np.array([0, 0, np.pi / 2])), np.array([5.0, -3.0, 2.0]))


def at(*positions: tuple[float, float, float], turned_deg: float = 0.0) -> np.ndarray:
    """Poses at these positions, each turned about its x axis by `turned_deg` more than the one before."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    poses[:, :3, :3] = [so3_exp(np.array([np.radians(turned_deg * k), 0, 0])) for k in range(len(positions))]
    return poses


def by_hand() -> tuple[np.ndarray, np.ndarray]:
    """A cross whose arms are 3 and 1 mm long, and its estimate, whose arms are 2 mm.

    No rotation fits better than none, and the best scale is sum p.q / sum p.p = (6 + 6 + 2 + 2) / 16 = 1: every
    position is 1 mm off, by (-1, 0), (0, 1), (1, 0), (0, -1). From frame to frame these change by (1, 1), (1, -1) and
    (-1, -1): sqrt 2 mm each.
    """
    true = at((3, 0, 0), (0, 1, 0), (-3, 0, 0), (0, -1, 0))
    return at((2, 0, 0), (0, 2, 0), (-2, 0, 0), (0, -2, 0)), true


def evaluated(run: Path, truth: Path) -> dict[str, float]:
    done = CliRunner().invoke(app, ["evaluate", str(run), "--truth", str(truth), "--protocol", "climb", "--json"])
    assert done.exit_code == 0, (done.output, done.exception)
    return json.loads(done.stdout)["climb"]


def test_a_case_worked_out_by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(climb, "LEAST_FRAMES", 4)
    estimate, true = by_hand()
    # Frames 5 to 14 as they are, but turned by 2 degrees more from frame to frame.
    rest = at(*((k, k % 3, k * k / 10) for k in range(10)))
    turned = at(*((k, k % 3, k * k / 10) for k in range(10)), turned_deg=2.0)
    truth = write_reference(tmp_path / "truth", np.concatenate([true, rest, at(*((9, 9, k) for k in range(6)))]))
    first = (QUARTER_TURN.transform_poses(estimate), [1, 2, 3, 4])
    # It has frames 1 and 4, too, far off: they are the first submap's.
    second = (np.concatenate([at((70, 0, 0), (0, 0, 70)), turned]), [1, 4, *range(5, 15)])
    third = (at((0, 0, 0), (0, 1, 0), (2, 0, 0)), [15, 16, 17])
    figures = evaluated(write_foreign_run(tmp_path / "run", first, second, third), truth)
    # Submaps of 4 and 10 frames; 14 of the reference's 20 frames; a third submap is too short.
    expected = {
        "climb_ate_mean_mm": (4 * 1 + 10 * 0) / 14,
        "climb_ate_median_mm": 4 / 14,
        "climb_ate_std_mm": 0.0,
        "climb_rpe_1_mean_deg": (4 * 0 + 10 * 2) / 14,
        "climb_tfr_percent": 70.0,
        "climb_submaps": 2,
        "climb_matched_poses": 14,
        "climb_reference_poses": 20,
    }
    assert {name: figures[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    assert figures["climb_rpe_40_mean_mm"] is None
    alone = evaluated(write_foreign_run(tmp_path / "alone", first), truth)
    assert alone["climb_rpe_1_mean_mm"] == pytest.approx(np.sqrt(2), abs=1e-6)
    assert alone["climb_tfr_percent"] == pytest.approx(20)


@pytest.mark.parametrize(
    ("ate_mm", "rpe_deg", "tfr_percent", "duration_share", "by_hand"),
    [
        (4.0, 2.0, 100.0, 0.7, (4.0, 2.0)),
        (4.0, 2.0, 80.0, 1.5, (4.0 * 1.1 * 1.25, 2.0 * 1.1 * 1.25)),
        (8.0, 5.0, 60.0, 3.0, (8.0 * 1.2 * 1.5, 5.0 * 1.2 * 1.5)),
        (1.0, 1.0, 50.0, 0.5, (56.25, 45.0)),
        (NAN, NAN, 0.0, 1.0, (56.25, 45.0)),
        # An ATE that is no number fails the clip; a rotation error counts 20 degrees, an unknown time the full W_t.
        (NAN, 2.0, 100.0, 0.5, (56.25, 45.0)),
        (float("inf"), 2.0, 100.0, 0.5, (56.25, 45.0)),
        (4.0, NAN, 80.0, 0.5, (4.0 * 1.1, 20.0 * 1.1)),
        (4.0, 2.0, 80.0, NAN, (4.0 * 1.1 * 1.5, 2.0 * 1.1 * 1.5)),
    ],
)
def test_the_scores_are_those_made_by_hand(
    ate_mm: float, rpe_deg: float, tfr_percent: float, duration_share: float, by_hand: tuple[float, float]
) -> None:
    score = climb_score(ate_mm, rpe_deg, tfr_percent, duration_share)
    assert (score.ate, score.rotation) == pytest.approx(by_hand)


@pytest.mark.slow
def test_a_run_that_says_how_long_it_took_has_a_score(tmp_path: Path) -> None:
    true = path_of(300)
    truth = write_reference(tmp_path / "truth", true)
    run = write_foreign_run(tmp_path / "run", (true, [*range(1, 301)]))
    assert "climb_score" not in evaluated(run, truth)
    # 300 frames of 50 a second took half as long again; the path is exact, so the score is 0 whatever the time.
    (run / "runtime.txt").write_text("init_seconds=1.0\nprocessing_seconds=9.0\n")
    assert evaluated(run, truth)["climb_score"] == pytest.approx(0, abs=1e-6)
    noisy = true.copy()
    noisy[:, :3, 3] += np.random.default_rng(0).normal(size=(300, 3))
    other = write_foreign_run(tmp_path / "noisy", (noisy, [*range(1, 301)]))
    (other / "runtime.txt").write_text("init_seconds=1.0\nprocessing_seconds=9.0\n")
    figures = evaluated(other, truth)
    assert figures["climb_score"] == pytest.approx(1.25 * figures["climb_ate_mean_mm"], rel=0.01)
    assert figures["climb_rotation_score"] == pytest.approx(1.25 * figures["climb_rpe_40_mean_deg"], rel=0.01, abs=1e-9)
    # Frames that are lost at the end belong to the clip: it is as long.
    part = write_foreign_run(tmp_path / "part", (noisy[:270], [*range(1, 271)]))
    (part / "runtime.txt").write_text("preprocessing_seconds=99\ninit_seconds=1.0\nprocessing_seconds = 6.0\n")
    figures = evaluated(part, truth)
    assert figures["climb_score"] == pytest.approx(1.05 * figures["climb_ate_mean_mm"], rel=0.01)


def test_evo_agrees(tmp_path: Path) -> None:
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    true = path_of(700)
    noise = np.stack([se3_exp(twist) for twist in np.random.default_rng(1).normal(0, [0.01] * 3 + [0.3] * 3, (700, 6))])
    parts = [(0, 300), (300, 700)]
    worlds = (QUARTER_TURN, Similarity(0.2, so3_exp(np.array([1, 0, 2.0])), np.ones(3)))
    submaps = [
        frames_of(world.transform_poses(true[slice(*part)] @ noise[slice(*part)]), part[0])
        for world, part in zip(worlds, parts, strict=True)
    ]
    figures = climb_figures(replace(submaps[0], others=(submaps[1],)), frames_of(true))
    theirs: dict[str, list[float]] = {}
    for submap, part in zip(submaps, parts, strict=True):
        paths = (submap.T_world_camera, true[slice(*part)])
        estimated, reference = (PosePath3D(poses_se3=list(poses.copy())) for poses in paths)
        estimated.align(reference, correct_scale=True)
        relation = metrics.PoseRelation
        measures = {"ate": metrics.APE(relation.translation_part)}
        for step in (1, 10, 20, 40):
            for unit, kind in (("mm", relation.translation_part), ("deg", relation.rotation_angle_deg)):
                measures[f"rpe_{step}_mean_{unit}"] = metrics.RPE(kind, step, metrics.Unit.frames, all_pairs=True)
        for name, measure in measures.items():
            measure.process_data((reference, estimated))
            statistics = measure.get_all_statistics()
            if name == "ate":
                for key in ("mean", "median", "std"):
                    theirs.setdefault(f"ate_{key}_mm", []).append(statistics[key])
            else:
                theirs.setdefault(name, []).append(statistics["mean"])
    means = {name: np.average(values, weights=[300, 400]) for name, values in theirs.items()}
    assert {name: figures[name] for name in means} == pytest.approx(means, rel=1e-6)
    assert figures["tfr_percent"] == 100


def test_submaps_count_with_enough_frames_that_are_their_own() -> None:
    true = path_of(3 * LEAST_FRAMES)
    whole, half = frames_of(true[:LEAST_FRAMES]), frames_of(true[: LEAST_FRAMES - 1])
    assert climb_figures(whole, frames_of(true))["submaps"] == 1
    dropped = climb_figures(half, frames_of(true))
    assert (dropped["submaps"], dropped["tfr_percent"]) == (0, 0)
    assert np.isnan(dropped["ate_mean_mm"])
    # A dropped submap takes no frame from the next; a frame of two submaps is the first one's.
    assert climb_figures(replace(half, others=(whole,)), frames_of(true))["matched_poses"] == LEAST_FRAMES
    beyond = frames_of(true[1 : LEAST_FRAMES + 1], 1)
    assert climb_figures(replace(whole, others=(beyond,)), frames_of(true))["submaps"] == 1
    lost = replace(whole, status=np.where(whole.indices == 7, "lost", whole.status))
    assert climb_figures(lost, frames_of(true))["submaps"] == 0


@pytest.mark.parametrize("entry", [(0, 0), (0, 3), (2, 2), (slice(None), slice(None))])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("whose", ["estimate", "reference"])
def test_a_frame_whose_pose_is_not_finite_is_lost(
    entry: tuple[int | slice, int | slice], value: float, whose: str
) -> None:
    true = path_of(LEAST_FRAMES + 20)
    broken = frames_of(true.copy())
    broken.T_world_camera[7][entry] = value
    lost = replace(frames_of(true), status=np.where(np.arange(len(true)) == 7, "lost", "ok"))
    pairs = [(one, frames_of(true)) if whose == "estimate" else (frames_of(true), one) for one in (broken, lost)]
    found, expected = (climb_figures(*pair) for pair in pairs)
    assert found == expected
    assert np.isfinite(list(found.values())).all()
    assert found["matched_poses"] == LEAST_FRAMES + 19


# ---- files


def test_a_reference_is_in_mm_and_counts_from_1(tmp_path: Path) -> None:
    true = path_of(5)
    found = read_trajectory(write_reference(tmp_path, true, scale=3.0))
    np.testing.assert_allclose(found.T_world_camera, true, atol=1e-9)
    assert found.indices.tolist() == [0, 1, 2, 3, 4]
    assert "mm by scales.csv" in found.source
    unscaled = read_climb_reference(write_reference(tmp_path / "other", true, clip="Seq_002", scale=None))
    np.testing.assert_allclose(unscaled.T_world_camera, true, atol=1e-9)
    assert "scale unknown" in unscaled.source


HEAD = "sequence,scale_to_target\nSeq_001_a,"


@pytest.mark.parametrize("text", ["a,b\n1,2\n", f"{HEAD}big\n", f"{HEAD}nan\n", f"{HEAD}-1\n", f"{HEAD}0\n"])
def test_scales_that_are_none_are_refused(text: str, tmp_path: Path) -> None:
    folder = write_reference(tmp_path, path_of(5))
    (tmp_path / "scales.csv").write_text(text)
    with pytest.raises(InputError, match=r"scales\.csv: every row needs sequence and scale_to_target"):
        read_climb_reference(folder)


def test_a_scale_that_no_length_has_is_refused(tmp_path: Path) -> None:
    folder = write_reference(tmp_path, path_of(5))
    (tmp_path / "scales.csv").write_text(f"{HEAD}1e308\n")
    with pytest.raises(InputError, match=r"image \d: a position of .* mm is none of a camera"):
        read_climb_reference(folder)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    poses = path_of(6)
    written = replace(frames_of(poses, 3), status=np.array(["initial", "ok", "lost", "ok", "ok", "ok"]))
    write_submap(tmp_path / "submap.txt", written)
    lines = (tmp_path / "submap.txt").read_text().splitlines()
    assert lines[0] == "# timestamp, name_image, tx, ty, tz, qw, qx, qy, qz"
    assert lines[1].startswith("0.000000,000004.png,0.000000000,0.000000000,0.000000000,1.000000000,")
    found = read_submap(tmp_path / "submap.txt")
    assert found.indices.tolist() == [3, 4, 6, 7, 8]
    np.testing.assert_allclose(found.T_world_camera, poses[[0, 1, 3, 4, 5]], atol=1e-8)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0,000001.png,0,0,0,1,0,0", "line 2: found 8 fields, expected 9"),
        ("0 000001.png 0 0 0 1 0 0 0", "line 2: found 1 fields"),
        ("0,000000.png,0,0,0,1,0,0,0", "'000000.png' must begin with its only number, the frame's, from 1"),
        ("0,image.png,0,0,0,1,0,0,0", "'image.png' must begin"),
        ("0,1_v2.png,0,0,0,1,0,0,0", "'1_v2.png' must begin"),
        ("0,000002.png,a,0,0,1,0,0,0", "line 2: expected numbers"),
        ("0,000002.png,0,0,0,nan,0,0,0", "it holds no pose"),
        ("0,000002.png,0,0,0,1,1,0,0", "line 2: the quaternion has length 1.41"),
        ("0,000002.png,0,0,0,1,0,0,0\n1,2.png,0,0,0,1,0,0,0", "line 3: frame 2 is repeated"),
        ("0,000002.png,nan,0,0,1,0,0,0", "it holds no pose"),
        ("0,000002.png,1e308,0,0,1,0,0,0", r"line 2: a position of 1e\+308 mm is none of a camera"),
        ("0,000002.png,0,0,-1e200,1,0,0,0", r"line 2: a position of 1e\+200 mm"),
    ],
)
def test_rows_that_cannot_be_scored_are_refused(row: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "submap.txt").write_text(f"# header\n{row}\n")
    with pytest.raises(InputError, match=message):
        read_submap(tmp_path / "submap.txt")
