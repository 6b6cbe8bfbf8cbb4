"""Mistakes in reading poses that leave a method's figures are said by `evaluate`, and a method's own errors are not."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.se3 import inverse
from scopemap.evaluation.clock import read_later
from scopemap.evaluation.doubts import doubts, evaluate_poses
from scopemap.evaluation.poses import match
from scopemap.input.trajectory.trajectory import Trajectory, write_tum
from scopemap.result.trajectories import read_trajectory
from tests.support.front_door import call
from tests.support.sample_trajectories import as_trajectory, random_pair, vector_a, write_c3vd, write_run
from tests.support.winding_path import seen, straight, winding

ESTIMATED, TRUTH = (as_trajectory(poses) for poses in vector_a())
"""A path and a noisy estimate of it in another world and scale."""


def numbered_from_1(truth: Trajectory) -> Trajectory:
    return replace(truth, indices=truth.indices + 1)


def one_frame_late(truth: Trajectory) -> Trajectory:
    return replace(truth, times_s=truth.times_s + 1 / 30, has_indices=False)


def inverted(truth: Trajectory) -> Trajectory:
    return replace(truth, T_world_camera=inverse(truth.T_world_camera))


def scalar_first(truth: Trajectory) -> Trajectory:
    xyzw = Rotation.from_matrix(truth.T_world_camera[:, :3, :3]).as_quat()
    T = truth.T_world_camera.copy()
    T[:, :3, :3] = Rotation.from_quat(np.roll(xyzw, 1, axis=1)).as_matrix()
    return replace(truth, T_world_camera=T)


def opengl(truth: Trajectory) -> Trajectory:
    return replace(truth, T_world_camera=truth.T_world_camera @ np.diag([1.0, -1, -1, 1]))


def in_metres(truth: Trajectory) -> Trajectory:
    T = truth.T_world_camera.copy()
    T[:, :3, 3] /= 1000
    return replace(truth, T_world_camera=T)


def said(estimate: Trajectory, truth: Trajectory, align: str = "sim3") -> str:
    return "\n".join(doubts(estimate, truth, match(estimate, truth, align)))


@pytest.mark.parametrize(
    ("mistake", "sentence"),
    [
        (numbered_from_1, "the truth may be numbered from 1, .*; if so, make its numbers one lower"),
        (one_frame_late, "the truth may be one frame too late, .*; if so, give --time-offset 0.0333"),
        (inverted, "the poses of the truth may be world-to-camera, .*; if so, invert them"),
        (lambda truth: numbered_from_1(inverted(truth)), "world-to-camera and the truth may be numbered from 1"),
        (scalar_first, "positions agree .*, but rotations are 153 deg off, 0.00 deg with the scalar of the truth's"),
        (opengl, "positions agree .*all by one turn of 180 deg: one side may have OpenGL's axes"),
        (in_metres, "the fitted scale is 0.001: the trajectory may be in mm and read as m"),
    ],
)
def test_another_reading_that_agrees_far_better_is_said(
    mistake: Callable[[Trajectory], Trajectory], sentence: str
) -> None:
    assert re.search(sentence, said(TRUTH, mistake(TRUTH)))
    assert said(TRUTH, TRUTH) == ""


@pytest.mark.parametrize(
    ("mistake", "sentence"),
    [(inverted, "may be world-to-camera"), (scalar_first, "scalar of the truth's quaternions first")],
)
def test_it_is_said_of_a_methods_noisy_path_too(mistake: Callable[[Trajectory], Trajectory], sentence: str) -> None:
    assert sentence in said(ESTIMATED, mistake(TRUTH))
    assert "of the trajectory" in said(inverted(ESTIMATED), TRUTH)


@pytest.mark.parametrize("align", ["none", "origin", "se3"])
def test_units_are_questioned_without_a_fitted_scale(align: str) -> None:
    assert "the ratio of the true to the estimated path is 0.001" in said(TRUTH, in_metres(TRUTH), align)
    assert "the ratio of the true to the estimated path is 1000" in said(in_metres(TRUTH), TRUTH, align)


def test_a_methods_own_errors_are_not_doubted() -> None:
    assert said(ESTIMATED, TRUTH) == ""
    for seed in range(5):
        wandering, truth = (as_trajectory(poses) for poses in random_pair(seed))
        assert said(wandering, truth) == ""
    still = replace(TRUTH, T_world_camera=np.tile(np.eye(4), (60, 1, 1)))
    assert said(still, TRUTH, "origin") == ""
    for factor in (0.01, 0.1, 100):  # the scale of one camera is any
        T = TRUTH.T_world_camera.copy()
        T[:, :3, 3] *= factor
        assert said(replace(TRUTH, T_world_camera=T), TRUTH) == ""


def test_evaluate_says_it_and_applies_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_tum(tmp_path / "estimate.txt", TRUTH)
    numbers = replace(TRUTH, times_s=TRUTH.indices + 1.0)
    write_tum(tmp_path / "truth.txt", numbers)
    (tmp_path / "truth.txt").write_text((tmp_path / "truth.txt").read_text().replace("; time: s", ""))
    given = ("evaluate", write_c3vd(tmp_path / "estimate", TRUTH.T_world_camera), "--truth", tmp_path / "truth.txt")
    capfd.readouterr()
    assert call(*given, "--json") == 0
    printed = capfd.readouterr()
    figures = json.loads(printed.out)
    assert "numbered from 1" in figures["doubts"][0]
    assert f"warning: {figures['doubts'][0]}" in printed.err
    assert figures["ate_rmse_mm"] > 0.5
    assert call(*given, "--quiet") == 0
    assert capfd.readouterr().err == ""
    assert call("compare", *given[1:]) == 0
    assert f"warning: estimate: {figures['doubts'][0]}" in capfd.readouterr().err
    assert "numbered from 1" in evaluate_poses(given[1], given[3], "sim3")["doubts"][0]


def test_numbers_that_miss_each_other_by_one_are_named() -> None:
    every_tenth = TRUTH.rows(np.arange(0, 60, 10))
    with pytest.raises(AlignmentError, match="6 would match with the truth's numbers one lower"):
        match(every_tenth, numbered_from_1(every_tenth), "sim3")


def long_path(rate_hz: float = 30.0, count: int = 2400) -> Trajectory:
    """Return 80 s of a camera that turns and comes back, at some frames/s."""
    times_s = np.arange(count) / 30
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = np.column_stack([20 * np.sin(times_s / 3), 15 * np.cos(times_s / 4.1), 2 * times_s])
    turns = np.column_stack([0.3 * np.sin(times_s / 5), 0.2 * np.sin(times_s / 7), 0.1 * times_s])
    T[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    return replace(as_trajectory(T), times_s=np.arange(count) / rate_hz, has_indices=False)


def stamps_in_ms(path: Trajectory, folder: Path, form: str) -> Trajectory:
    """Return a path as read from a file whose stamps are milliseconds, which nothing says."""
    lines = [line for line in _lines_of(path, folder) if not line.startswith("#")]
    rows = [line.split(maxsplit=1) for line in lines]
    text = "".join(f"{float(stamp) * 1000:{form}} {rest}\n" for stamp, rest in rows)
    (folder / "ms.txt").write_text(text)
    return read_trajectory(folder / "ms.txt", unit="mm")


def _lines_of(path: Trajectory, folder: Path) -> list[str]:
    write_tum(folder / "s.txt", path)
    return (folder / "s.txt").read_text().splitlines()


@pytest.mark.parametrize("form", [".0f", ".3f"])
@pytest.mark.parametrize("numbered", [True, False])
def test_milliseconds_that_match_now_and_then_are_said(form: str, numbered: bool, tmp_path: Path) -> None:
    path = long_path()
    own = replace(path, has_indices=numbered)
    in_ms = stamps_in_ms(path, tmp_path, form)
    assert "the time stamps of the truth may be milliseconds" in said(own, in_ms)
    assert "the time stamps of the trajectory may be milliseconds" in said(in_ms, own)
    assert said(own, path) == ""


def test_milliseconds_that_match_nowhere_are_named(tmp_path: Path) -> None:
    path = long_path(count=60)
    for form in (".0f", ".3f"):
        with pytest.raises(AlignmentError, match="60 would match if the truth's stamps were milliseconds"):
            match(path, stamps_in_ms(path, tmp_path, form), "sim3")


@pytest.mark.parametrize("rate_hz", [24.0, 25.0, 50.0])
def test_stamps_of_another_frame_rate_are_said(rate_hz: float) -> None:
    assert "may be by another frame rate" in said(long_path(), long_path(rate_hz))
    assert said(long_path(), long_path().rows(np.arange(0, 2400, 10))) == ""  # fewer poses by the same clock


@pytest.mark.parametrize("frames", [np.arange(20, 50), np.arange(0, 60, 2)])
def test_lines_that_count_the_frames_of_a_part_are_said(frames: np.ndarray) -> None:
    part = TRUTH.rows(frames)
    lines = replace(part, indices=np.arange(len(frames)))
    assert f"may be those of the frames {frames[0]} to {frames[-1]} of the other" in said(part, lines)
    assert "the poses of the trajectory may be those of the frames" in said(lines, part)
    assert said(part, TRUTH) == ""


@pytest.mark.slow
@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize(("late_s", "count"), [(0.5, 120), (-0.5, 120), (0.25, 60), (-0.05, 60), (1.3, 400)])
def test_a_truth_by_a_late_clock_is_said(late_s: float, count: int, numbered: bool) -> None:
    estimate = replace(seen(np.arange(count) / 30 + late_s, 0.02), has_indices=numbered)
    truth = replace(winding(np.arange(count) / 30), has_indices=numbered)
    sentence = said(estimate, truth)
    found = re.search(r"clock may be ([\d.]+) s (late|early) .*; if so, give --time-offset (\S+) to scopemap", sentence)
    assert found is not None, sentence
    assert float(found[3]) == pytest.approx(late_s, abs=0.006)
    assert float(found[1]) == abs(float(found[3]))
    assert found[2] == ("late" if late_s > 0 else "early")
    # What is given already is counted.
    half = read_later(truth, late_s / 2)
    rest = "".join(doubts(estimate, half, match(estimate, half, "sim3"), read_s=late_s / 2))
    rest = re.findall(r"--time-offset (\S+)", rest)
    assert [float(one) for one in rest] == [pytest.approx(late_s, abs=0.006)] * len(rest)
    assert said(estimate, read_later(truth, late_s)) == ""


def test_a_clock_that_the_path_does_not_tell_is_not_said() -> None:
    times_s = np.arange(120) / 30
    assert said(straight(times_s + 0.5, 0.05), straight(times_s, 0.05, seed=2)) == ""
    drifting = seen(times_s, 0.5)
    drifting.T_world_camera[:, 0, 3] += 0.2 * times_s**2
    assert said(drifting, winding(times_s)) == ""


def test_evaluate_names_the_offset_and_takes_it(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    times_s = np.arange(150) / 30
    run, truth = write_run(tmp_path / "run", seen(times_s, 0.02)), winding(times_s)
    write_tum(tmp_path / "truth.tum", replace(truth, times_s=truth.times_s + 0.5))
    given = ("evaluate", run, "--truth", tmp_path / "truth.tum", "--json")
    capfd.readouterr()
    assert call(*given) == 0
    offset = re.search(r"give --time-offset (0\.\d+)", json.loads(capfd.readouterr().out)["doubts"][0])
    assert offset is not None
    assert call(*given, "--time-offset", offset[1]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert "doubts" not in figures
    assert figures["ate_rmse_mm"] < figures["ate_as_recorded_mm"] / 5
