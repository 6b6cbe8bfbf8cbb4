"""A clock offset of the truth: found where the path tells it, and said not to be told where none can be."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.se3 import rotation_angle_rad
from scopemap.evaluation.clock import PoseCurve, by_clock, clock_sentence, fitted_offset, read_later
from scopemap.evaluation.poses import match, pose_report
from tests.support.sample_trajectories import write_c3vd, write_run
from tests.support.winding_path import seen, straight, winding

TIMES_S = np.arange(120) / 30


@pytest.mark.parametrize("offset_s", [0.05, -0.05, 0.2, -0.31, 0.0])
@pytest.mark.parametrize("align", ["sim3", "se3", "none"])
def test_an_offset_is_found(offset_s: float, align: str) -> None:
    """The picture of time t shows what the truth says of t + offset."""
    estimate = seen(TIMES_S + offset_s, 0.05) if align == "sim3" else winding(TIMES_S + offset_s)
    fit = fitted_offset(estimate, winding(TIMES_S), align)  # type: ignore[arg-type]
    assert fit is not None
    assert fit.offset_s == pytest.approx(offset_s, abs=0.004)
    assert abs(fit.offset_s - offset_s) < fit.within_s < 0.05


def test_the_figures_say_that_it_was_fitted() -> None:
    estimate, truth = seen(TIMES_S + 0.05, 0.05), winding(TIMES_S)
    moved, clock = by_clock(estimate, truth, "sim3", "fit")
    report = pose_report(match(estimate, moved, "sim3"))
    assert clock["time_offset"] == "fitted"
    assert clock["ate_as_recorded_mm"] == pytest.approx(pose_report(match(estimate, truth, "sim3"))["ate_rmse_mm"])
    assert report["ate_rmse_mm"] < 0.1 < 0.4 < clock["ate_as_recorded_mm"]
    assert report["rotation_unaligned_mean_deg"] < 0.1
    assert "read 0.05" in clock_sentence(clock)
    assert "later (fitted to within 0.0" in clock_sentence(clock)
    stated = by_clock(estimate, truth, "sim3", -0.1)[1]
    assert (stated["time_offset"], stated["time_offset_s"]) == ("stated", -0.1)
    assert "0.100 s earlier (stated)" in clock_sentence(stated)
    assert by_clock(estimate, truth, "sim3", 0) == (truth, {})
    assert clock_sentence({}) == ""


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
def test_a_straight_path_of_constant_speed_tells_none(noise_mm: float) -> None:
    """A Sim(3) absorbs it, whether the noise is the estimate's or the truth's; a stop on the way tells it."""
    estimate, truth = straight(TIMES_S + 0.05, noise_mm), straight(TIMES_S, noise_mm, seed=2)
    assert fitted_offset(estimate, truth, "sim3") is None
    moved, clock = by_clock(estimate, truth, "sim3", "fit")
    assert moved is truth
    assert np.isnan(clock["time_offset_s"])
    assert "straight path of constant speed" in clock_sentence(clock)
    stop_s = np.minimum(TIMES_S, 2.0)
    fit = fitted_offset(straight(np.minimum(TIMES_S + 0.05, 2.0), noise_mm), straight(stop_s, noise_mm, 2), "sim3")
    assert fit is not None
    assert fit.offset_s == pytest.approx(0.05, abs=0.004)


def test_no_offset_is_made_of_few_frames_or_of_one_beyond_those_tried() -> None:
    assert fitted_offset(seen(TIMES_S[:30]), winding(TIMES_S[:30]), "sim3") is None
    assert fitted_offset(seen(TIMES_S + 0.8), winding(TIMES_S), "sim3") is None


def test_poses_are_read_between_their_neighbours() -> None:
    truth = winding(TIMES_S)
    later = read_later(truth, 0.5 / 30)
    assert later.indices.tolist() == list(range(119))
    exact = winding(TIMES_S[:-1] + 0.5 / 30).T_world_camera
    np.testing.assert_allclose(later.positions_mm, exact[:, :3, 3], atol=0.02)
    turned = np.swapaxes(exact[:, :3, :3], 1, 2) @ later.T_world_camera[:, :3, :3]
    assert np.degrees(rotation_angle_rad(turned)).max() < 0.05
    gap = truth.rows(np.r_[0:40, 50:120])
    assert set(range(39, 50)).isdisjoint(read_later(gap, 0.4 / 30).indices.tolist())
    with pytest.raises(AlignmentError, match="no poses then"):
        read_later(truth, 100.0)
    with pytest.raises(AlignmentError, match="1 true poses"):
        PoseCurve(truth.rows(np.array([0])))


def run(*arguments: object, code: int = 0) -> Any:
    from scopemap.apps.evaluate.command import evaluate
    from scopemap.apps.evaluate.measures import with_measures

    app = typer.Typer()
    app.command()(with_measures(evaluate, ()))
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return result


@pytest.mark.slow
def test_the_command_takes_seconds_or_fit(tmp_path: Path) -> None:
    estimate = write_run(tmp_path / "run", seen(TIMES_S + 0.05, 0.05))
    given = (estimate, "--truth", write_c3vd(tmp_path / "truth", winding(TIMES_S).T_world_camera))
    result = run(*given, "--time-offset", "fit", "--json")
    figures = json.loads(result.stdout)
    assert figures["time_offset_s"] == pytest.approx(0.05, abs=0.004)
    assert figures["ate_rmse_mm"] < figures["ate_as_recorded_mm"] / 4
    assert "the truth is read 0.05" in result.stderr
    assert "this clock offset is" in run(*given, "--time-offset", "0.05").stdout
    assert "(fitted)" in run(*given, "--time-offset", "fit", "--quiet").stdout
    for wrong in ("soon", "nan", "inf"):
        run(*given, "--time-offset", wrong, code=2)


@pytest.mark.real
def test_c3vd_recorded_poses_are_ahead_of_the_pictures(real_data: Path) -> None:
    """By the pictures alone: motion between them ends two frames after the recorded camera's has."""
    import cv2

    from scopemap.result.reference import read_reference

    folder = real_data / "endoscopy" / "c3vd" / "trans_t2_a"
    truth = read_reference(folder)
    assert truth is not None
    speed = np.linalg.norm(np.diff(truth.positions_mm, axis=0), axis=1)
    files = [str(folder / f"{number}_color.jpg") for number in range(60, 80)]
    greys = [np.asarray(cv2.imread(file, cv2.IMREAD_GRAYSCALE))[::4, ::4] for file in files]
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    empty = np.zeros((*greys[0].shape, 2), np.float32)
    moved = [np.median(np.linalg.norm(flow.calc(a, b, empty.copy()), axis=-1)) for a, b in pairwise(greys)]
    ends = [60 + int(np.argmax(np.asarray(values) < 0.5 * np.median(values[:5]))) for values in (speed[60:79], moved)]
    assert ends[1] - ends[0] == 2
