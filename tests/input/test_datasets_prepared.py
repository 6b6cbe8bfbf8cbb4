"""Two views or two fields in a picture, as a run reads them; and frames that are left out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import InputSettings
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.engine.notices import Notice
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.input.video_format.interlacing import LEAST_COMBING, combing
from tests.support.drawn_clips import RATE, clip, tissue, write
from tests.support.drawn_inputs import frames_of, save, write_c3vd
from tests.support.drawn_videos import HEIGHT, WIDTH, above, beside, beside_squeezed, encode, half, stereo, woven

COUNT = 12
Draw = Callable[[int], np.ndarray]


def _video(file: Path, draw: Draw) -> Path:
    return encode(file, [draw(number) for number in range(COUNT)])


def _left(number: int) -> np.ndarray:
    return stereo(number)[0]


@pytest.mark.parametrize(
    ("draw", "layout", "left", "aspect"),
    [
        (beside, "left-right", _left, 1.0),
        (above, "top-bottom", _left, 1.0),
        (beside_squeezed, "left-right", lambda number: half(_left(number), 1), 2.0),
    ],
)
def test_a_stereo_video_gives_its_left_view(draw: Draw, layout: str, left: Draw, aspect: float, tmp_path: Path) -> None:
    sequence = open_sequence(_video(tmp_path / "v.mp4", draw))
    notes = [str(note) for note in sequence.notes if str(note).startswith("stereo")]
    assert len(notes) == 1
    assert f"stereo, {layout}: the " in notes[0]
    assert "--stereo none" in notes[0]
    height, width = left(0).shape[:2]
    assert (sequence.source.width, sequence.source.height) == (width, height)
    assert sequence.source.pixel_aspect == aspect
    # Pixels that are twice as wide see with half the focal length across.
    assert sequence.camera.fy / sequence.camera.fx == pytest.approx(aspect)
    frames = list(sequence.source.frames(slice(None)))
    assert [frame.index for frame in frames] == list(range(COUNT))
    for frame in frames:
        assert np.abs(frame.rgb.astype(int) - left(frame.index)).mean() < 2


def test_what_is_said_of_stereo_overrules_what_is_found(tmp_path: Path) -> None:
    file = _video(tmp_path / "v.mp4", beside)
    whole = open_sequence(file, settings=InputSettings(stereo="none"))
    assert (whole.source.width, whole.source.height) == (2 * WIDTH, HEIGHT)
    assert not any("stereo" in str(note) for note in whole.notes)
    mono = _video(tmp_path / "m.mp4", tissue)
    upper = open_sequence(mono, settings=InputSettings(stereo="top-bottom"))
    assert (upper.source.width, upper.source.height) == (WIDTH, HEIGHT // 2)
    assert any("stereo, top-bottom: the upper half" in str(note) and "as asked" in str(note) for note in upper.notes)


def test_ordinary_videos_and_data_sets_are_left_alone(tmp_path: Path) -> None:
    ordinary = open_sequence(_video(tmp_path / "v.mp4", tissue))
    assert (ordinary.source.width, ordinary.source.height) == (WIDTH, HEIGHT)
    assert [note for note in ordinary.notes if "stereo" in str(note)] == ordinary.warnings == []
    folder = write_c3vd(tmp_path / "c3vd")
    with pytest.raises(InputError, match=r"'c3vd' defines the view; leave input\.stereo=left-right"):
        open_sequence(folder, settings=InputSettings(stereo="left-right"))
    assert open_sequence(folder, settings=InputSettings(stereo="none")).source.name == "c3vd"


def _calibration(file: Path, width: int, height: int) -> Path:
    write_calibration(PinholeCamera(0.8 * width, 0.8 * width, width / 2, height / 2, width, height), file)
    return file


def test_the_calibration_beside_stereo_images_is_that_of_one_view(tmp_path: Path) -> None:
    for number in range(4):
        save(tmp_path / f"{number}.png", above(5 * number))
    _calibration(tmp_path / "camera.yaml", WIDTH, HEIGHT)
    sequence = open_sequence(tmp_path)
    assert (sequence.calibrated, sequence.source.width, sequence.source.height) == (True, WIDTH, HEIGHT)
    assert sequence.source.stamps(slice(None)) == [(number, number / 30) for number in range(4)]
    np.testing.assert_array_equal(next(sequence.source.frames(slice(None))).rgb, stereo(0)[0])
    _calibration(tmp_path / "camera.yaml", WIDTH, 2 * HEIGHT)
    with pytest.raises(CalibrationError, match="the camera must be that of one"):
        open_sequence(tmp_path)


# ---- two fields


def test_interlaced_material_is_told_and_undone(tmp_path: Path) -> None:
    file = _video(tmp_path / "v.mp4", lambda number: woven(2 * number))
    told = open_sequence(file, settings=InputSettings(deinterlace="off"))
    assert told.warnings == [Notice("input-interlaced")]
    undone = open_sequence(file)
    assert undone.warnings == []
    assert Notice("input-deinterlaced", {"why": "the video is interlaced"}) in undone.notes
    for comb, frame in zip(told.source.frames(slice(None)), undone.source.frames(slice(None)), strict=True):
        np.testing.assert_array_equal(frame.rgb[::2], comb.rgb[::2])
        assert combing(comb.rgb) > 10 * combing(frame.rgb)


def test_interlacing_does_not_matter_where_rows_are_averaged(tmp_path: Path) -> None:
    file = _video(tmp_path / "v.mp4", lambda number: woven(2 * number))
    halved = open_sequence(file, size=(WIDTH // 2, HEIGHT // 2))
    assert halved.warnings == []
    assert Notice("input-interlaced-averaged") in halved.notes
    frame = next(halved.frames())
    assert combing(frame.rgb) < LEAST_COMBING
    (picture,) = (one.rgb for one in halved.source.frames(slice(0, 1)))
    assert combing(picture) > LEAST_COMBING


def test_progressive_material_is_left_as_it_is_unless_asked(tmp_path: Path) -> None:
    file = _video(tmp_path / "v.mp4", lambda number: tissue(2 * number))
    kept, one_field = (open_sequence(file, settings=InputSettings(deinterlace=how)) for how in ("auto", "on"))
    assert not any(isinstance(note, Notice) and "interlaced" in note.code for note in kept.notes)
    assert Notice("input-deinterlaced", {"why": "as asked"}) in one_field.notes
    (before,), (after,) = ([one.rgb for one in each.source.frames(slice(0, 1))] for each in (kept, one_field))
    np.testing.assert_array_equal(before[::2], after[::2])
    assert (before[1::2] != after[1::2]).any()


def test_true_and_false_of_older_settings_are_read() -> None:
    read = [InputSettings.model_validate({"deinterlace": value}).deinterlace for value in (True, "true", False, "off")]
    assert read == ["on", "on", "off", "off"]
    with pytest.raises(ValueError, match="deinterlace"):
        InputSettings.model_validate({"deinterlace": 1})


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_fine_stripes_of_a_progressive_clip_are_not_two_fields(kind: str, tmp_path: Path) -> None:
    stripes = 30 * np.sin(2 * np.pi * np.arange(HEIGHT) / 2.1)[:, None, None]
    pictures = [np.clip(tissue(n) + stripes, 0, 255).astype(np.uint8) for n in range(40)]
    assert combing(pictures[5]) > LEAST_COMBING
    if kind == "folder":
        for number, picture in enumerate(pictures):
            save(tmp_path / f"{number:03d}.png", picture)
    path = tmp_path if kind == "folder" else encode(tmp_path / "v.mp4", pictures)
    assert open_sequence(path).warnings == []


# ---- frames that are left out


def _indices(file: Path, **settings: object) -> list[int]:
    return [frame.index for frame in frames_of(open_sequence(file, settings=InputSettings(**settings)))]


def test_pictures_that_repeat_are_skipped(tmp_path: Path) -> None:
    """A conversion from 25 to 30 frames/s shows every fifth picture twice."""
    converted = [tissue(6 * (number // 6) + min(number % 6, 4)) for number in range(30)]
    file = write(tmp_path / "v.mp4", converted)
    sequence = open_sequence(file)
    kept = [frame.index for frame in sequence.frames()]
    assert kept == [number for number in range(30) if number % 6 != 5]
    assert [(s.index, s.kind, s.reason) for s in sequence.skipped] == [
        (number, "repeated", f"repeats frame {number - 1}") for number in (5, 11, 17, 23, 29)
    ]
    assert sequence.count == 30
    assert _indices(file, skip_duplicates=False) == list(range(30))
    # Asked again, it says the same.
    assert len(list(sequence.frames())) == 25
    assert len(sequence.skipped) == 5


def test_what_creeps_adds_up(tmp_path: Path) -> None:
    """Each picture differs from the one before by less than counts as new, the third from the first by more."""
    for number in range(7):
        rgb = tissue(0).copy()
        rgb[::3] += np.uint8(number)
        save(tmp_path / f"{number}.png", rgb)
    assert _indices(tmp_path) == [0, 2, 4, 6]


def test_a_still_is_one_frame_and_says_so(tmp_path: Path) -> None:
    for number in range(4):
        save(tmp_path / f"{number}.png", tissue(0))
    with pytest.raises(InputError, match=r"frame 3 repeats frame 0; .*input\.skip_duplicates=false"):
        _indices(tmp_path)
    assert _indices(tmp_path, skip_duplicates=False) == [0, 1, 2, 3]


def test_the_rate_is_that_of_the_time_stamps(tmp_path: Path) -> None:
    stamps = [0, 1, 2, 3, 25, 50, 51, 52, 75]
    file = write(tmp_path / "v.mkv", clip(len(stamps), size=(64, 48)), stamps)
    sequence = open_sequence(file, settings=InputSettings(fps=1.0))
    frames = frames_of(sequence)
    assert [frame.time_s * RATE for frame in frames] == pytest.approx([0, 25, 50, 75], abs=0.1)
    assert {skipped.kind for skipped in sequence.skipped} == {"thinned"}
    assert sequence.skipped[0].reason == "beyond 1 frames/s"
