"""Calibrations of another size than the images: only the user's word scales or cuts them, else both sizes are said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.config import InputSettings
from scopemap.engine.errors import CalibrationError, SettingsError
from scopemap.input.camera_files.calibration import Calibration, fitted
from scopemap.input.camera_files.reading import read_calibration, stated_calibration
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from tests.support.drawn_calibrations import CAMERAS, PINHOLE, SIZE
from tests.support.drawn_datasets import write_pictures

# The pictures of `write_pictures` are 135x108 px.
LARGE = PinholeCamera(200.0, 201.0, 140.0, 105.0, 270, 216)


@pytest.mark.parametrize(
    ("fit", "size", "at", "said"),
    [("scale", (320, 240), (200.5, 160.5), "rescaled from 640x480 px"),
     ("crop:150,100", (400, 300), (250.0, 180.0), "cut out of 640x480 px at 150,100 px")],
)  # fmt: skip
@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: type(c).__name__)
def test_the_view_of_every_model_is_kept_and_it_is_said(
    camera: CameraModel, fit: str, size: tuple[int, int], at: tuple[float, float], said: str, tmp_path: Path
) -> None:
    """The pixel (100, 80) of the images sees what the pixel `at` of the calibrated ones saw."""
    write_calibration(camera, tmp_path / "camera.yaml")
    found = read_calibration(tmp_path / "camera.yaml", size, fit)
    assert found.source.endswith(said)
    rays = found.camera.unproject(np.array([100.0, 80.0])), camera.unproject(np.array(at))
    np.testing.assert_allclose(*rays, rtol=1e-12)


@pytest.mark.parametrize(
    ("size", "fit", "message"),
    [
        ((320, 240), "exact", r"is for 640x480 px, but the images are 320x240 px.*--camera-fit scale.*fit crop:X,Y"),
        ((320, 243), "scale", "640x480 px, but the images are 320x243 px: another aspect"),
        ((400, 300), "crop:241,0", "640x480 px, but the images are 400x300 px: too large to have been cut out of it"),
        ((400, 300), "crop:0,181", "too large to have been cut out of it at 0,181 px"),
        ((640, 480), "crop:1,0", "too large to have been cut out"),
        ((200, 100), "crop:0,0", "principal point 318, 245 is outside"),
    ],
)
def test_a_word_that_does_not_explain_the_size_is_refused(
    size: tuple[int, int], fit: str, message: str, tmp_path: Path
) -> None:
    write_calibration(PINHOLE, tmp_path / "camera.yaml")
    with pytest.raises(CalibrationError, match=message):
        read_calibration(tmp_path / "camera.yaml", size, fit)


def test_a_file_without_a_size_can_be_cut_but_not_scaled(tmp_path: Path) -> None:
    file = tmp_path / "k.txt"
    file.write_text("520.5 525.25 318 245")
    assert stated_calibration(file, (320, 240)).size_origin == "images"
    found = read_calibration(file, (400, 300), "crop:150,100")
    assert found.camera == PinholeCamera(520.5, 525.25, 168.0, 145.0, 400, 300)
    assert found.source == "calibration file k.txt, cut out at 150,100 px"
    with pytest.raises(CalibrationError, match="does not state its image size"):
        read_calibration(file, (320, 240), "scale")


def test_shares_of_the_size_fit_any_size_and_cannot_be_cut(tmp_path: Path) -> None:
    file = tmp_path / "k.txt"
    file.write_text("0.75 1.0 0.5 0.5")
    assert read_calibration(file, (400, 300)).camera == PinholeCamera(300.0, 300.0, 200.0, 150.0, 400, 300)
    assert read_calibration(file, (400, 300)).source.endswith("its numbers taken as shares of the size")
    with pytest.raises(CalibrationError, match="shares of a size that it does not state"):
        read_calibration(file, (400, 300), "crop:1,1")


def test_another_word_is_a_wrong_setting() -> None:
    for fit in ("guess", "crop:-1,0", "crop:1", "crop:1,2,3"):
        with pytest.raises(SettingsError, match="expected exact, scale or crop:X,Y"):
            fitted(Calibration(PINHOLE, None, "mine"), SIZE, fit)


# ---- where it is said


@pytest.mark.parametrize("beside", [True, False])
def test_the_setting_holds_for_a_file_that_is_given_and_for_one_beside_the_frames(beside: bool, tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "frames")
    file = folder / "camera.yaml" if beside else tmp_path / "mine.yaml"
    write_calibration(LARGE, file)
    given = None if beside else file
    with pytest.raises(CalibrationError, match=r"is for 270x216 px, but the images are 135x108 px.*--camera-fit scale"):
        open_sequence(folder, camera=given)
    scaled = open_sequence(folder, camera=given, settings=InputSettings(camera_fit="scale"))
    assert scaled.rectifier.source == LARGE.resized(135, 108)
    assert "rescaled from 270x216 px" in scaled.camera_source
    cut = open_sequence(folder, camera=given, settings=InputSettings(camera_fit="crop:40,30"))
    assert cut.rectifier.source == PinholeCamera(200.0, 201.0, 100.0, 75.0, 135, 108)
    assert cut.camera_source.endswith("cut out of 270x216 px at 40,30 px")
    assert ("beside the frames" in cut.camera_source) == beside


def test_a_crop_of_nothing_is_refused(tmp_path: Path) -> None:
    folder = write_pictures(tmp_path / "frames")
    with pytest.raises(CalibrationError, match="no calibration file out of which to cut"):
        open_sequence(folder, settings=InputSettings(camera_fit="crop:1,1"))
