"""Reading inputs: folders of images, videos, their camera and what is wrong with them; and the real folders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.config import InputSettings
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.opening import open_sequence
from tests.support.drawn_inputs import SIZE, frames_of, number_in, picture, save, write_c3vd, write_video

# ---- folders of images


def test_images_are_sorted_by_number_and_keep_it(tmp_path: Path) -> None:
    for number, suffix in ((9, "png"), (10, "jpg"), (2, "tif"), (100, "bmp")):
        save(tmp_path / f"img_{number}.{suffix}", picture(number % 20))
        save(tmp_path / f"img_{number}_mask.png", picture(0))
    (tmp_path / "notes.txt").write_text("not an image")
    sequence = open_sequence(tmp_path)
    frames = frames_of(sequence)
    assert [f.index for f in frames] == [2, 9, 10, 100]
    assert [number_in(f.rgb) for f in frames] == [2, 9, 10, 0]
    assert [f.time_s for f in frames] == pytest.approx([2 / 30, 9 / 30, 10 / 30, 100 / 30])
    assert frames[0].name == "img_2.tif"
    assert sequence.count == 4
    assert sequence.source.name == "images"
    assert any("time stamps" in note for note in sequence.notes)
    assert all(truth is None for _, truth in sequence)


def test_grey_deep_and_transparent_images_become_rgb(tmp_path: Path) -> None:
    grey = picture(3)[..., 1]
    cv2.imwrite(str(tmp_path / "0.png"), grey)
    cv2.imwrite(str(tmp_path / "1.png"), grey.astype(np.uint16) * 256)
    cv2.imwrite(str(tmp_path / "2.png"), np.dstack([grey, grey, grey, 255 - grey]))
    for frame in frames_of(open_sequence(tmp_path, settings=InputSettings(skip_duplicates=False))):
        np.testing.assert_array_equal(frame.rgb, np.repeat(grey[..., None], 3, -1))


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (slice(2, 6), [2, 3, 4, 5]),
        (slice(None, None, 3), [0, 3, 6, 9]),
        (slice(-2, None), [9, 10]),
        (slice(8, 99), [8, 9, 10]),
    ],
)
@pytest.mark.parametrize("kind", ["video", "folder"])
def test_selections_are_python_slices(selection: slice, expected: list[int], kind: str, tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mp4", 11) if kind == "video" else write_c3vd(tmp_path / "c")
    sequence = open_sequence(path, frames=selection)
    frames = frames_of(sequence)
    assert [f.index for f in frames] == expected
    assert [number_in(f.rgb) for f in frames] == expected
    assert sequence.count == len(expected)


def test_frames_are_decoded_one_at_a_time(tmp_path: Path) -> None:
    for i in range(3):
        save(tmp_path / f"{i}.png", picture(i))
    walk = iter(open_sequence(tmp_path))
    assert next(walk)[0].index == 0
    (tmp_path / "2.png").unlink()
    save(tmp_path / "2.png", picture(7))
    assert [number_in(f.rgb) for f, _ in walk] == [1, 7]


# ---- the camera


def test_an_unknown_camera_is_assumed_from_the_field_of_view_and_can_be_bettered(tmp_path: Path) -> None:
    for i in range(2):
        save(tmp_path / f"{i}.png", picture(i, (800, 600)))
    sequence = open_sequence(tmp_path, fov_deg=90.0)
    found = sequence.camera
    np.testing.assert_allclose([found.fx, found.fy, found.cx, found.cy], [200.0, 200.0, 199.5, 149.5])
    assert "90 deg" in sequence.camera_source
    assert any("field of view" in str(note) for note in sequence.notes)
    better = sequence.with_focal(300.0, "estimated by a network")
    assert better.camera.fx == pytest.approx(300.0)
    assert better.camera_source == "estimated by a network"
    assert frames_of(better)[0].camera.fx == pytest.approx(300.0)
    np.testing.assert_array_equal(frames_of(better)[0].rgb, frames_of(sequence)[0].rgb)


def test_a_calibration_file_wins_and_is_said(tmp_path: Path) -> None:
    folder = write_c3vd(tmp_path / "c")
    (tmp_path / "mine.txt").write_text("120 121 67 54")
    sequence = open_sequence(folder, camera=tmp_path / "mine.txt")
    assert sequence.camera.fx == 120
    assert sequence.camera_source == "calibration file mine.txt"
    with pytest.raises(CalibrationError, match="is known"):
        sequence.with_focal(100.0, "a guess")


def test_the_working_size_is_chosen_or_given(tmp_path: Path) -> None:
    for i in range(2):
        save(tmp_path / f"{i}.png", picture(i, (800, 600)))
    assert open_sequence(tmp_path).size_source == "400x300 px chosen for input of 800x600 px"
    given = open_sequence(tmp_path, size=(200, 150))
    assert (given.camera.width, given.camera.height) == (200, 150)
    assert "given" in given.size_source
    assert frames_of(given)[0].rgb.shape == (150, 200, 3)


# ---- video


@pytest.mark.parametrize(("suffix", "options"), [("avi", {}), ("mkv", {}), ("mp4", {"movflags": "faststart"})])
def test_a_video_that_breaks_off_is_used_with_a_warning(suffix: str, options: dict[str, str], tmp_path: Path) -> None:
    file = write_video(tmp_path / f"v.{suffix}", 40, options)
    data = file.read_bytes()
    file.write_bytes(data[: int(0.6 * len(data))])
    sequence = open_sequence(file)
    frames = frames_of(sequence)
    assert 15 < len(frames) < 30
    assert [number_in(f.rgb) for f in frames[:-1]] == list(range(len(frames) - 1))
    assert len(sequence.warnings) == 1
    assert "breaks off" in sequence.warnings[0]
    part = open_sequence(file, frames=slice(0, 5))
    assert len(frames_of(part)) == 5
    assert part.warnings == []


# ---- bad input


def _one_image(folder: Path) -> Path:
    save(folder / "0.png", picture(0))
    return folder


def _no_video(content: bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "v.mp4").write_bytes(content)
        return folder / "v.mp4"

    return write


def _headless_video(folder: Path) -> Path:
    file = write_video(folder / "v.mp4", 20)
    file.write_bytes(file.read_bytes()[:5000])
    return file


def _broken_images(folder: Path) -> Path:
    for i in range(3):
        (folder / f"{i}.png").write_bytes(b"no image")
    return folder


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: folder / "nowhere", "no such file or folder"),
        (lambda folder: folder, "there is no image"),
        (_one_image, "two are needed"),
        (_no_video(b""), r"v\.mp4"),
        (_no_video(np.random.default_rng(0).bytes(4000)), r"v\.mp4"),
        (_headless_video, r"v\.mp4"),
        (_broken_images, "none of the 3 images can be read"),
        (lambda folder: write_video(folder / "v.mp4", 1), "holds one frame, two are needed"),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line(make: Callable[[Path], Path], message: str, tmp_path: Path) -> None:
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as caught:
        open_sequence(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_frames_of_another_size_are_left_out_and_named(tmp_path: Path) -> None:
    for i in range(3):
        save(tmp_path / f"{i}.png", picture(i, SIZE if i < 2 else (64, 48)))
    sequence = open_sequence(tmp_path)
    assert [frame.index for frame in frames_of(sequence)] == [0, 1]
    assert "64x48 px" in sequence.source.left_out[2].reason


# ---- the real folders


def reprojection_error_mm(a: tuple, b: tuple) -> np.ndarray:
    """How far surface seen in frame a lies from the surface seen in frame b, along b's axis, mm (NaN where unseen)."""
    (frame_a, truth_a), (_, truth_b) = a, b
    camera = frame_a.camera
    points = camera.rays.astype(np.float64) * truth_a.depth_mm[..., None]
    in_b = transform(inverse(truth_b.T_world_camera) @ truth_a.T_world_camera, points)
    u, v = np.moveaxis(camera.project(in_b), -1, 0).astype(np.float32)
    there = cv2.remap(truth_b.depth_mm, u, v, cv2.INTER_LINEAR, borderValue=float("nan"))
    return np.abs(there - in_b[..., 2])


@pytest.mark.real
def test_real_c3vd_frames_agree_with_each_other_through_the_rectification(real_data: Path) -> None:
    """Polynomial, pixel centres, pose form, depth scale: a fault in any of them would show here."""
    pairs = list(open_sequence(real_data / "endoscopy" / "c3vd" / "trans_t1_a"))
    assert [f.index for f, _ in pairs] == list(range(1, 11))
    error_mm = reprojection_error_mm(pairs[0], pairs[-1])
    assert np.isfinite(error_mm).mean() > 0.5
    assert np.nanmedian(error_mm) < 0.1


@pytest.mark.real
def test_real_c3vd_video_without_depth(real_data: Path) -> None:
    sequence = open_sequence(real_data / "endoscopy" / "c3vd" / "cecum_t1_a")
    assert (sequence.count, sequence.camera.width, sequence.camera.height) == (276, 337, 270)
    centres = np.array([sequence.source.pose(number)[:3, 3] for number in range(276)])
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).sum() == pytest.approx(54.7, abs=0.1)
