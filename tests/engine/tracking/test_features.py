"""Features on a textured plane whose truth is a closed form, and what is not known again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.engine.tracking.alike import AlikeFeatures
from scopemap.engine.tracking.features import (
    FeatureDetector,
    SiftFeatures,
    match_features,
    relative_pose_pnp,
    similarities,
)
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA

HERE = plane_scene.pose()
# Half of the picture's width to the side, turned by some 20 degrees about the axis: far beyond what alignment bridges.
THERE = plane_scene.pose(at_mm=(30.0, 8.0, 6.0), turn_rad=(0.08, -0.12, 0.35))
DETECTORS: list[FeatureDetector] = [SiftFeatures(), AlikeFeatures()]


@pytest.fixture(params=DETECTORS, ids=lambda detector: detector.name)
def detector(request: pytest.FixtureRequest) -> FeatureDetector:
    return request.param


def test_the_pose_of_a_far_view_is_found_from_features(detector: FeatureDetector) -> None:
    known, seen = (
        detector.detect(plane_scene.frame(HERE)),
        detector.detect(replace(plane_scene.frame(THERE), depth_mm=None)),
    )
    located = relative_pose_pnp(known, seen, CAMERA, min_inliers=20)
    assert located is not None
    off = located.T_current_reference @ inverse(HERE) @ THERE
    assert rotation_angle_rad(off[:3, :3]) < np.radians(0.5)
    assert np.linalg.norm(off[:3, 3]) < 0.5
    # The pairs are where the truth says.
    T = inverse(THERE) @ HERE
    moved = known.points_mm[located.pairs[:, 0]] @ T[:3, :3].T + T[:3, 3]
    away = np.linalg.norm(CAMERA.project(moved) - seen.pixels[located.pairs[:, 1]], axis=1)
    assert np.median(away) < {"sift": 0.5, "alike": 0.7}[detector.name]
    assert len(located.pairs) >= 20


def test_masked_pixels_have_no_features(detector: FeatureDetector) -> None:
    half = plane_scene.EVERYWHERE.copy()
    half[:, 120:] = False
    assert detector.detect(replace(plane_scene.frame(HERE), valid=half)).pixels[:, 0].max() < 120
    nothing = detector.detect(replace(plane_scene.frame(HERE), valid=np.zeros_like(half)))
    assert nothing.pixels.shape == (0, 2)
    assert match_features(nothing, detector.detect(plane_scene.frame(HERE))).shape == (0, 2)


@pytest.mark.parametrize("what", ["another place", "no depth", "too many required"])
def test_no_pose_without_enough_inliers(what: str, detector: FeatureDetector) -> None:
    known, least = plane_scene.frame(HERE), 20
    seen = detector.detect(plane_scene.frame(THERE))
    if what == "another place":
        noise = np.random.default_rng(3).integers(0, 255, known.rgb.shape, dtype=np.uint8)
        known = replace(known, rgb=noise)
    elif what == "no depth":
        known = replace(known, depth_mm=None)
    else:
        least = 10_000
    assert relative_pose_pnp(detector.detect(known), seen, CAMERA, least) is None


def test_similarities_of_many_pictures_are_those_of_each() -> None:
    random = np.random.default_rng(0)
    drawn = [random.normal(size=(count, 8)).astype(np.float32) for count in (9, 0, 1, *[12] * 70)]
    own, *pictures = (some / np.linalg.norm(some, axis=1, keepdims=True) for some in drawn)
    each = [similarities(own, [picture])[0] for picture in pictures]
    np.testing.assert_allclose(similarities(own, pictures), each, rtol=1e-6)
    assert each[0] == 0
    nearest = (own @ pictures[5].T).max(1)
    assert each[5] == pytest.approx(np.maximum(nearest - 0.8, 0).sum(), rel=1e-5)
    assert similarities(own[:0], pictures).tolist() == [0.0] * len(pictures)
