"""The table of verdicts: its cases, the error of a surface, what is counted."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Truth
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.input.camera_files.writing import write_calibration
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.evaluation.partial_truth import drift, pairs_in_order
from scopemap_bench.scripts import measuring, verdicts
from scopemap_bench.scripts.verdict_cases import Case, Known, other_cases, phantom_cases, real_cases
from scopemap_bench.scripts.verdicts import Outcome
from tests.support.drawn_run import CAMERA, FRAMES, draw_run, pose_of, tube


class True_:
    """The truth of the drawn run, as seen by a lens that may be another than the run's."""

    def __init__(self, camera: PinholeCamera) -> None:
        self.camera = camera
        self.source = SimpleNamespace(camera=camera)

    def __iter__(self) -> Iterator[tuple[SimpleNamespace, Truth]]:
        for index in range(FRAMES):
            depth_mm = render_mesh(tube(), CAMERA, pose_of(index)).depth_mm
            yield SimpleNamespace(index=index), Truth(index, pose_of(index), depth_mm)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = draw_run(tmp_path_factory.mktemp("verdicts") / "run", pictures=False)
    write_calibration(CAMERA, folder / "source_camera.yaml")
    return folder


@pytest.mark.parametrize(
    ("camera", "scale", "error"),
    [
        (CAMERA, 1.0, (0.0, 0.002)),
        (CAMERA, 1.1, (0.095, 0.105)),
        (CAMERA, None, (0.0, 0.002)),
        (replace(CAMERA, fx=72.0, fy=72.0), 1.0, (0.03, 0.2)),
        (replace(CAMERA, cx=CAMERA.cx + 3), 1.0, (0.002, 0.05)),  # a tilt of 3 degrees alone would be 0.05
    ],
)
def test_the_error_of_a_surface(
    run: Path, monkeypatch: pytest.MonkeyPatch, camera: PinholeCamera, scale: float | None, error: tuple[float, float]
) -> None:
    monkeypatch.setattr(verdicts, "open_sequence", lambda _: True_(camera))
    found = verdicts.surface_error(run, Path(), scale)
    assert error[0] <= found < error[1]


def test_cases_are_many_and_of_different_names() -> None:
    cases = phantom_cases()
    assert len({case.name for case in cases}) == len(cases) >= 75
    # Changed runs read the phantom of the unchanged one.
    drawn = {case.name: case.source for case in cases}
    assert all(drawn["-".join(case.name.split("-")[:2])] == case.source for case in cases)


def test_what_fails_is_no_result_and_each_kind_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> Path:
        raise subprocess.CalledProcessError(3, "scopemap")

    monkeypatch.setattr(measuring, "run_once", fail)
    failed = verdicts.outcome(Case("a", "fails", tmp_path), tmp_path)
    assert failed.word == "no result"
    case = Case("b", "bent", tmp_path)
    found = [
        failed,
        Outcome(case, "good", 0.01, 0.02),
        Outcome(case, "good", 0.01, 0.06),
        Outcome(case, "doubtful", 0, 0),
    ]
    verdicts.print_table(found)
    printed = capsys.readouterr().out
    assert "| a | 1 | 0 | 0 | 0 | 1 |\n| b | 3 | 1 | 1 | 1 | 0 |\n| all | 4 | 1 | 1 | 1 | 1 |" in printed
    assert "Good 50% are right" in printed
    assert "wrong ones 50% are" in printed
    assert "right ones 50% are called Good" in printed
    assert printed.count("| bent |") == 2
    assert "| bent | good | 1.0% | 6.0% |  |  |" in printed


def test_a_result_is_judged_by_what_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    case, nothing = Case("a", "b", Path()), float("nan")
    assert Outcome(case, "good", 0.01, nothing).kind == (True, True)
    assert Outcome(case, "good", 0.04, nothing).kind == (True, False)
    assert Outcome(case, "doubtful", nothing, 0.06).kind == (False, False)
    # Pairs in order make nothing right; out of order they make it wrong.
    assert Outcome(case, "good", nothing, nothing, pairs=1.0).kind is None
    assert Outcome(case, "good", nothing, nothing, pairs=0.8).kind == (True, False)
    verdicts.print_table([Outcome(case, "good", nothing, nothing, pairs=1.0)])
    printed = capsys.readouterr().out
    assert "| all | 1 | 0 | 0 | 0 | 0 |" in printed
    assert "Good none are right" in printed
    assert "| b |" not in printed


def test_the_truth_is_read_by_its_clock_and_a_camera_at_rest_by_its_drift(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = read_trajectory(run)
    monkeypatch.setattr(verdicts, "read_reference", lambda _: truth)
    error, scale = verdicts.path_error(run, Case("a", "b", tmp_path), tmp_path)
    assert (error, scale) == pytest.approx((0.0, 1.0), abs=1e-6)
    later, _ = verdicts.path_error(run, Case("a", "b", tmp_path, (), Known(clock_s=0.4 / 30)), tmp_path)
    assert later != error
    still, none = verdicts.path_error(run, Case("a", "b", tmp_path, (), Known(path=False, at_rest=True)), tmp_path)
    assert still > 0.03
    assert none is None
    unknown, _ = verdicts.path_error(run, Case("a", "b", tmp_path, (), Known(path=False)), tmp_path)
    assert np.isnan(unknown)


def test_a_part_of_the_table_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(verdicts, "outcome", lambda case, _: Outcome(case, "good", 0.0, 0.0))
    words = ["verdicts", "--out", str(tmp_path), "--only", "colon-31-focal?5", "tube*"]
    monkeypatch.setattr("sys.argv", words)
    verdicts.main()
    printed = capsys.readouterr()
    assert "| all | 4 | 4 | 0 | 0 | 0 |" in printed.out
    assert "| colon-31-focal-5 | good | 0.0% | 0.0% |  |  |" in printed.err


def test_pairs_of_pixels_in_order(run: Path, tmp_path: Path) -> None:
    folder, file = Result(run), tmp_path / "pairs.csv"
    depth_mm = folder.depth.read(0)
    assert depth_mm is not None
    height, width = depth_mm.shape
    inner = np.where(np.isfinite(depth_mm), depth_mm, np.nan)
    places = [np.unravel_index(choose(inner), inner.shape) for choose in (np.nanargmin, np.nanargmax)]
    near, far = (f"{(x + 0.5) / width},{(y + 0.5) / height}" for y, x in places)
    file.write_text(f"frame,x_near,y_near,x_far,y_far\n0,{near},{far}\n0,{far},{near}\n999,{near},{far}\n")
    assert pairs_in_order(folder, file) == (1, 3)
    assert 0 < drift(folder) < 10


@pytest.mark.real
def test_real_cases_are_there(real_data: Path, tmp_path: Path) -> None:
    cases = [*phantom_cases(), *real_cases(real_data, tmp_path)]
    assert len({case.name for case in cases}) == len(cases) >= 90
    files = [case.source for case in other_cases(real_data)] + [case.known.pairs for case in other_cases(real_data)]
    assert all(file.exists() for file in files if isinstance(file, Path))
