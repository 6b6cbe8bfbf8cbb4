"""Shading depth: the law it inverts, what it leaves out and fills, and its figures on real frames."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.shading import ShadingDepth
from scopemap.engine.frame import Frame

CAMERA = PinholeCamera(90.0, 90.0, 79.5, 63.5, 160, 128)
UNIT_Z = 1 / np.linalg.norm(CAMERA.rays, axis=-1)


def srgb(linear: np.ndarray) -> np.ndarray:
    """The encoding of IEC 61966-2-1, written down independently of the decoding."""
    level = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.clip(np.rint(255 * level), 0, 255).astype(np.uint8)


def lit_frame(depth_mm: np.ndarray, exponent: float, albedo: float | np.ndarray = 1.0, power: float = 100.0) -> Frame:
    """A scene lit by a lamp at the camera that fades with the angle, as grey pixels."""
    distance_mm = depth_mm / UNIT_Z
    linear = albedo * power * UNIT_Z * distance_mm ** (-1 / exponent)
    return Frame(0, 0.0, np.repeat(srgb(linear)[..., None], 3, -1), CAMERA, np.ones(depth_mm.shape, bool))


def bowl() -> np.ndarray:
    x, y = CAMERA.rays[..., 0], CAMERA.rays[..., 1]
    return (30 + 12 * np.cos(2 * x) * np.cos(2 * y)).astype(np.float32)


def test_depth_comes_back_from_the_law_of_the_lamp() -> None:
    truth_mm = bowl()
    estimate = ShadingDepth(DepthSettings()).estimate(lit_frame(truth_mm, 0.6, power=0.4 * 18 ** (1 / 0.6)))
    assert estimate.kind == "depth"
    assert estimate.values.dtype == np.float32
    scaled = estimate.values * np.median(truth_mm) / np.median(estimate.values)
    assert np.mean(np.abs(scaled / truth_mm - 1)) < 0.03


def test_the_median_distance_of_the_first_frame_is_the_stated_prior() -> None:
    estimate = ShadingDepth(DepthSettings(shading_median_mm=42.0)).estimate(lit_frame(bowl(), 0.5, power=150.0))
    assert np.median(estimate.values / UNIT_Z) == pytest.approx(42.0, rel=1e-3)


@settings(max_examples=10, deadline=None)
@given(nearer=st.floats(0.5, 0.95))
def test_the_scale_is_held_so_that_approach_makes_depth_smaller(nearer: float) -> None:
    estimator = ShadingDepth(DepthSettings())
    first = estimator.estimate(lit_frame(bowl(), 0.6, power=23.0)).values
    second = estimator.estimate(lit_frame(nearer * bowl(), 0.6, power=23.0)).values
    assert np.median(second / first) == pytest.approx(nearer, rel=0.03)


def test_a_frame_that_shows_nothing_leaves_the_scale_to_the_next() -> None:
    estimator = ShadingDepth(DepthSettings())
    lit = lit_frame(bowl(), 0.5, power=150.0)
    assert np.isnan(estimator.estimate(replace(lit, rgb=np.zeros_like(lit.rgb))).values).all()
    expected = ShadingDepth(DepthSettings()).estimate(lit).values
    np.testing.assert_array_equal(estimator.estimate(lit).values, expected)


def test_highlights_and_overexposure_are_filled_from_around_them() -> None:
    plain = lit_frame(bowl(), 0.5, power=60.0)
    spotted = plain.rgb.copy()
    for x, y in ((30, 30), (80, 64), (120, 90)):
        cv2.circle(spotted, (x, y), 2, (255, 255, 255), -1)
    cv2.circle(spotted, (60, 100), 3, (225, 220, 215), -1)
    expected = ShadingDepth(DepthSettings()).estimate(plain).values
    found = ShadingDepth(DepthSettings()).estimate(replace(plain, rgb=spotted)).values
    np.testing.assert_allclose(found, expected, rtol=0.06)


def test_dark_surround_and_wide_masked_areas_stay_unknown() -> None:
    plain = lit_frame(bowl(), 0.5, power=150.0)
    rgb, valid = plain.rgb.copy(), plain.valid.copy()
    rgb[:, :20], valid[:, :20] = 0, False
    valid[40:100, 60:120] = False
    values = ShadingDepth(DepthSettings()).estimate(replace(plain, rgb=rgb, valid=valid)).values
    assert np.isnan(values[:, :20]).all()
    assert np.isnan(values[68:72, 88:92]).all()
    assert np.isfinite(values[valid]).all()


def test_smoothing_removes_texture_and_keeps_a_step_in_depth() -> None:
    depth_mm = np.where(np.arange(160) < 80, 10.0, 40.0) * np.ones((128, 1))
    mottled = 1 + 0.2 * np.random.default_rng(0).standard_normal(depth_mm.shape)
    values = (
        ShadingDepth(DepthSettings()).estimate(lit_frame(depth_mm, 0.6, np.clip(mottled, 0.5, 1.5), power=23.0)).values
    )
    near, far = values[30:98, 40:66], values[30:98, 94:120]
    assert np.median(far) / np.median(near) == pytest.approx(4.0, rel=0.1)
    assert np.std(near) / np.mean(near) < 0.03
    assert np.median(values[30:98, 81:83]) > 2 * np.median(values[30:98, 77:79])
