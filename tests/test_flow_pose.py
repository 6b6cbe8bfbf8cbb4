"""Flow's say in tracking: exact motions come back, outliers fade, and a pose that flow contradicts is not believed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import Config, TrackingSettings
from scopemap.frame import Correspondences2D3D, Frame
from scopemap.geometry.se3 import inverse, rotation_angle_rad, se3_exp
from scopemap.geometry.warp import carried_points
from scopemap.tracking import Tracker
from scopemap.tracking.flow_pose import flow_error_px, pose_by_flow, refined_by_corners

CAMERA = PinholeCamera(150.0, 151.0, 79.5, 63.5, 160, 128)
TWIST = np.array([0.05, -0.08, 0.1, 2.0, -1.5, 4.0])


def _seen(
    T: np.ndarray, count: int = 400, wild: float = 0.0, noise_px: float = 0.0, seed: int = 0
) -> Correspondences2D3D:
    random = np.random.default_rng(seed)
    pixels = random.uniform([5, 5], [155, 123], (count, 2))
    points = CAMERA.unproject(pixels) * random.uniform(20, 60, (count, 1))
    seen = CAMERA.project(points @ T[:3, :3].T + T[:3, 3]) + random.normal(0, noise_px, (count, 2))
    lost = random.random(count) < wild
    seen[lost] += random.uniform(-40, 40, (int(lost.sum()), 2))
    return Correspondences2D3D(points, seen, 0.8)


def _off(T: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    error = inverse(true) @ T
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle_rad(error[:3, :3])))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6), st.integers(0, 2**16))
def test_a_motion_that_explains_all_is_found_exactly(share: list[float], seed: int) -> None:
    T = se3_exp(np.array(share) * [0.15, 0.15, 0.15, 4.0, 4.0, 4.0])
    found = pose_by_flow(_seen(T, seed=seed), CAMERA)
    assert found is not None
    assert max(_off(found.T_current_previous, T)) < 1e-4
    assert found.error_px < 1e-3


def test_a_third_that_moves_by_itself_fades_out() -> None:
    T = se3_exp(TWIST)
    seen = _seen(T, wild=0.33, noise_px=0.3)
    found = pose_by_flow(seen, CAMERA)
    assert found is not None
    way_mm, turn_deg = _off(found.T_current_previous, T)
    assert way_mm < 0.15
    assert turn_deg < 0.15
    assert found.error_px == pytest.approx(flow_error_px(seen, CAMERA, found.T_current_previous))
    assert flow_error_px(seen, CAMERA, np.eye(4)) > 10 * found.error_px


def test_few_points_and_points_behind_say_nothing() -> None:
    assert pose_by_flow(_seen(np.eye(4), count=49), CAMERA) is None
    behind = _seen(np.eye(4))
    assert pose_by_flow(replace(behind, points_mm=-behind.points_mm), CAMERA) is None
    assert flow_error_px(replace(behind, points_mm=-behind.points_mm), CAMERA, np.eye(4)) == np.inf


def test_points_are_carried_from_where_flow_begins() -> None:
    """A wall, and a camera that moved 3 mm to the right: all is seen fx 3 / 40 px farther left."""
    depth_mm = np.full((128, 160), 40.0, np.float32)
    depth_mm[:, 100:] = np.nan
    to_previous = np.zeros((128, 160, 2), np.float32)
    to_previous[..., 0] = CAMERA.fx * 3 / 40
    consistent = np.zeros((128, 160), bool)
    consistent[10:90, 20:140] = True
    seen = carried_points(depth_mm, to_previous, consistent, CAMERA)
    assert 300 < len(seen.points_mm) < 3000
    moved = CAMERA.project(seen.points_mm - [3.0, 0.0, 0.0])
    np.testing.assert_allclose(moved, seen.pixels, atol=1e-4)
    # What lies in the consistent window and on the known part of the wall, of the whole image.
    assert seen.share == pytest.approx(80 * (100 - CAMERA.fx * 3 / 40 - 20) / (128 * 160), rel=0.05)
    assert seen.pixels[:, 0].min() == 20
    assert seen.pixels[:, 0].max() < 100
    found = pose_by_flow(seen, CAMERA)
    assert found is not None
    np.testing.assert_allclose(found.T_current_previous[:3, 3], [-3.0, 0.0, 0.0], atol=1e-3)
    nothing = carried_points(depth_mm, to_previous, np.zeros((128, 160), bool), CAMERA)
    assert len(nothing.points_mm) == nothing.share == 0


def _wall(shift_px: int, index: int, seen: Correspondences2D3D | None = None, soft_px: float = 0.0) -> Frame:
    """A wall of noise 40 mm away, white or soft, shifted by whole pixels."""
    noise = np.random.default_rng(3).normal(0, 1, (128, 400))
    if soft_px:
        noise = cv2.GaussianBlur(noise, (0, 0), soft_px)
    texture = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    rgb = np.repeat(texture[:, 100 + shift_px : 260 + shift_px, None], 3, -1)
    valid = np.ones((128, 160), bool)
    return Frame(
        index, index / 30, rgb, CAMERA, valid, np.full((128, 160), 40.0, np.float32), flow_correspondences=seen
    )


def _tracked(frame: Frame, soft_px: float = 0.0, **changes: float) -> tuple[Tracker, float, str, str]:
    tracker = Tracker(TrackingSettings(finest_level=0, lamp_gamma=0, **changes))
    first = _wall(0, 0, soft_px=soft_px)
    tracker.track(first)
    tracker.adopt(replace(first, T_world_camera=np.eye(4)), measured=False)
    track = tracker.track(frame)
    return tracker, float(track.T_world_camera[0, 3]), track.status, track.reason


WAY_MM = 40 * 40 / CAMERA.fx  # of 40 px


def _truly(T_current_previous: np.ndarray, share: float = 0.8) -> Correspondences2D3D:
    pixels = np.stack(np.meshgrid(np.arange(10, 150, 5), np.arange(10, 118, 5)), -1).reshape(-1, 2).astype(float)
    points = CAMERA.unproject(pixels) * 40.0
    return Correspondences2D3D(
        points, CAMERA.project(points @ T_current_previous[:3, :3].T + T_current_previous[:3, 3]), share
    )


def test_flow_decides_where_the_image_alone_goes_astray() -> None:
    """White noise that moves by a quarter of the image is out of any pyramid's reach."""
    moved = np.eye(4)
    moved[0, 3] = -WAY_MM
    frame = _wall(40, 1, _truly(moved))
    tracker, way_mm, status, reason = _tracked(frame)
    assert (status, reason) == ("ok", "flow decided")
    assert way_mm == pytest.approx(WAY_MM, abs=0.1)
    assert tracker.wants_keyframe()
    few = replace(frame, flow_correspondences=_truly(moved, share=0.09))
    # Landmarks would find the way as well.
    alone = {"remembered_keyframes": 0}
    for silent in (
        _tracked(frame, flow_contradiction=0, **alone),
        _tracked(replace(frame, flow_correspondences=None), **alone),
        _tracked(few, **alone),
    ):
        assert silent[2] == "lost" or abs(silent[1] - WAY_MM) > 1
        assert silent[3] != "flow decided"


