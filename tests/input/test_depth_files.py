"""Depth from files: which file, what its numbers mean, in which geometry; and the registry of depth sources."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.cameras.rectification import Rectifier, working_camera
from scopemap.engine.config import DepthSettings
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.depth_files import FilesDepth, FilesOfInput, depth_files

SOURCE = PinholeCamera(100.0, 100.0, 59.5, 49.5, 120, 100)
TARGET = SOURCE.resized(60, 50)
SAME = Rectifier(TARGET, TARGET)


def frame(index: int = 0, camera: PinholeCamera = TARGET) -> Frame:
    size = (camera.height, camera.width)
    return Frame(index, 0.0, np.zeros((*size, 3), np.uint8), camera, np.ones(size, bool))


def files(folder: Path, scale_mm: float | None = None, rectifier: Rectifier = SAME, **settings: Any) -> FilesDepth:
    return FilesDepth(folder, rectifier, DepthSettings(**settings), FilesOfInput(scale_mm))


def write(folder: Path, name: str, array: np.ndarray) -> None:
    if name.endswith(".npy"):
        np.save(folder / name, array)
    else:
        assert cv2.imwrite(str(folder / name), array)


def ramp(dtype: type, top: int) -> np.ndarray:
    return np.linspace(0, top, 50 * 60).reshape(50, 60).astype(dtype)


@pytest.mark.parametrize("extension", ["png", "tiff"])
def test_8_bit_is_disparity_and_zero_is_its_farthest(tmp_path: Path, extension: str) -> None:
    write(tmp_path, f"7.{extension}", ramp(np.uint8, 255))
    estimate = files(tmp_path).estimate(frame(7))
    assert estimate.kind == "disparity"
    assert estimate.values.dtype == np.float32
    np.testing.assert_allclose(estimate.values, ramp(np.uint8, 255) / 255, atol=1e-6)


def test_16_bit_is_measured_mm_with_0_and_65535_unknown(tmp_path: Path) -> None:
    array = ramp(np.uint16, 65535)
    write(tmp_path, "frame-000003.depth.png", array)
    source = files(tmp_path)
    estimate = source.estimate(frame(3))
    assert estimate.kind == "measured"
    expected = np.where((array > 0) & (array < 65535), array, np.nan)
    np.testing.assert_allclose(estimate.values, expected)
    assert "assumed" in source.provenance()["depth_scale"]


def test_arrays_of_floats(tmp_path: Path) -> None:
    depth_mm = ramp(np.float64, 80)
    depth_mm[0, 5], depth_mm[1, 5] = np.nan, -3
    write(tmp_path, "0001.npy", depth_mm)
    measured = files(tmp_path).estimate(frame(1))
    assert measured.kind == "measured"
    np.testing.assert_allclose(measured.values, np.where(depth_mm > 0, depth_mm, np.nan), rtol=1e-6)
    other = tmp_path / "other"
    other.mkdir()
    write(other, "disp_0001.npy", depth_mm)
    relative = files(other).estimate(frame(1))
    assert relative.kind == "disparity"
    assert relative.values[0, 0] == 0.0
    assert np.isnan(relative.values[1, 5])


def _calibrate(folder: Path) -> None:
    write_calibration(SOURCE, folder / "camera.yaml", 0.004)


def test_the_scale_and_its_order_of_precedence(tmp_path: Path) -> None:
    write(tmp_path, "0000_depth.tiff", np.full((50, 60), 1000, np.uint16))

    def value_mm(scale_mm: float | None = None, **settings: Any) -> float:
        return float(files(tmp_path, scale_mm, **settings).estimate(frame()).values[20, 20])

    assert value_mm() == pytest.approx(1000 * 100 / 65535)
    assert value_mm(0.003) == pytest.approx(3.0)
    _calibrate(tmp_path)
    assert value_mm(0.003) == pytest.approx(4.0)
    (tmp_path / "depth.json").write_text(json.dumps({"scale_mm": 0.005}))
    assert value_mm(0.003) == pytest.approx(5.0)
    assert value_mm(0.003, files_scale_mm=0.006) == pytest.approx(6.0)
    (tmp_path / "depth.json").write_text("{}")
    with pytest.raises(InputError, match="scale_mm"):
        files(tmp_path)


def test_files_follow_the_lens_of_the_frames_at_another_size(tmp_path: Path) -> None:
    """Disparity drawn in half-size fisheye pixels arrives where the rectified ray says it belongs."""
    fisheye = FisheyeCamera(PinholeCamera(60.0, 60.0, 59.5, 49.5, 120, 100), (-0.05, 0.002, 0.0, 0.0))
    rectifier = Rectifier(fisheye, working_camera(fisheye, (60, 50)))
    u, v = np.meshgrid(np.arange(60), np.arange(50))
    write(tmp_path, "0.png", (2 * u + 2 * v).astype(np.uint8))
    values = files(tmp_path, rectifier=rectifier).estimate(frame(0, rectifier.target)).values
    for x, y in ((30, 25), (10, 12), (50, 40)):
        source = fisheye.project(rectifier.target.unproject(np.array([x, y])))
        expected = sum(2 * ((s + 0.5) / 2 - 0.5) for s in source) / 255
        assert values[y, x] == pytest.approx(expected, abs=0.005)


def test_a_runs_own_depth_is_not_rectified_twice(tmp_path: Path) -> None:
    fisheye = FisheyeCamera(PinholeCamera(60.0, 60.0, 59.5, 49.5, 120, 100), (-0.05, 0.002, 0.0, 0.0))
    rectifier = Rectifier(fisheye, working_camera(fisheye, (60, 50)))
    array = ramp(np.uint16, 60000) + np.uint16(1)
    write(tmp_path, "000000.png", array)
    (tmp_path / "depth.json").write_text(json.dumps({"scale_mm": 0.001}))
    values = files(tmp_path, rectifier=rectifier).estimate(frame(0, rectifier.target)).values
    np.testing.assert_allclose(values, array * 0.001, rtol=1e-6)


def test_a_frame_without_a_file_or_with_one_of_another_aspect_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "4.png", ramp(np.uint8, 255))
    write(tmp_path, "6.png", np.zeros((50, 50), np.uint8))
    with pytest.raises(InputError, match=f"frame 5 in {tmp_path}"):
        files(tmp_path).estimate(frame(5))
    with pytest.raises(InputError, match=r"50x50 px.*60x50 px"):
        files(tmp_path).estimate(frame(6))


def test_mixed_8_and_16_bit_need_a_word_from_the_user(tmp_path: Path) -> None:
    write(tmp_path, "0.png", np.full((50, 60), 60, np.uint8))
    write(tmp_path, "1.png", np.full((50, 60), 300, np.uint16))
    with pytest.raises(InputError, match=r"depth\.files_kind"):
        files(tmp_path).estimate(frame(1))
    assert files(tmp_path, files_kind="measured").estimate(frame(1)).values[3, 3] == 300.0


def test_unusable_folders_and_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is no folder"):
        files(tmp_path / "absent")
    with pytest.raises(InputError, match="no png, tif, jpg or npy"):
        files(tmp_path)
    write(tmp_path, "0.png", np.dstack([ramp(np.uint8, 255), 0 * ramp(np.uint8, 1), ramp(np.uint8, 9)]))
    with pytest.raises(InputError, match="colour-mapped"):
        files(tmp_path)
    (tmp_path / "0.png").write_bytes(b"not a picture")
    with pytest.raises(InputError, match="cannot read the depth file"):
        files(tmp_path)
    write(tmp_path, "00.png", ramp(np.uint8, 255))
    with pytest.raises(InputError, match="have the same number"):
        files(tmp_path)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.ones((3, 50, 60), np.float32), r"of shape \(3, 50, 60\).*save one array \(height, width\) per frame"),
        (np.ones((50, 60), np.int32), "holds int32 .*save it as uint16 or float32"),
        (
            np.array([{"depth": 1}], dtype=object),
            "it holds Python objects, which are not loaded; save the array itself",
        ),
    ],
)
def test_arrays_that_are_no_depth_of_one_frame_are_refused_for_what_they_are(
    array: np.ndarray, message: str, tmp_path: Path
) -> None:
    """All were said to be colour-mapped pictures, or answered by NumPy's own words."""
    np.save(tmp_path / "0.npy", array)
    with pytest.raises(InputError, match=message):
        files(tmp_path)


