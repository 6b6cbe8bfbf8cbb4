"""A quick look at an input: what it is, the options that it advises, the command that they make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.apps.browser import command, looking
from scopemap.apps.browser.input_page import words_of
from scopemap.apps.browser.looking import LeftEarlier, Look, in_words, look, measured_rates, time_in_words
from scopemap.apps.browser.run_choice import RunChoice
from scopemap.engine.errors import SettingsError
from tests.support.drawn_clips import tissue
from tests.support.drawn_videos import beside, encode, woven

pytestmark = pytest.mark.slow

DEMO = Path(command.__file__).parents[1] / "demo" / "clip"


def looked(file: Path) -> Look:
    return look(file, lambda done, all_: None)


def test_two_views_are_set(tmp_path: Path) -> None:
    found = looked(encode(tmp_path / "stereo.mp4", [beside(number) for number in range(12)]))
    assert found.suggested.stereo == "left-right"
    assert found.suggested.scope == "laparoscope"
    assert found.suggested.arguments() == ["--scope=laparoscope", "--stereo=left-right"]
    assert "it is set below" in words_of(found)


def test_two_fields_need_no_option(tmp_path: Path) -> None:
    found = looked(encode(tmp_path / "woven.mp4", [woven(2 * number) for number in range(12)]))
    assert found.suggested.arguments() == []
    assert "runs use one field" in words_of(found)


def test_frames_without_tissue_at_the_ends_are_left_out(tmp_path: Path) -> None:
    black = np.zeros_like(tissue(0))
    pictures = [black] * 6 + [tissue(number) for number in range(20)] + [black] * 4
    found = looked(encode(tmp_path / "dark.mp4", pictures))
    assert found.suggested.frames == "6:26"
    assert found.used(found.suggested) == 20
    assert found.used(RunChoice()) == 30
    assert found.used(RunChoice(fps=5)) == 6
    assert looked(encode(tmp_path / "mostly.mp4", [black] * 20 + [tissue(n) for n in range(8)])).suggested.frames == ""


def test_burned_in_text_is_blackened(tmp_path: Path) -> None:
    pictures = []
    for number in range(40):
        picture = np.zeros((160, 240, 3), np.uint8)
        picture[:, 80:] = tissue(number)[:160, :160]
        picture[20:30, 8:60:4] = 255  # what looks like letters, in the black beside the field of view
        pictures.append(picture)
    found = looked(encode(tmp_path / "text.mp4", pictures))
    outside = [one for one in found.spread.overlays if not one.in_field]
    assert outside
    covered = np.zeros((160, 240), bool)
    for x, y, width, height in found.suggested.redact:
        covered[y : y + height, x : x + width] = True
    assert covered[20:30, 8:60].mean() > 0.9
    assert not covered[:, 100:].any()
    assert any(argument.startswith("--redact=") for argument in found.suggested.arguments())


def test_a_calibration_beside_the_video_is_taken(tmp_path: Path) -> None:
    video = tmp_path / "colon.mp4"
    video.write_bytes((DEMO / "colon.mp4").read_bytes())
    (tmp_path / "notes.txt").write_text("patient 12")
    (tmp_path / "camera.yaml").write_bytes((DEMO / "camera.yaml").read_bytes())
    assert looked(video).suggested.camera == tmp_path / "camera.yaml"
    (tmp_path / "other_camera.yaml").write_bytes((DEMO / "camera.yaml").read_bytes())
    found = looked(video)
    assert found.suggested.camera is None
    assert found.calibrations == (tmp_path / "camera.yaml", tmp_path / "other_camera.yaml")
    assert found.refused == ()


def test_a_file_named_like_a_camera_is_listed_where_it_holds_none(tmp_path: Path) -> None:
    video = tmp_path / "colon.mp4"
    video.write_bytes((DEMO / "colon.mp4").read_bytes())
    (tmp_path / "notes.txt").write_text("patient 12")
    (tmp_path / "camera.json").write_text("{}")
    found = looked(video)
    assert (found.calibrations, found.refused) == ((), (tmp_path / "camera.json",))
    assert found.suggested.camera is None


def test_of_a_long_video_a_part_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_MOST_WHOLE", 20), ("_MOST_DECODED", 40), ("_SPREAD", 10), ("_TOGETHER", 10)):
        monkeypatch.setattr(looking, name, value)
    file, heard = encode(tmp_path / "long.mp4", [tissue(number) for number in range(60)]), list[tuple[int, int]]()
    found = look(file, lambda done, all_: heard.append((done, all_)))
    assert found.spread.clip["position"].tolist() == list(range(0, 40, 4))
    assert found.together.clip["position"].tolist() == list(range(20, 30))
    assert found.part == "one frame in 4 of the first 37 was looked at"
    assert "(judged by frames 20 to 29)" in found.trackable
    assert "of one frame in" not in found.trackable  # motion is that of frames that follow each other
    assert found.count == 60
    assert not found.whole
    assert heard[-1] == (20, 20)
    assert [done for done, _ in heard] == sorted(done for done, _ in heard)


def test_a_look_ends_where_it_is_no_longer_wanted() -> None:
    def leave(done: int, all_: int) -> None:
        raise LeftEarlier

    with pytest.raises(LeftEarlier):
        look(DEMO / "colon.mp4", leave)


def test_a_choice_makes_the_arguments_of_a_run() -> None:
    choice = RunChoice(
        "realtime",
        "colonoscope",
        Path("/v/c d.yaml"),
        None,
        "none",
        12.5,
        "-50:",
        ((1, 2, 3, 4),),
        Path("/m"),
        5,
        80,
    )
    assert choice.checked().arguments() == [
        *("--preset=realtime", "--scope=colonoscope", "--camera=/v/c d.yaml", "--stereo=none", "--fps=12.5"),
        *("--frames=-50:", "--near-far=5:80", "--set=mask.files=/m", "--redact=1,2,3,4"),
    ]
    assert RunChoice().arguments() == []


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"scope": "--overwrite"}, "is no kind of endoscope"),
        ({"preset": "x"}, "from their lists"),
        ({"stereo": "use:/etc/passwd"}, "from their lists"),
        *(({"fov_deg": value}, "field of view, 5 to 170 degrees") for value in (0.0, 1.0, 171.0, float("nan"))),
        *(({"fps": value}, "most frames per second") for value in (0.0, -1.0, float("nan"))),
        ({"frames": "5"}, "frames are a slice"),
        ({"frames": "1:2 --overwrite"}, "frames are a slice"),
        ({"near_mm": 5.0}, "type both"),
        ({"far_mm": float("nan")}, "type both"),
        ({"near_mm": 0.0, "far_mm": 5.0}, "as numbers of mm"),
        ({"near_mm": 5.0, "far_mm": float("nan")}, "as numbers of mm"),
        ({"near_mm": 50.0, "far_mm": 5.0}, "must be nearer"),
    ],
)
def test_what_a_run_would_refuse_is_refused(wrong: dict[str, object], sentence: str) -> None:
    with pytest.raises(SettingsError, match=sentence):
        RunChoice(**wrong).checked()  # type: ignore[arg-type]


def test_times_are_said_with_what_they_rest_on(tmp_path: Path) -> None:
    assert [in_words(seconds) for seconds in (0.2, 40, 200, 9000)] == ["1 s", "40 s", "3 min", "2.5 h"]
    assert time_in_words(840, "default", []).startswith("about 60 s to 4 min (4 to 14 frames per second")
    assert time_in_words(840, "default", [4, 7, 100]) == "about 2 min (runs here made 7.0 frames per second)"
    assert "not known" in time_in_words(None, "default", [7])
    assert measured_rates([tmp_path / "none"], "default") == []
