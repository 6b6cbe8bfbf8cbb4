"""ORB displacement: which points match, where they are lifted to, and how far apart they then lie."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from scopemap_bench.evaluation.consistency import (
    Matches,
    displacement_figures,
    lifted_matches,
    match_features,
    orb_features,
)
from tests.support import plane_scene as scene
from tests.support.plane_scene import CAMERA, SIX_PIXELS_MM, PlaneImage, pose, see, true_flow

START = see(pose())
ASIDE = see(pose(at_mm=(SIX_PIXELS_MM, 0.0, 0.0)))


def matched(previous: PlaneImage, current: PlaneImage) -> Matches:
    return match_features(orb_features(previous.rgb), orb_features(current.rgb), CAMERA)


def exact_matches(previous: PlaneImage, current: PlaneImage) -> Matches:
    """Pixels of `current` on a grid, and where exactly they are in `previous`."""
    v, u = np.mgrid[20:160:20, 20:220:20]
    current_px = np.stack([u.ravel(), v.ravel()], -1)
    return Matches(current_px + true_flow(current, previous)[v.ravel(), u.ravel()], current_px.astype(float))


def apart_mm(lifted: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    return np.asarray(np.linalg.norm(lifted[0] - lifted[1], axis=1))


def test_a_camera_that_moves_six_pixels_aside_moves_its_matches_by_six_pixels() -> None:
    matches = matched(START, ASIDE)
    assert len(matches.current_px) > 100
    shift = matches.current_px - matches.previous_px
    assert np.median(shift, axis=0) == pytest.approx([-6, 0])
    assert np.quantile(np.abs(shift - [-6, 0]), 0.9) < 1


@pytest.mark.parametrize("turn_rad", [(0.0, 0.0, 0.0), (0.05, -0.1, 0.2)])
def test_exact_matches_lift_to_one_point_of_the_plane(turn_rad: tuple[float, ...]) -> None:
    view = see(pose(at_mm=(3.0, -2.0, 4.0), turn_rad=turn_rad))
    poses = (START.T_world_camera, view.T_world_camera)
    found = lifted_matches(exact_matches(START, view), START.depth_mm, view.depth_mm, CAMERA, poses)
    assert len(apart_mm(found)) > 50
    assert apart_mm(found).max() < 2e-3
    assert found[1][:, 2] == pytest.approx(scene.PLANE_MM, abs=1e-3)


def test_without_poses_the_displacement_is_the_camera_s_motion() -> None:
    matches = exact_matches(START, ASIDE)
    found = lifted_matches(matches, START.depth_mm, ASIDE.depth_mm, CAMERA)
    assert apart_mm(found) == pytest.approx(SIX_PIXELS_MM, abs=1e-3)


def test_matches_without_depth_at_both_ends_are_left_out() -> None:
    matches = Matches(
        np.array([[10.0, 10.0], [20.4, 20.4], [30.0, 30.0]]), np.array([[12.0, 10.0], [22.0, 20.0], [-3.0, 30.0]])
    )
    holes = START.depth_mm.copy()
    holes[10, 10] = np.nan
    found = lifted_matches(matches, holes, START.depth_mm, CAMERA)
    # The first starts in the hole, the last ends outside the image.
    assert len(apart_mm(found)) == 1
    assert found[1][0] == pytest.approx(50 * CAMERA.unproject(np.array([22.0, 20.0])))


def test_every_match_is_mutual_and_clear_as_opencv_s_own_matcher_finds_it() -> None:
    a, b = orb_features(START.rgb), orb_features(ASIDE.rgb)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forth = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(a[1], b[1], 2) if m.distance < 0.8 * n.distance}
    back = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(b[1], a[1], 2) if m.distance < 0.8 * n.distance}
    mutual = {(*a[0][i], *b[0][j]) for i, j in forth.items() if back.get(j) == i}
    matches = match_features(a, b, CAMERA)
    rows = {tuple(row) for row in np.hstack([matches.previous_px, matches.current_px])}
    assert rows <= mutual
    assert len(rows) > 0.9 * len(mutual)


def test_what_does_not_move_as_the_scene_is_no_match() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-15, 15, (200, 2)), rng.uniform(35, 70, 200)])
    previous_px, current_px = CAMERA.project(points), CAMERA.project(points - [2, 0, 0])
    # The camera moves along x: no point of a rigid scene moves along y.
    current_px[:40, 1] += rng.choice([-12, -6, 6, 12], 40)
    descriptors = rng.integers(0, 256, (200, 32), dtype=np.uint8)
    matches = match_features((previous_px, descriptors), (current_px, descriptors), CAMERA)
    assert np.abs(matches.current_px - matches.previous_px)[:, 1].max() < 1
    assert len(matches.current_px) == 160


def test_images_without_texture_have_no_features_and_no_matches() -> None:
    blank = orb_features(np.full_like(START.rgb, 90))
    assert blank[0].shape == (0, 2)
    assert len(match_features(blank, orb_features(START.rgb), CAMERA).current_px) == 0
    nothing = lifted_matches(match_features(blank, blank, CAMERA), START.depth_mm, START.depth_mm, CAMERA)
    assert apart_mm(nothing).shape == (0,)


def test_smooth_tissue_has_features_too() -> None:
    faint = cv2.GaussianBlur(START.rgb, (0, 0), 1.0) // 4 + 90
    assert len(orb_features(faint)[0]) > 100
    assert len(cv2.ORB.create(1000).detect(cv2.cvtColor(faint, cv2.COLOR_RGB2GRAY))) < 30


def test_sequence_statistics_pool_matches_and_keep_the_place_of_empty_pairs() -> None:
    rows = [np.array([1.0, 3.0]), np.empty(0), np.array([8.0])]
    summary = displacement_figures([np.stack([row, row / 10]) for row in rows])
    assert (summary["pairs"], summary["matches"], summary["mean_mm"], summary["median_mm"]) == (2, 3, 4, 3)
    assert summary["std_mm"] == pytest.approx(np.sqrt(26 / 3))
    assert (summary["relative_mean"], summary["relative_median"]) == pytest.approx((0.4, 0.3))
    assert summary["pair_matches"] == (2, 0, 1)
    assert summary["pair_mean_mm"] == pytest.approx((2, np.nan, 8), nan_ok=True)
    assert summary["pair_median_mm"] == pytest.approx((2, np.nan, 8), nan_ok=True)
    assert np.isnan(displacement_figures([])["mean_mm"])