def test_an_array_that_breaks_off_is_called_damaged(tmp_path: Path) -> None:
    write(tmp_path, "0.npy", ramp(np.float32, 80))
    (tmp_path / "0.npy").write_bytes((tmp_path / "0.npy").read_bytes()[:3000])
    with pytest.raises(InputError, match=r"0\.npy: it is no array of NumPy, or damaged"):
        files(tmp_path)


def test_three_equal_channels_with_unknown_pixels_are_one(tmp_path: Path) -> None:
    """NaN differs from NaN: they were taken for a colour-mapped picture."""
    depth_mm = ramp(np.float32, 80)
    depth_mm[3, 4] = np.nan
    write(tmp_path, "0.npy", np.dstack([depth_mm] * 3))
    assert np.isnan(files(tmp_path).estimate(frame()).values[3, 4])


def test_arrays_of_other_formats_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "0000.npz", depth=ramp(np.float32, 80))
    with pytest.raises(InputError, match=r"; save what its \.npz files hold as one npy file per frame"):
        files(tmp_path)


@pytest.mark.parametrize(
    ("first", "frames", "later"), [(1, range(4), -1), (0, range(1, 5), 1), (0, range(4), 0), (1, range(5), 0)]
)
def test_depth_files_numbered_from_1_belong_to_frames_from_0(
    first: int, frames: range, later: int, tmp_path: Path
) -> None:
    for number in range(4):
        write(tmp_path, f"depth_{number + first:04d}.npy", np.full((50, 60), 10.0 + number, np.float32))
    found = FilesDepth(tmp_path, SAME, DepthSettings(files_kind="measured"), FilesOfInput(numbers=frames))
    assert found.later == later
    for number in range(4):
        values = found.estimate(frame(number + first + later)).values
        assert np.nanmedian(values) == 10.0 + number


def test_depth_files_with_decimal_numbers_belong_to_the_pictures_with_these(tmp_path: Path) -> None:
    names = ("0.067", "0.2", "0.967", "1.067")
    for name in names:
        (tmp_path / f"depth_{name}.npy").touch()
    pictures = dict(enumerate(tmp_path / f"frame_{name}.png" for name in names))
    found = depth_files(tmp_path, pictures)
    assert {number: file.name for number, file in found.items()} == {
        number: f"depth_{name}.npy" for number, name in enumerate(names)
    }
