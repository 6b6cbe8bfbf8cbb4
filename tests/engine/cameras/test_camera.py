"""Camera models: round trips, agreement with OpenCV, closed forms, resizing, cutting, the way back to the source."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera, source_pixel
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OmnidirectionalCamera, OpenCvCamera

PINHOLE = PinholeCamera(520.0, 525.0, 318.0, 245.0, 640, 480)
OPENCV = OpenCvCamera(PINHOLE, (-0.3, 0.1, 1e-3, -5e-4, -0.01))
RATIONAL = OpenCvCamera(PINHOLE, (0.6, -0.1, -3e-4, 2e-4, 0.02, 0.9, 0.05, 0.01))
FISHEYE = FisheyeCamera(
    PinholeCamera(717.7, 718.0, 734.7, 552.1, 1440, 1080), (-0.1397, -0.000314, 0.001506, -0.000132)
)
OMNI = OmnidirectionalCamera(
    (769.2436, 0.0, -8.12770624e-4, 6.25674244e-7, -1.19662182e-9),
    678.5448, 542.9759, 1350, 1080, (0.99998688, 0.00288274, -0.00296316),
)  # fmt: skip
FOV = FovCamera(PINHOLE, 0.95)
MODELS = {
    "pinhole": PINHOLE, "opencv": OPENCV, "rational": RATIONAL, "fisheye": FISHEYE, "omnidirectional": OMNI, "fov": FOV,
}  # fmt: skip


@pytest.fixture(params=MODELS.values(), ids=MODELS.keys())
def camera(request: pytest.FixtureRequest) -> CameraModel:
    return request.param


def grid(camera: CameraModel, step: int = 7) -> np.ndarray:
    u, v = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    return np.stack([u, v], -1).astype(float)


def test_project_undoes_unproject_over_the_whole_image(camera: CameraModel) -> None:
    pixels = grid(camera)
    rays = camera.unproject(pixels)
    seen = np.isfinite(rays).all(-1)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(rays[seen][:, 2], 1.0)
    assert np.abs(camera.project(rays[seen]) - pixels[seen]).max() < 1e-6


def test_points_behind_the_camera_have_no_pixel(camera: CameraModel) -> None:
    assert np.isnan(camera.project(np.array([[0.0, 0.0, -1.0], [1.0, 1.0, 0.0]]))).all()


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(sorted(MODELS)), corner=st.tuples(st.integers(0, 200), st.integers(0, 150)),
    scale=st.floats(0.1, 3.0), squeeze=st.floats(0.7, 1.4), crop_first=st.booleans(),
    at=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)  # fmt: skip
def test_round_trips_of_what_was_cut_and_resized(
    name: str, corner: tuple[int, int], scale: float, squeeze: float, crop_first: bool, at: tuple[float, float]
) -> None:
    """To 1e-6 px inside the field; and the ray is that of the same place in the camera that was begun with."""
    whole = MODELS[name]
    x, y = corner
    if crop_first:
        cut = whole.cropped(x, y, 400, 300)
        size = (round(400 * scale), round(300 * scale * squeeze))
        camera, factor = cut.resized(*size), np.array(size) / (400, 300)
    else:
        size = (round(whole.width * scale), round(whole.height * scale * squeeze))
        x, y = int(x * scale), int(y * scale * squeeze)
        camera = whole.resized(*size).cropped(x, y, size[0] - x, size[1] - y)
        factor = np.array(size) / (whole.width, whole.height)
    pixel = np.array(at) * (camera.width - 1, camera.height - 1)
    ray = camera.unproject(pixel)
    before = (pixel + 0.5) / factor - 0.5 + (x, y) if crop_first else (pixel + (x, y) + 0.5) / factor - 0.5
    np.testing.assert_allclose(ray, whole.unproject(before), rtol=1e-6, atol=1e-9)
    if np.isfinite(ray).all():
        assert np.abs(camera.project(3.5 * ray) - pixel).max() < 1e-6


def test_fov_lens_is_the_published_formula() -> None:
    """r_d = atan(2 r tan(w / 2)) / w: r = 1 of an angle w of 90 deg lies at atan(2) / (pi / 2)."""
    camera = FovCamera(PINHOLE, np.pi / 2)
    expected = PINHOLE.cx + PINHOLE.fx * np.arctan(2.0) / (np.pi / 2)
    np.testing.assert_allclose(camera.project(np.array([2.0, 0.0, 2.0])), [expected, PINHOLE.cy], rtol=1e-14)
    assert camera.central.fx == pytest.approx(PINHOLE.fx * 4 / np.pi)
    beyond = PINHOLE.cx + PINHOLE.fx * (np.pi / 2) / camera.omega  # where the ray would lie in the image plane
    assert np.isnan(camera.unproject(np.array([beyond, PINHOLE.cy]))).all()


def test_source_pixels_are_where_other_code_puts_them() -> None:
    """The ray of a working pixel by hand; then OpenCV's own projection, or each lens' formula."""
    working = PinholeCamera(200.0, 210.0, 150.0, 110.0, 320, 240)
    pixels = np.array([[150.0, 110.0], [0.0, 0.0], [319.0, 20.0], [77.5, 200.25]])
    rays = np.stack([(pixels[:, 0] - 150) / 200, (pixels[:, 1] - 110) / 210, np.ones(4)], -1)
    zero = np.zeros(3)
    for camera in (OPENCV, RATIONAL):
        expected, _ = cv2.projectPoints(rays, zero, zero, camera.central.matrix, np.array(camera.distortion))
        np.testing.assert_allclose(source_pixel(pixels, working, camera), expected[:, 0], atol=1e-9)
    expected, _ = cv2.fisheye.projectPoints(
        rays[:, None], zero, zero, FISHEYE.central.matrix, np.array(FISHEYE.distortion)
    )
    np.testing.assert_allclose(source_pixel(pixels, working, FISHEYE), expected[:, 0], atol=1e-9)
    plain = np.stack([520 * rays[:, 0] + 318, 525 * rays[:, 1] + 245], -1)
    np.testing.assert_allclose(source_pixel(pixels, working, PINHOLE), plain, atol=1e-9)
    r = np.hypot(rays[:, 0], rays[:, 1])
    bent = np.arctan(2 * r * np.tan(0.95 / 2)) / 0.95 / np.where(r > 0, r, 1)
    plain = np.stack([520 * rays[:, 0] * bent + 318, 525 * rays[:, 1] * bent + 245], -1)
    np.testing.assert_allclose(source_pixel(pixels, working, FOV), plain, atol=1e-9)
    found = source_pixel(pixels, working, OMNI)
    c, d, e = OMNI.stretch
    flat = np.linalg.solve([[c, d], [e, 1.0]], (found - [OMNI.cx, OMNI.cy]).T).T
    z = np.polynomial.polynomial.polyval(np.hypot(*flat.T), OMNI.polynomial)
    np.testing.assert_allclose(flat / z[:, None], rays[:, :2], atol=1e-9)
    assert np.isnan(source_pixel(np.array([[1e9, 0.0]]), working, OMNI)).all()


def test_omnidirectional_corners_look_sideways_and_are_not_seen() -> None:
    assert np.isnan(OMNI.unproject(np.array([[0.0, 0.0], [1349.0, 1079.0]]))).all()


def test_a_lens_that_turns_back_has_no_pixel_beyond_its_field() -> None:
    # r (1 - r^2 / 3) increases up to r = 1 and then falls back: without a limit, r = 1.6 would land inside the image.
    camera = OpenCvCamera(PINHOLE, (-1 / 3, 0.0, 0.0, 0.0))
    assert np.tan(camera.field_rad) == pytest.approx(1.0)
    assert np.isfinite(camera.project(np.array([0.99, 0, 1]))).all()
    assert np.isnan(camera.project(np.array([1.6, 0, 1]))).all()
    edge = PINHOLE.cx + PINHOLE.fx * 2 / 3
    assert np.isnan(camera.unproject(np.array([edge + 1, PINHOLE.cy]))).all()
    just_inside = camera.project(np.array([0.9999, 0, 1]))
    np.testing.assert_allclose(camera.unproject(just_inside), [0.9999, 0, 1], atol=1e-9)


@settings(max_examples=80, deadline=None)
@given(
    kind=st.integers(0, 3), a=st.floats(-0.3, 0.3), b=st.floats(-0.02, 0.02), c=st.floats(-2e-3, 2e-3),
    share=st.floats(0, 0.9), angle=st.floats(0, 6.3),
)  # fmt: skip
def test_round_trip_anywhere_in_the_field_of_any_lens(
    kind: int, a: float, b: float, c: float, share: float, angle: float
) -> None:
    camera: CameraModel = (
        OpenCvCamera(PINHOLE, (a, b, c, -c)),
        FisheyeCamera(PINHOLE, (a / 2, b, c, 0.0)),
        FovCamera(PINHOLE, 1.6 + 5 * a),
        OmnidirectionalCamera((600 + 1000 * a, 0.0, b / 20), 320.0, 240.0, 640, 480, (1 + b, c, -c)),
    )[kind]
    tangent = share * min(np.tan(getattr(camera, "field_rad", 1.3)), 45.0 if kind else 1.5)
    pixel = camera.project(np.array([tangent * np.cos(angle), tangent * np.sin(angle), 1.0]))
    if np.isfinite(pixel).all():
        ray = camera.unproject(pixel)
        np.testing.assert_allclose(np.hypot(ray[0], ray[1]), tangent, rtol=1e-7, atol=1e-9)
        assert np.abs(camera.project(ray) - pixel).max() < 1e-6


def test_a_rational_lens_ends_at_its_pole() -> None:
    # r / (1 - r^2): infinite at 1, and back from minus infinity beyond.
    camera = OpenCvCamera(PINHOLE, (0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0))
    assert np.tan(camera.field_rad) == pytest.approx(1.0)
    assert np.isnan(camera.project(np.array([1.2, 0, 1]))).all()
    np.testing.assert_allclose(camera.unproject(camera.project(np.array([0.9, 0.3, 1]))), [0.9, 0.3, 1], rtol=1e-9)


def test_impossible_lenses_are_refused() -> None:
    with pytest.raises(ValueError, match="4, 5 or 8"):
        OpenCvCamera(PINHOLE, (0.1, 0.2))
    with pytest.raises(ValueError, match="expected 4"):
        FisheyeCamera(PINHOLE, (0.1,))
    for omega in (0.0, -0.5, np.pi, float("nan")):
        with pytest.raises(ValueError, match="between 0 and pi"):
            FovCamera(PINHOLE, omega)
    with pytest.raises(ValueError, match="a0 must be positive"):
        OmnidirectionalCamera((-769.0, 0.0, 1e-3), 0, 0, 10, 10)