def test_flow_has_no_say_where_it_agrees_or_is_in_disarray() -> None:
    near = np.eye(4)
    near[0, 3] = -2 * 40 / CAMERA.fx
    plain = _tracked(_wall(2, 1, soft_px=3), soft_px=3)
    assert plain[1] == pytest.approx(-near[0, 3], abs=0.1)
    assert plain[2] == "ok"
    agreeing = _tracked(_wall(2, 1, _truly(near), soft_px=3), soft_px=3)
    assert agreeing[1:] == plain[1:]
    random = np.random.default_rng(0)
    seen = _truly(near)
    disarray = Correspondences2D3D(seen.points_mm, random.uniform([0, 0], [160, 128], seen.pixels.shape), 0.8)
    assert _tracked(_wall(2, 1, disarray, soft_px=3), soft_px=3)[1:] == plain[1:]


def test_a_flow_that_jumps_does_not_lose_what_the_image_finds() -> None:
    far = np.eye(4)
    far[0, 3] = -30.0  # most of the mean depth in one frame
    plain = _tracked(_wall(2, 1, soft_px=3), soft_px=3)
    jumping = _tracked(_wall(2, 1, _truly(far), soft_px=3), soft_px=3)
    assert jumping[1:] == plain[1:]
    assert plain[2] == "ok"


def test_many_decisions_leave_a_pose_a_pose() -> None:
    """Each new keyframe begins with what is left of the last one's errors."""
    moved = np.eye(4)
    moved[0, 3] = -WAY_MM
    turned = se3_exp(np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])) @ moved
    # What correlates with nothing would be lost.
    tracker = Tracker(TrackingSettings(finest_level=0, lamp_gamma=0, min_correlation=-1))
    random = np.random.default_rng(0)
    track = tracker.track(_wall(0, 0))
    decided = 0
    for n in range(1, 46):
        noise = random.integers(0, 255, (128, 160, 1), np.uint8).repeat(3, -1)
        frame = replace(_wall(0, n, _truly(turned)), rgb=noise)
        tracker.adopt(replace(frame, T_world_camera=track.T_world_camera), measured=False)
        track = tracker.track(frame)
        decided += track.reason == "flow decided"
        R = track.T_world_camera[:3, :3]
        assert np.abs(R.T @ R - np.eye(3)).max() < 1e-12
    assert decided > 35


