"""Rectification: straight lines, exact positions, resolutions, unknown values, working size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera, source_pixel
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera, OpenCvCamera
from scopemap.engine.cameras.rectification import DepthSensor, Rectifier, working_camera, working_size
from scopemap.engine.errors import CalibrationError
from scopemap.engine.geometry.se3 import inverse, se3_exp, transform

PINHOLE = PinholeCamera(300.0, 302.0, 318.0, 245.0, 640, 480)
LENSES = {
    "pinhole": PINHOLE,
    "opencv": OpenCvCamera(PINHOLE, (-0.2, 0.03, 1e-3, -5e-4)),
    "fisheye": FisheyeCamera(PINHOLE, (-0.05, 2e-3, 0.0, 0.0)),
    "fov": FovCamera(PINHOLE, 0.9),
    "omnidirectional": OmnidirectionalCamera((300.0, 0.0, -1e-3), 318.0, 245.0, 640, 480, (0.999, 0.002, -0.003)),
}


@pytest.fixture(params=LENSES.values(), ids=LENSES.keys())
def source(request: pytest.FixtureRequest) -> CameraModel:
    return request.param


def coordinates(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((1350, 1080), (337, 270)),
        ((640, 480), (320, 240)),
        ((1920, 1080), (384, 216)),
        ((384, 384), (384, 384)),
        ((400, 300), (400, 300)),
        ((401, 300), (200, 150)),
        ((1024, 1280), (256, 320)),
    ],
)
def test_working_size(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert working_size(*size) == expected


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_an_array_of_any_resolution_is_taken_from_where_the_cameras_say(source: CameraModel, factor: float) -> None:
    """A ramp holds its own coordinates: rectified, it must hold the source pixel of each target pixel."""
    rectifier = Rectifier(source, working_camera(source, (160, 120)))
    u, _ = coordinates(int(640 * factor), int(480 * factor))
    ramp = (u + 0.5) / factor - 0.5  # u of the full-size image
    expected = source_pixel(np.stack(coordinates(160, 120), -1), rectifier.target, rectifier.source)[..., 0]
    deep = rectifier.valid & (expected > 2) & (expected < 637)
    np.testing.assert_allclose(rectifier.smooth(ramp)[deep], expected[deep], atol=0.05)
    ramp[: len(ramp) // 4] = np.nan  # unknown disparity takes no part
    smooth = rectifier.smooth(ramp)
    known = np.isfinite(smooth) & deep
    assert known.sum() == pytest.approx(0.75 * deep.sum(), rel=0.1)
    np.testing.assert_allclose(smooth[known], expected[known], atol=0.05)
    ramp = (u + 0.5) / factor - 0.5
    assert np.abs(rectifier.nearest(ramp)[deep] - expected[deep]).max() <= 0.501 / factor


def test_a_wider_view_has_an_invalid_border_and_says_so(source: CameraModel) -> None:
    rectifier = Rectifier(source, working_camera(source, (160, 120), zoom=0.5))
    image = np.full((480, 640, 3), 200, np.uint8)
    valid = rectifier.valid
    assert 0.1 < valid.mean() < 0.9
    assert valid[60, 80]
    rectified = rectifier.image(image)
    assert (rectified[~valid] == 0).all()
    assert (rectified[valid] == 200).all()
    depth = rectifier.nearest(np.ones((480, 640), np.float32))
    np.testing.assert_array_equal(np.isfinite(depth), valid)
    assert (rectifier.nearest(np.ones((480, 640), np.uint8)) == valid).all()


def test_the_same_view_is_not_touched_or_only_resized() -> None:
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    same = Rectifier(PINHOLE, PINHOLE)
    assert same.only_resizes
    np.testing.assert_array_equal(same.image(image), image)
    half = Rectifier(PINHOLE, working_camera(PINHOLE, (320, 240)))
    blocks = image.reshape(240, 2, 320, 2, 3).mean((1, 3))
    assert half.only_resizes
    assert np.abs(half.image(image) - blocks).max() <= 1
    assert not Rectifier(PINHOLE, working_camera(PINHOLE, (320, 240), zoom=0.9)).only_resizes


def test_a_larger_view_is_that_of_a_new_rectifier(source: CameraModel) -> None:
    small = Rectifier(source, working_camera(source, (160, 120)))
    larger, anew = small.enlarged(640, 480), Rectifier(source, small.target.resized(640, 480))
    picture = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    picture = cv2.GaussianBlur(picture, (0, 0), 2)
    known = larger.valid & anew.valid
    inside = cv2.erode(known.astype(np.uint8), np.ones((13, 13)), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    assert inside.mean() > 0.5
    assert np.abs(larger.image(picture).astype(int) - anew.image(picture))[inside].max() <= 2


def test_fine_texture_does_not_alias() -> None:
    """Stripes one pixel wide are beyond what a four times coarser image can show: they must become even grey."""
    source = LENSES["fisheye"]
    image = np.zeros((480, 640, 3), np.uint8)
    image[:, ::2] = 255
    rectified = Rectifier(source, working_camera(source, (160, 120))).image(image)
    assert rectified[10:-10, 10:-10].std() < 4


def test_what_does_not_fit_is_refused() -> None:
    rectifier = Rectifier(PINHOLE, working_camera(PINHOLE, (320, 240)))
    with pytest.raises(CalibrationError, match="aspect"):
        rectifier.nearest(np.zeros((480, 480), np.float32))
    with pytest.raises(ValueError, match="image"):
        rectifier.image(np.zeros((240, 320, 3), np.uint8))
    away = PinholeCamera(300.0, 300.0, 5000.0, 240.0, 640, 480)
    with pytest.raises(CalibrationError, match="no pixel"):
        Rectifier(PINHOLE, away)


@pytest.mark.parametrize("size", [(640, 480), (320, 240)])
def test_depth_of_a_sensor_beside_the_camera_lands_where_the_camera_sees_it(source: CameraModel, size: tuple) -> None:
    """A slanted plane: depth that another camera took is, on the grid of the images, what these would have measured."""
    sensor = PinholeCamera(340.0, 345.0, 320.0, 240.0, 640, 480)
    T = se3_exp(np.array([0.02, -0.03, 0.05, -25.0, 4.0, 2.0]))
    normal_mm = np.array([0.2, 0.1, 1.0]) / 1000  # normal . X = 1, in the sensor's frame
    rays = sensor.resized(*size).rays
    rectifier = Rectifier(source, working_camera(source, (320, 240)), DepthSensor(sensor, T))
    found_mm = rectifier.nearest((1 / (rays @ normal_mm)).astype(np.float32))
    known = np.isfinite(found_mm)
    points = transform(inverse(T), rectifier.target.rays[known] * found_mm[known, None])
    # Half a pixel either way on the slant, twice; and what a coarser sensor leaves empty stays empty.
    assert np.abs(points @ normal_mm - 1).max() < 0.004
    assert known.mean() > (0.5 if size == (640, 480) else 0.15)


def test_the_nearest_of_two_surfaces_counts_and_what_the_sensor_does_not_know_stays_unknown() -> None:
    camera = PinholeCamera(100.0, 100.0, 20.0, 20.0, 40, 40)
    depth_mm = np.full((40, 40), 1000, np.float32)
    depth_mm[:, :20] = 500
    depth_mm[5] = np.nan
    found_mm = DepthSensor(camera, se3_exp(np.array([0, 0, 0, 25.0, 0, 0]))).registered(depth_mm, camera)
    # 2.5 px to the right at 1000 mm, 5 px at 500 mm: the near half hides the far one's edge.
    assert np.isnan(found_mm[5]).all()
    assert (found_mm[6:, 5:25] == 500).all()
    assert (found_mm[6:, 25:] == 1000).all()
