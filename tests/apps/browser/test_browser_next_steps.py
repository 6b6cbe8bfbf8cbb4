"""Next steps of a verdict as runs: which options they name, and the arguments that repeat the run with one more."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap.apps.browser.next_steps import NextRun, arguments_again, next_runs, source_of
from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.runs import BrowserRun
from scopemap.apps.browser.workspace import Workspace
from scopemap.apps.run.command import run as run_command
from scopemap.engine.config.config import Config
from scopemap.input.opening import open_sequence
from scopemap.report.plain_step import plain_step
from scopemap.result.result import Result
from scopemap.result.wording import STILL_PART, WORDINGS
from tests.support.drawn_run import CAMERA, changed, draw_run, drawn_result
from tests.support.front_door import call
from tests.support.shown_window import shown_window

# Options that need a file, a box or a choice that nobody can make for the user.
NOT_OFFERED = {"camera", "redact", "memory", "frames"}
FACTS = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def result_by(origin: str, **settings: Any) -> Result:
    """A result in memory whose camera is known in a way."""
    result = drawn_result(camera=FACTS | {"source": origin, "origin": origin})
    return changed(result, config=Config.load(settings=settings), source_camera=CAMERA)


def test_every_next_step_that_names_an_option_is_offered() -> None:
    known = {name.replace("_", "-") for name in inspect.signature(run_command).parameters} | {"set"}
    for code, wording in WORDINGS.items():
        named = set(re.findall(r"--([a-z][a-z-]+)", wording.next_step))
        assert named <= known, code
        assert {run.option for run in next_runs(wording.next_step, result_by("assumed"))} == named - NOT_OFFERED, code


def test_choices_and_values() -> None:
    result = result_by("assumed")
    assert next_runs("Run again with --scope laparoscope.", result) == [NextRun("scope", ("laparoscope",))]
    assert next_runs("Try --scope sinus|capsule.", result) == [NextRun("scope", ("sinus", "capsule"))]
    (scopes,) = next_runs("Run again with --scope.", result)
    assert "colonoscope" in scopes.choices
    (one,) = next_runs("Run again with --set mapping.method=local.", result)
    assert one.label(*one.choices) == "Run again with mapping.method=local"
    assert one.arguments(*one.choices) == ["--set", "mapping.method=local"]
    assert next_runs("Look at the 2 submaps in maps/.", result) == next_runs("", result) == []


def test_a_step_in_plain_words_names_no_option() -> None:
    steps = {wording.next_step: plain_step(wording.next_step) for wording in WORDINGS.values()}
    for step, plain in steps.items():
        assert "--" not in plain
        assert (step == plain) == ("--" not in step and ".csv" not in step)
        assert not plain or plain.endswith(".")
    assert plain_step("Calibrate (--camera), or run again with --fov or --scope.") == "Calibrate."
    assert plain_step(STILL_PART) == "Reconstruct a part in which it holds still."
    assert plain_step("See surfaces/segments.csv.") == plain_step("See frames.csv for their names.") == ""
    assert plain_step("Run again with --set mapping.method=local.") == ""


def test_a_calibrated_lens_is_not_guessed_again() -> None:
    assert next_runs("Check the calibration (--camera, --fov or --scope).", result_by("calibrated")) == []


def test_the_run_is_repeated_with_what_its_settings_lack(tmp_path: Path) -> None:
    folder = draw_run(tmp_path / "run", camera=FACTS | {"source": "camera.yaml", "origin": "calibrated"})
    changed(drawn_result(), source_camera=CAMERA, others=[]).save(tmp_path / "kept")
    (tmp_path / "kept" / "source_camera.yaml").rename(folder / "source_camera.yaml")
    words = arguments_again(Result(folder))
    assert words[:2] == ["--config", str(folder / "config.toml")]
    assert words[words.index("--size") + 1] == "80x64"
    assert words[words.index("--dataset") + 1] == "video"
    assert words[words.index("--camera") + 1] == str(folder / "source_camera.yaml")
    assert words[words.index("--camera-fit") + 1] == "exact"
    # Another lens comes instead of this one.
    assert "--camera" not in arguments_again(Result(folder), "scope")


@pytest.mark.parametrize("origin", ["assumed", "estimated"])
def test_a_lens_that_was_not_given_is_not_given(tmp_path: Path, origin: str) -> None:
    result = result_by(origin)
    result.path = tmp_path
    assert not {"--camera", "--fov"} & set(arguments_again(result))


def test_a_stated_field_of_view_is_stated_again(tmp_path: Path) -> None:
    result = result_by("stated")
    result.path = tmp_path
    words = arguments_again(result)
    fov_deg = float(words[words.index("--fov") + 1])
    assert fov_deg == pytest.approx(2 * np.degrees(np.arctan(40 / 60)))
    assert "--fov" not in arguments_again(result, "fov")


def test_a_result_whose_input_is_gone_or_was_live_has_no_source(tmp_path: Path) -> None:
    folder, video = tmp_path / "run", tmp_path / "video.mp4"
    draw_run(folder, name=str(video))
    assert source_of(Result(folder)) is None
    video.write_bytes(b"")
    assert source_of(Result(folder)) == video
    draw_run(tmp_path / "live", name=str(video), dataset="live")
    assert source_of(Result(tmp_path / "live")) is None


def test_an_endoscope_that_was_stated_is_not_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")
    (tmp_path / "video.mp4").write_bytes(b"")
    monkeypatch.setattr(BrowserRun, "start", lambda run: None)
    camera = FACTS | {"source": "70 deg", "origin": "assumed"}
    folder = draw_run(tmp_path / "one", name=str(tmp_path / "video.mp4"), camera=camera)
    (folder / "config.toml").write_text(Config.load(settings={"input.scope": "laparoscope"}).toml(), encoding="utf-8")
    with Workspace(tmp_path) as workspace, shown_window() as shown:
        shown.show(ResultPage(folder, workspace))
        assert not [label for label in shown.labels("Dropdown") if label.startswith("Which endoscope")]
        assert shown.element("Dropdown", "Run as: laparoscope").value == "laparoscope"
        shown.press("Run again with this endoscope")
        assert "This result was run as: laparoscope. Choose another endoscope first." in shown.words
        assert not workspace.runs.runs
        shown.choose("Dropdown", "Run as: laparoscope", "cystoscope")
        shown.press("Run again with this endoscope")
        assert workspace.runs.runs[0].arguments[-2:] == ("--scope", "cystoscope")


@pytest.mark.slow
def test_the_repeated_run_has_the_same_camera_and_bytes(tmp_path: Path) -> None:
    from importlib.resources import as_file, files

    with as_file(files("scopemap.apps.demo") / "clip") as clip:
        first, camera = tmp_path / "first", clip / "camera.yaml"
        assert call("run", clip / "colon.mp4", "--out", first, "--camera", camera, "--frames", "0:14", "--quiet") == 0
        again = tmp_path / "again"
        assert call("run", clip / "colon.mp4", "--out", again, "--quiet", *arguments_again(Result(first))) == 0
        assert open_sequence(clip / "colon.mp4", camera=camera).camera == Result(again).camera
    for name in ("trajectory.tum", "mesh.ply", "frames.csv"):
        assert (first / name).read_bytes() == (again / name).read_bytes(), name
