"""`scopemap inspect`: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from tests.support.drawn_clips import clip, inset, text, write
from tests.support.front_door import call

pytestmark = pytest.mark.slow

Say = Callable[..., tuple[int, str, str]]


@pytest.fixture
def say(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Say:
    """The command `scopemap inspect` in an empty folder: exit code, stdout, stderr."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def said(*arguments: object) -> tuple[int, str, str]:
        code, printed = call("inspect", *arguments), capfd.readouterr()
        return code, printed.out, printed.err

    return said


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("video") / "my [clip].mp4", clip(36, text(), inset))


def test_it_says_what_it_found_and_draws_it(say: Say, video: Path) -> None:
    code, out, err = say(video, "--out", "seen.png")
    assert (code, err) == (0, "inspected 36 of 36 frames\n")
    assert out.startswith(f"{video}\n")
    for words in ("mpeg4", "picture in picture", "advice: overlay: runs leave them out", "--set", "\nforecast: good"):
        assert words in out
    picture = cv2.imread("seen.png")
    assert picture is not None
    # Overlays are boxed in yellow, insets in magenta, what a run leaves out is tinted blue.
    blue, green, red = (picture[..., channel].astype(int) for channel in range(3))
    for colour in ((red > 200) & (green > 200) & (blue < 60), (red > 200) & (green < 60) & (blue > 200)):
        assert colour.sum() > 100
    assert ((blue > 140) & (red < 120)).sum() > 500


def test_it_writes_nothing_unasked(say: Say, video: Path) -> None:
    for _ in range(2):  # what was there refused the second call
        code, out, _ = say(video)
        assert code == 0
        assert out.endswith("picture: none; --out FILE.png draws the findings\n")
    assert json.loads(say(video, "--json", "--frames", ":2")[1])["picture"] is None
    assert list(Path().iterdir()) == []


def test_json_is_all_that_is_printed_and_a_part_counts_as_the_whole_does(say: Say, video: Path, tmp_path: Path) -> None:
    file, masks = tmp_path / "new" / "seen.PNG", tmp_path / "masks"
    code, out, err = say(video, "--json", "--frames", "2:36", "--out", file, "--masks", masks)
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert list(found) == ["path", "facts", "forecast", "findings", "field", "overlays", "insets", "picture"]
    facts = found["facts"]
    assert (facts["pictures"], facts["width"], facts["field"]) == (34, 320, "full")
    assert facts["usual_rate_hz"] == pytest.approx(25)
    assert facts["span_s"] == pytest.approx(33 / 25)
    assert [finding["code"] for finding in found["findings"]] == ["overlay", "inset", "overlay-privacy"]
    assert found["findings"][0].keys() == {"severity", "code", "message", "advice", "segments"}
    assert len(found["overlays"]) == len(found["insets"]) == 1
    assert file.is_file()
    assert [mask.name for mask in masks.iterdir()] == ["mask.png"]


def test_nothing_is_replaced_unasked_and_what_cannot_be_written_is_refused(
    say: Say, video: Path, tmp_path: Path
) -> None:
    file = tmp_path / "mine.png"
    file.write_bytes(b"mine")
    code, out, err = say(video, "--out", file)
    assert (code, out, err) == (1, "", f"scopemap: {file} exists; give another name with --out, or --overwrite\n")
    assert file.read_bytes() == b"mine"
    assert say(video, "--out", file, "--overwrite", "--quiet") == (0, "", "")
    assert cv2.imread(str(file)) is not None
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    assert "is not empty" in say(video, "--masks", tmp_path / "full")[2]
    assert "holds other files" in say(video, "--masks", tmp_path / "full", "--overwrite")[2]
    (tmp_path / "folder.png").mkdir()
    for name, why in (("picture.jpg", "must end in .png"), ("folder.png", "a folder"), ("mine.png/a.png", "a file")):
        code, out, err = say(video, "--out", tmp_path / name, "--quiet")
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert why in err
