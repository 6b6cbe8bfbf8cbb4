"""A part of an input: config.toml repeats it, and provenance, report and summary say which part it was."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from scopemap.engine.config import Config
from scopemap.engine.errors import SettingsError
from scopemap.input.opening import open_sequence
from scopemap.report.facts import report_facts
from scopemap.report.page_data import page_data
from scopemap.result.input_part import part_of_input
from scopemap.result.result import Result
from scopemap.result.verdict import verdict
from scopemap.runner.reconstruct import reconstruct
from tests.support.drawn_videos import encode
from tests.support.front_door import call
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import only_images, write_tiny

pytestmark = pytest.mark.slow

FAST = ("--preset", "realtime")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("phantom")
    images = only_images(write_tiny(folder / "sound"), folder / "images")
    pictures = [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in sorted(images.iterdir())]
    return encode(folder / "v.mp4", [pictures[number // 2 if number < 14 else 0] + number % 2 for number in range(14)])


PARTS = [("0:6", "frames 0 to 5 of 14"), ("2:12:3", "frames 2 to 11 of 14, every 3rd"), ("-6:", "frames 8 to 13 of 14")]


@pytest.mark.parametrize(("frames", "part"), PARTS)
def test_a_part_is_said_and_repeated(
    frames: str, part: str, video: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first, again = tmp_path / "first", tmp_path / "again"
    call("run", video, "--out", first, f"--frames={frames}", "--set", "input.skip_duplicates=false", *FAST)
    said = capfd.readouterr().out
    assert f"tracked ({part});" in said
    run = Result(first)
    assert run.config.input.frames == frames
    assert run.provenance["selection"] == {"frames": frames, "of": 14}
    assert page_data(report_facts(run))["used_part"] == part
    assert "used_part" in (first / "report.html").read_text(encoding="utf-8")
    assert any(f"Chosen: {part}." in reason.text for reason in verdict(run).reasons)
    call("run", video, "--out", again, "--config", first / "config.toml", "--quiet")
    assert frame_rows(again) == frame_rows(first)
    assert (again / "config.toml").read_text() == (first / "config.toml").read_text()


def test_a_part_that_python_selects_is_kept_too(video: Path, tmp_path: Path) -> None:
    result = reconstruct(open_sequence(video, frames=slice(1, 9)), "realtime", out=tmp_path / "o")
    assert result.config.input.frames == "1:9"
    assert len(open_sequence(video, settings=result.config.input).source.stamps(slice(None)) or range(8)) == 8
    assert open_sequence(video, settings=result.config.input).selection == slice(1, 9)
    assert open_sequence(video, frames="0:4", settings=result.config.input).selection == slice(0, 4)


def test_a_whole_video_is_no_part(video: Path, tmp_path: Path) -> None:
    call("run", video, "--out", tmp_path / "o", "--quiet", *FAST)
    run = Result(tmp_path / "o")
    assert (run.config.input.frames, part_of_input(run.provenance)) == ("", "")


@pytest.mark.parametrize(
    ("facts", "part"),
    [
        ({}, ""),
        ({"selection": {"frames": "", "of": 250}, "skipped": {"repeated": 7}}, ""),
        ({"selection": {"frames": "0:250", "of": 250}}, ""),
        ({"selection": {"frames": "::10", "of": 250}}, "frames 0 to 240 of 250, every 10th"),
        ({"selection": {"frames": "5:", "of": None}}, "frames 5:"),
        ({"skipped": {"thinned": 125}}, "thinned by 125 to a lower rate"),
        ({"selection": {"frames": "0:80", "of": 250}, "skipped": {"size": 2}},
         "frames 0 to 79 of 250, without 2 of another size"),
    ],
)  # fmt: skip
def test_what_was_left_out_in_words(facts: dict[str, object], part: str) -> None:
    assert part_of_input(facts) == part


@pytest.mark.parametrize("text", ["5", "a:b", "0:5:2:1", "0..5"])
def test_texts_that_are_no_slice_are_refused(text: str) -> None:
    with pytest.raises(SettingsError, match=r"input\.frames"):
        Config.load(settings={"input.frames": text})
