"""The geometric residual of tracking: closed forms on planes, its gradient, and what it is worth without texture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import TrackingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.engine.tracking.residuals import Loss, PyramidLevel, depth_residuals, normal_equations
from scopemap.engine.tracking.track import KeyframeDecision
from scopemap.engine.tracking.tracker import Tracker

CAMERA = PinholeCamera(70.0, 72.0, 39.2, 31.4, 80, 64)
UNIT_MM = 40.0
STILL = np.array([1.0, 0.0])
ONLY_DEPTH = Loss(np.ones(2), 1e6, np.zeros(2), np.array([True, False]), 0.0, depth_sigma=0.02, depth_share=0.7)


def _plane_mm(normal: np.ndarray, away_mm: float) -> np.ndarray:
    """Depth (H, W) of the plane normal . X = away_mm."""
    return away_mm / (CAMERA.rays @ normal)


def _level(depth_mm: np.ndarray) -> PyramidLevel:
    shape = depth_mm.shape
    intrinsics = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])
    blank = np.zeros((2, *shape), np.float32)
    return PyramidLevel(
        blank, np.ones(shape, np.float32), depth_mm.astype(np.float32), np.zeros((*shape, 2), np.float32), intrinsics
    )


NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
REFERENCE, CURRENT = _level(_plane_mm(np.array([0.26, -0.16, 0.95]), 39.5)), _level(_plane_mm(NORMAL, 40.0))
MOTION = se3_exp(np.array([0.01, -0.02, 0.015, 0.5, -0.3, 0.8]))


def test_on_a_plane_it_is_the_distance_to_the_plane() -> None:
    found = depth_residuals(REFERENCE, CURRENT, MOTION, UNIT_MM)
    moved = (CAMERA.rays * REFERENCE.depth_mm[..., None]) @ MOTION[:3, :3].T + MOTION[:3, 3]
    # Positive in front of the surface, where the current depth is larger.
    expected = (40.0 - moved @ NORMAL) / UNIT_MM
    used = np.isfinite(found)
    assert used.mean() > 0.8
    assert np.ptp(expected[used]) > 0.03
    np.testing.assert_allclose(found[used], expected[used], atol=1e-3)


def test_its_gradient_is_that_of_its_cost() -> None:
    # What leaves the image changes the cost by jumps.
    inner = np.zeros(REFERENCE.weight.shape, np.float32)
    inner[12:-12, 12:-12] = 1
    inside = REFERENCE._replace(weight=inner)
    equations = normal_equations(inside, CURRENT, MOTION, STILL, ONLY_DEPTH, UNIT_MM)
    step = 1e-4
    for k in range(6):
        twist = np.zeros(6)
        twist[k] = step * (1 if k < 3 else UNIT_MM)
        ahead, behind = (
            normal_equations(inside, CURRENT, se3_exp(side * twist) @ MOTION, STILL, ONLY_DEPTH, UNIT_MM).cost
            for side in (1, -1)
        )
        slope = (ahead - behind) / (2 * step)
        assert equations.gradient[k] == pytest.approx(slope, rel=0.03, abs=0.03 * np.sqrt(equations.hessian[k, k]))
    assert (equations.gradient[6:] == 0).all()


def test_unknown_depth_edges_and_other_tissue_do_not_count() -> None:
    depth_mm = _plane_mm(np.array([0.0, 0.0, 1.0]), 40.0)
    spoilt = depth_mm.copy()
    spoilt[10:20, 10:20] = np.nan  # unknown
    spoilt[30:40, 30:60] = 60.0  # something else, farther away
    found = depth_residuals(_level(depth_mm), _level(spoilt), np.eye(4), UNIT_MM)
    # Each pixel reads the four around where it lands.
    assert np.isnan(found[9:20, 9:20]).all()
    assert np.isnan(found[29:40, 29:60]).all()
    np.testing.assert_allclose(found[45:60, 5:75], 0.0, atol=1e-6)


def _bumpy(T_world_camera: np.ndarray, index: int) -> Frame:
    """A wall of bumps without any texture, seen from a pose, by marching along the rays."""
    rays = CAMERA.rays @ T_world_camera[:3, :3].T
    distance = np.full(rays.shape[:2], 30.0)
    for _ in range(60):
        x, y, z = np.moveaxis(rays * distance[..., None] + T_world_camera[:3, 3], -1, 0)
        surface = 40 + 3 * np.sin(x / 6 + 0.5) * np.cos(y / 5) + 1.5 * np.sin((x + 2 * y) / 9)
        distance += 0.6 * (surface - z)
    grey = np.full((*distance.shape, 3), 120, np.uint8)
    valid = np.ones(distance.shape, bool)
    return Frame(index, index / 30, grey, CAMERA, valid, distance.astype(np.float32), None)


def _tracked(frames: list[Frame], settings: TrackingSettings, *, measured: bool) -> list[np.ndarray]:
    tracker = Tracker(settings)
    tracker.track(frames[0])
    tracker.update(replace(frames[0], T_world_camera=np.eye(4)), KeyframeDecision("new"), measured=measured)
    return [tracker.track(frame).T_world_camera for frame in frames[1:]]


def test_shape_alone_is_tracked_where_depth_is_measured() -> None:
    step = se3_exp(np.array([0.004, -0.006, 0.008, 0.2, -0.15, 0.1]))
    poses = [np.linalg.matrix_power(step, n) for n in range(5)]
    frames = [_bumpy(T, n) for n, T in enumerate(poses)]
    settings = TrackingSettings(finest_level=0, checks="none")
    for found, true in zip(_tracked(frames, settings, measured=True), poses[1:], strict=True):
        error = inverse(true) @ found
        assert np.linalg.norm(error[:3, 3]) < 0.02
        assert np.degrees(rotation_angle_rad(error[:3, :3])) < 0.02
    blind = _tracked(frames, TrackingSettings(finest_level=0, checks="none", photometric="paper"), measured=True)
    assert np.linalg.norm((inverse(poses[-1]) @ blind[-1])[:3, 3]) > 0.3


def test_predicted_depth_of_a_frame_has_no_say_in_its_own_pose() -> None:
    random = np.random.default_rng(0)
    frames = [_bumpy(np.eye(4), 0), _bumpy(se3_exp(np.array([0.0, 0.0, 0.01, 0.3, 0.0, 0.0])), 1)]
    rgb = random.integers(40, 200, (64, 80, 3)).astype(np.uint8)
    frames = [replace(frame, rgb=np.roll(rgb, n, 1)) for n, frame in enumerate(frames)]
    spoilt = [frames[0], replace(frames[1], depth_mm=frames[1].depth_mm * np.float32(1.05))]
    settings = TrackingSettings(finest_level=0, checks="none")
    for measured in (False, True):
        one, other = (_tracked(some, settings, measured=measured)[0] for some in (frames, spoilt))
        assert np.array_equal(one, other) is not measured
