"""The table of verdicts: its cases, the error of a surface, what is counted."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from drawn_run import CAMERA, FRAMES, draw_run, pose_of, tube

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.frame import Truth
from scopemap.geometry.rendering import render_mesh
from scopemap_bench.scripts import measuring, verdicts
from scopemap_bench.scripts.verdicts import Case, Outcome


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
        (replace(CAMERA, fx=72.0, fy=72.0), 1.0, (0.03, 0.2)),
        (replace(CAMERA, cx=CAMERA.cx + 3), 1.0, (0.002, 0.05)),  # a tilt of 3 degrees alone would be 0.05
    ],
)
def test_the_error_of_a_surface(
    run: Path, monkeypatch: pytest.MonkeyPatch, camera: PinholeCamera, scale: float, error: tuple[float, float]
) -> None:
    monkeypatch.setattr(verdicts, "open_sequence", lambda _: True_(camera))
    found = verdicts.surface_error(run, Path(), scale)
    assert error[0] <= found < error[1]


def test_cases_are_many_and_of_different_names() -> None:
    cases = verdicts.phantom_cases()
    assert len({case.name for case in cases}) == len(cases) >= 60
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
    assert printed.count("| bent |") == 2
    assert "| bent | good | 1.0% | 6.0% |  |" in printed
