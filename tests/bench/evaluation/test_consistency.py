"""Consistency in time: planes seen by moving cameras, flicker of known size, masks, and real truth."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import SettingsError
from scopemap.engine.geometry.se3 import inverse, se3, se3_exp, so3_exp
from scopemap_bench.evaluation.consistency import (
    ConsistencyMeter,
    FrameCorrespondences,
    FrameMatcher,
    alignment_errors,
    depth_change,
    mean_change,
    projected_depth,
)
from tests.support.plane_scene import CAMERA, EVERYWHERE, PLANE_MM, SIX_PIXELS_MM, PlaneImage, pose, see, true_flow

STILL = [pose()] * 4
ASIDE = [pose(at_mm=(k * SIX_PIXELS_MM, 0.0, 0.0)) for k in range(3)]
FORWARD = [pose(at_mm=(0.0, 0.0, 2.0 * k)) for k in range(3)]
TILTED_ASIDE = [pose(at_mm=(k * SIX_PIXELS_MM, 0.0, 0.0), turn_rad=(0.0, 0.4, 0.0)) for k in range(3)]
WANDERING = [pose(at_mm=(k, -k, 0.5 * k), turn_rad=(0.02 * k, 0.03 * k, -0.05 * k)) for k in range(3)]


def links(views: list[PlaneImage], flow_sign: float = 1.0) -> list[FrameCorrespondences | None]:
    matcher = FrameMatcher(CAMERA)
    flows = [None, *(flow_sign * true_flow(view, before) for before, view in itertools.pairwise(views))]
    return [matcher.match(view.rgb, EVERYWHERE, flow) for view, flow in zip(views, flows, strict=True)]


def measure(
    poses: list[np.ndarray],
    factors: list[float] | None = None,
    told_poses: list[np.ndarray] | None = None,
    flow_sign: float = 1.0,
) -> dict[str, Any]:
    """Measure exact depth, times a factor per frame, with the true poses as reference or those that are told."""
    views = [see(T) for T in poses]
    meter = ConsistencyMeter(CAMERA)
    told, factors = told_poses or poses, factors or [1.0] * len(poses)
    for view, T, factor, link in zip(views, told, factors, links(views, flow_sign), strict=True):
        depth_mm = np.float32(factor) * view.depth_mm
        meter.add(depth_mm, EVERYWHERE, link, T_reference_camera=T, true_depth_mm=view.depth_mm)
    return meter.report()


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return repr(a) == repr(b)


# ---- exact depth


def test_approach_is_change_of_depth_until_the_poses_explain_it() -> None:
    report = measure(FORWARD)
    for change in (report["same_pixel"], report["along_flow"], report["opw"]):
        assert change["mean_mm"] == pytest.approx(2, rel=1e-4)
        assert change["relative"] == pytest.approx((2 / 48 + 2 / 46) / 2, rel=1e-4)
        assert change["rtc"] == 0
    assert report["opw_reference"]["mean_mm"] < 1e-3
    assert report["opw_reference"]["rtc"] == 1
    assert report["tae_reference"]["percent"] < 1e-3
    # Matches lie on whole pixels, a third of a millimetre wide; the approach is 2 mm.
    assert report["orb_reference"]["median_mm"] < 0.25
    assert report["orb_camera"]["median_mm"] > 1.8


@pytest.mark.parametrize("poses", [TILTED_ASIDE, WANDERING])
def test_exact_depth_of_a_tilted_plane_is_consistent_up_to_the_rounding_to_pixels(poses: list[np.ndarray]) -> None:
    report = measure(poses)
    assert report["tae_reference"]["percent"] < 0.2
    assert report["opw_reference"]["relative"] < 1e-3
    assert report["opw_reference"]["rtc"] > 0.999
    assert report["orb_reference"]["relative_median"] < 5e-3


def test_transposed_poses_are_found_out() -> None:
    rows_for_columns = [se3(T[:3, :3].T, T[:3, 3]) for T in WANDERING]
    told = [inverse(T) for T in WANDERING]
    for wrong in (rows_for_columns, told):
        report = measure(WANDERING, told_poses=wrong)
        assert report["tae_reference"]["percent"] > 1
        assert report["opw_reference"]["relative"] > 1e-2
        assert report["orb_reference"]["relative_median"] > 2e-2


# ---- flicker


@pytest.mark.parametrize("e", [0.004, 0.006, 0.05])
def test_flicker_of_a_still_camera_has_its_closed_forms(e: float) -> None:
    report = measure(STILL, [1 + e, 1 - e, 1 + e, 1 - e])
    step = np.log((1 + e) / (1 - e))
    assert report["jitter"]["log_std"] == pytest.approx(step / 2, rel=1e-4)
    assert report["jitter"]["log_step"] == pytest.approx(step, rel=1e-4)
    for change in (report["same_pixel"], report["along_flow"], report["opw"], report["opw_reference"]):
        assert change["mean_mm"] == pytest.approx(2 * e * PLANE_MM, rel=1e-3)
        # Two of the three pairs end on the lower value.
        assert change["relative"] == pytest.approx((2 * 2 * e / (1 - e) + 2 * e / (1 + e)) / 3, rel=1e-3)
        assert change["rtc"] == (1 if e < 0.005 else 0)
    assert report["tae_reference"]["percent"] == pytest.approx(200 * e / (1 - e**2), rel=1e-3)


@pytest.mark.parametrize("poses", [STILL, FORWARD + FORWARD[-1:], [*TILTED_ASIDE, TILTED_ASIDE[-1]]])
def test_the_largest_step_is_that_of_depth_at_one_frame_and_not_the_camera_motion(poses: list[np.ndarray]) -> None:
    steady = measure(poses)["opw_reference"]
    assert steady["largest_step_mm"] < 0.02
    report = measure(poses, [1.0, 1.0, 1.0, 1.03])["opw_reference"]
    last_mm = float(np.median(see(poses[-1]).depth_mm))
    assert report["largest_step_mm"] == pytest.approx(0.03 * last_mm, rel=0.02)
    # Means hide it among the pairs.
    assert report["mean_mm"] < 0.4 * report["largest_step_mm"]


# ---- scale, poses of the method's own


def test_scale_serves_depth_and_estimated_poses_and_leaves_relative_figures() -> None:
    views = [see(T) for T in WANDERING]
    reports = []
    for unit, scale in ((1.0, 1.0), (0.1, 1.0), (0.1, 10.0)):
        meter = ConsistencyMeter(CAMERA, scale)
        for view, link in zip(views, links(views), strict=True):
            own_pose = se3(view.T_world_camera[:3, :3], unit * view.T_world_camera[:3, 3])
            told = {"T_world_camera": own_pose, "T_reference_camera": view.T_world_camera}
            meter.add(unit * view.depth_mm, EVERYWHERE, link, **told)
        reports.append(meter.report())
    exact, tiny, restored = reports
    assert restored["scale"] == 10
    assert tiny["opw"]["mean_mm"] == pytest.approx(0.1 * exact["opw"]["mean_mm"], rel=1e-4)
    for name in ("mean_mm", "relative", "rtc"):
        assert restored["opw_estimated"][name] == pytest.approx(exact["opw_estimated"][name], abs=1e-4)
        assert restored["opw_reference"][name] == pytest.approx(exact["opw_reference"][name], abs=1e-4)
    # Its own poses agree with its own depth at any scale; the reference's poses do not.
    assert tiny["tae_estimated"]["percent"] == pytest.approx(exact["tae_estimated"]["percent"], abs=1e-3)
    assert tiny["tae_reference"]["percent"] > 5


def test_reference_poses_win_where_there_are_any_and_lost_frames_have_none() -> None:
    meter, matcher = ConsistencyMeter(CAMERA), FrameMatcher(CAMERA)
    for number, view in enumerate(map(see, ASIDE + ASIDE[:1])):
        own_pose = None if number == 1 else view.T_world_camera
        meter.add(view.depth_mm, EVERYWHERE, matcher.match(view.rgb, EVERYWHERE), T_world_camera=own_pose)
    report = meter.report()
    assert (report["frames"], report["pairs"]) == (4, 3)
    assert (report["tae_estimated"]["pairs"], report["tae_reference"]["pairs"]) == (1, 0)
    assert (report["orb_estimated"]["pairs"], report["orb_reference"]["pairs"]) == (1, 0)
    assert report["orb_camera"]["pairs"] == 3
    # Without flow nothing along it is measured; without truth there is no jitter.
    assert (report["opw"]["pairs"], report["along_flow"]["pairs"], report["same_pixel"]["pairs"]) == (0, 0, 3)
    assert np.isnan([report["opw"]["mean_mm"], report["jitter"]["log_std"], report["tae_reference"]["percent"]]).all()


# ---- masks and missing values


def test_what_is_masked_unknown_or_impossible_does_not_count() -> None:
    views = [see(T) for T in WANDERING]
    valid = EVERYWHERE.copy()
    valid[60:120, 90:150] = False
    reports = []
    for rubbish, mask in ((1.0, valid), (500.0, valid), (np.nan, EVERYWHERE), (0.0, EVERYWHERE), (-5.0, EVERYWHERE)):
        meter = ConsistencyMeter(CAMERA)
        for view, link in zip(views, links(views), strict=True):
            depth_mm = np.where(valid, view.depth_mm, np.float32(rubbish))
            meter.add(depth_mm, mask, link, T_reference_camera=view.T_world_camera)
        reports.append(meter.report())
    assert all(same(report, reports[0]) for report in reports)
    whole = measure(WANDERING)
    assert reports[0]["orb_reference"]["matches"] < whole["orb_reference"]["matches"]
    assert reports[0]["opw_reference"]["relative"] < 1e-3


# ---- the measures of one pair


def test_change_of_two_maps_computed_by_hand() -> None:
    change = depth_change(np.array([[11.0, 20.1, np.nan]]), np.array([[10.0, 20.0, 5.0]]))
    assert (change["mean_mm"], change["relative"], change["rtc"]) == pytest.approx((0.55, (0.1 + 0.005) / 2, 0.5))
    # One of three pixels at a depth edge is no step of the frame.
    assert depth_change(np.array([[11.0, 20.1, 90.0]]), np.array([[10.0, 20.0, 5.0]]))["median_mm"] == pytest.approx(1)
    other = depth_change(np.array([[12.0]]), np.array([[10.0]]))
    nothing = depth_change(np.array([[np.nan]]), np.array([[10.0]]))
    mean = mean_change([change, nothing, other])
    assert (mean["pairs"], mean["mean_mm"], mean["rtc"]) == (2, pytest.approx((0.55 + 2) / 2), 0.25)
    assert mean["largest_step_mm"] == pytest.approx(2)
    assert np.isnan(mean_change([nothing])["largest_step_mm"])
    assert depth_change(np.array([[1.01]]), np.array([[1.0]]))["rtc"] == 0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_tae_is_what_its_public_definition_says_pixel_by_pixel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = PinholeCamera(9.0, 8.0, 5.3, 4.1, 11, 9)
    maps = [rng.uniform(5, 60, (9, 11)).astype(np.float32) for _ in range(2)]
    maps[0][rng.random((9, 11)) < 0.1] = np.nan
    T = se3_exp(rng.normal(size=6) * [0.05, 0.05, 0.05, 4, 4, 8])
    expected = [_tae_by_hand(maps[0], maps[1], camera, T), _tae_by_hand(maps[1], maps[0], camera, inverse(T))]
    assert alignment_errors(maps[0], maps[1], camera, T) == pytest.approx(expected, rel=1e-4)


def _tae_by_hand(depth_1: np.ndarray, depth_2: np.ndarray, camera: PinholeCamera, T_2_1: np.ndarray) -> float:
    splat = np.zeros_like(depth_2)
    for v, u in np.ndindex(depth_1.shape):
        if not np.isnan(depth_1[v, u]):
            point = T_2_1 @ [*(float(depth_1[v, u]) * np.linalg.inv(camera.matrix) @ [u, v, 1]), 1]
            column, row = (int(np.round(x)) for x in (camera.matrix @ point[:3])[:2] / point[2])
            if 0 <= row < camera.height and 0 <= column < camera.width:
                splat[row, column] = point[2]
    errors = [abs(a - b) / b for a, b in zip(splat.ravel(), depth_2.ravel(), strict=True) if a > 0 and b > 0]
    return float(np.mean(errors))


def test_points_behind_the_camera_and_views_that_do_not_meet_are_not_compared() -> None:
    depth_mm = see(pose()).depth_mm
    about = se3(so3_exp(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    assert np.isnan(projected_depth(depth_mm, CAMERA, about)).all()
    assert np.isnan(alignment_errors(depth_mm, depth_mm, CAMERA, about)).all()


def test_unusable_arguments_are_refused() -> None:
    with pytest.raises(SettingsError, match="scale of depth is 0"):
        ConsistencyMeter(CAMERA, 0.0)
    with pytest.raises(ValueError, match="depth_mm"):
        ConsistencyMeter(CAMERA).add(np.ones((3, 3)), EVERYWHERE)
