"""Carrying depth between frames: moved points, exact flow of a plane, filtering that respects holes and edges.

`pull` is tested in test_flow.py.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.se3 import se3, se3_exp
from scopemap.engine.geometry.warp import bilateral_filtered, moved_depth, resampled

CAMERA = PinholeCamera(70.0, 75.0, 30.2, 22.9, 64, 48)
SHAPE = (48, 64)
STILL = np.zeros((*SHAPE, 2), np.float32)


def test_resampled_depth_keeps_a_planes_inverse_slope_and_its_holes() -> None:
    large = CAMERA.resized(128, 96)
    y, x = np.mgrid[:48, :64].astype(np.float32)
    ramp = 40 + x - 0.5 * y
    ramp[10, 20] = np.nan
    found = resampled(ramp, large)
    v, u = np.mgrid[:96, :128].astype(np.float32)
    expected = 40 + (u - 0.5) / 2 - (v - 0.5) / 4
    inside = np.s_[1:-1, 1:-1]
    near = np.abs(found - expected)[inside]
    assert np.isnan(found).sum() == 4
    assert np.isnan(found[20:22, 40:42]).all()
    assert np.sort(near[np.isfinite(near)])[:-12].max() < 1e-4  # but for the nearest values around the hole
    assert near[np.isfinite(near)].max() < 0.5
    np.testing.assert_array_equal(resampled(ramp, CAMERA), ramp)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_moved_depth_is_the_points_own(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = se3_exp(rng.normal(0, [0.1] * 3 + [5.0] * 3))
    depth = rng.uniform(20, 90, SHAPE).astype(np.float32)
    flow = rng.normal(0, 4, (*SHAPE, 2)).astype(np.float32)
    moved = moved_depth(depth, flow, CAMERA, T)
    assert moved.dtype == np.float32
    for v, u in rng.integers(0, SHAPE, (20, 2)):
        ray = CAMERA.unproject(np.array([u, v]) + flow[v, u])
        assert moved[v, u] == pytest.approx((T @ [*(depth[v, u] * ray), 1])[2], rel=1e-5)


def test_what_falls_behind_the_camera_is_unknown() -> None:
    depth = np.full(SHAPE, 50.0, np.float32)
    depth[:, :10] = 10.0
    moved = moved_depth(depth, STILL, CAMERA, se3(np.eye(3), np.array([0.0, 0.0, -10.0])))
    assert np.isnan(moved[:, :10]).all()
    np.testing.assert_allclose(moved[:, 10:], 40.0, rtol=1e-6)
    assert np.isnan(moved_depth(depth, STILL, CAMERA, se3(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)))).all()


def test_filter_keeps_unknown_pixels_and_their_neighbours() -> None:
    depth = np.full(SHAPE, 40.0, np.float32)
    depth[10:20, 10:20] = np.nan
    depth[0, 0] = np.nan
    filtered = bilateral_filtered(depth, 2.0, 2.0)
    np.testing.assert_array_equal(np.isnan(filtered), np.isnan(depth))
    np.testing.assert_allclose(filtered[np.isfinite(depth)], 40.0, rtol=1e-5)
    assert filtered.dtype == np.float32


def test_filter_matches_its_formula_at_one_pixel() -> None:
    depth = np.random.default_rng(6).uniform(38, 42, (21, 21)).astype(np.float32)
    sigma_px, sigma_mm = 1.5, 1.0
    v, u = np.mgrid[-10:11, -10:11]
    # OpenCV cuts the window at 1.5 sigma.
    near = np.hypot(u, v) <= round(1.5 * sigma_px)
    weight = near * np.exp(-(u**2 + v**2) / (2 * sigma_px**2) - (depth - depth[10, 10]) ** 2 / (2 * sigma_mm**2))
    expected = (weight * depth).sum() / weight.sum()
    assert bilateral_filtered(depth, sigma_px, sigma_mm)[10, 10] == pytest.approx(expected, abs=2e-3)


def test_filter_off_and_filter_of_nothing() -> None:
    depth = np.random.default_rng(7).uniform(10, 90, SHAPE).astype(np.float32)
    assert bilateral_filtered(depth, 0.0, 2.0) is depth
    assert np.isnan(bilateral_filtered(np.full(SHAPE, np.nan, np.float32), 2.0, 2.0)).all()