def test_the_paper_listens_to_no_flow() -> None:
    assert Config.load("paper").tracking.flow_contradiction == 0


def _corners(T_current_host: np.ndarray, depth_error: np.ndarray | float = 1.0, host: int = 0) -> Correspondences2D3D:
    """Corners on a rough wall, seen where a motion takes them, lifted by a depth that is wrong by a factor."""
    rng = np.random.default_rng(5)
    pixels = rng.uniform([10, 10], [150, 118], (300, 2))
    points = CAMERA.unproject(pixels) * rng.uniform(30, 60, (300, 1))
    seen = CAMERA.project(points @ T_current_host[:3, :3].T + T_current_host[:3, 3])
    return Correspondences2D3D(points * np.reshape(depth_error, (-1, 1)), seen, 0.9, host)


def test_corners_set_a_pose_right() -> None:
    true = se3_exp(np.array([0.02, -0.03, 0.05, 2.0, -1.0, 1.5]))
    start = se3_exp(np.array([0.01, 0.01, -0.01, 0.5, 0.5, -0.5])) @ true
    found = refined_by_corners(_corners(true), CAMERA, start, 0.2)
    assert found is not None
    np.testing.assert_allclose(found, true, atol=1e-6)


def test_wrong_depth_bends_a_turn_less_where_it_is_expected() -> None:
    true = se3_exp(np.array([0.02, -0.03, 0.05, 4.0, -2.0, 1.5]))

    def turn_off(share: float, seed: int) -> float:
        seen = _corners(true, np.exp(np.random.default_rng(seed).normal(0, 0.25, 300)))
        found = refined_by_corners(seen, CAMERA, true, share)
        assert found is not None
        return float(rotation_angle_rad((found @ inverse(true))[:3, :3]))

    expecting, trusting = (np.mean([turn_off(share, seed) for seed in range(20)]) for share in (0.2, 1e-6))
    assert expecting < 0.8 * trusting


def test_corners_that_move_by_themselves_fade_out() -> None:
    true = se3_exp(np.array([0.0, 0.01, 0.0, 1.0, 0.5, 0.0]))
    seen = _corners(true)
    pixels = seen.pixels.copy()
    pixels[:60] += [9.0, -6.0]
    found = refined_by_corners(replace(seen, pixels=pixels), CAMERA, true, 0.2)
    assert found is not None
    np.testing.assert_allclose(found, true, atol=0.05)


def test_too_few_corners_say_nothing() -> None:
    seen = _corners(np.eye(4))
    few = Correspondences2D3D(seen.points_mm[:49], seen.pixels[:49], 0.2, 0)
    assert refined_by_corners(few, CAMERA, np.eye(4), 0.2) is None


@pytest.mark.parametrize(("host", "share", "listens"), [(0, 0.2, True), (7, 0.2, False), (0, 0.0, False)])
def test_the_tracker_listens_to_corners_of_its_keyframe_alone(host: int, share: float, listens: bool) -> None:
    """Corners that place the camera a fifth of a millimetre aside of where the image does."""
    plain = _tracked(_wall(2, 1, soft_px=3), soft_px=3)
    aside = np.eye(4)
    aside[0, 3] = -(plain[1] + 0.2)
    frame = replace(_wall(2, 1, soft_px=3), keyframe_correspondences=_corners(aside, host=host))
    told = _tracked(frame, soft_px=3, corner_depth_share=share)
    assert told[2] == "ok"
    assert told[1] == pytest.approx(plain[1] + 0.2 * listens, abs=0.01)


def test_flow_in_disarray_bears_nothing_out() -> None:
    """A picture that hardly correlates is lost, whatever random places flow sees points in."""
    rng = np.random.default_rng(8)
    first = _wall(0, 0, soft_px=3)
    other = cv2.GaussianBlur(rng.normal(size=(128, 160)).astype(np.float32), (0, 0), 3)
    strange = np.repeat(np.clip(128 + 40 * other / other.std(), 0, 255).astype(np.uint8)[..., None], 3, -1)
    mixed = (0.25 * first.rgb + 0.75 * strange).astype(np.uint8)
    seen = _truly(np.eye(4))
    disarray = Correspondences2D3D(seen.points_mm, rng.uniform([0, 0], [160, 128], seen.pixels.shape), 0.8)
    alone = _tracked(replace(first, index=1, rgb=mixed), soft_px=3, min_inlier_share=0.6, remembered_keyframes=0)
    assert alone[2] == "lost"
    borne = replace(first, index=1, rgb=mixed, flow_correspondences=disarray)
    assert _tracked(borne, soft_px=3, min_inlier_share=0.6, remembered_keyframes=0)[2] == "lost"
