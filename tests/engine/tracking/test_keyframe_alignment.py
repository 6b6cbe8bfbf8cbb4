"""The alignment with a keyframe by its corners, and what supports it."""

from __future__ import annotations

import numpy as np
import pytest

from scopemap.engine.config import TrackingSettings
from scopemap.engine.flow.corners import Correspondences2D3D, KeyframeMatcher
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.tracking.keyframe_alignment import Keyframe, KeyframeAligner, MotionModel
from scopemap.engine.tracking.pyramid import build_pyramid
from tests.support import plane_scene
from tests.support.plane_scene import CAMERA, EVERYWHERE, PLANE_MM


@pytest.mark.parametrize(
    ("coverage", "off_px", "supported"), [(0.1, 0.0, True), (0.09, 0.0, False), (0.1, 1.9, True), (0.1, 2.1, False)]
)
def test_a_tenth_of_the_corners_within_two_pixels_supports_a_pose(
    coverage: float, off_px: float, supported: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, view, rng = TrackingSettings(), plane_scene.see(np.eye(4)), np.random.default_rng(0)
    frame = Frame(0, 0.0, view.rgb, CAMERA, EVERYWHERE, view.depth_mm)
    keyframe = Keyframe(frame, np.eye(4), build_pyramid(frame, settings), PLANE_MM, False, 0)
    pixels = rng.uniform([10, 10], [230, 170], (400, 2))
    # Off in four directions, which no motion explains.
    off = off_px * np.tile([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], (100, 1))
    matched = Correspondences2D3D(PLANE_MM * CAMERA.unproject(pixels), pixels + off, coverage, 0)
    monkeypatch.setattr(KeyframeMatcher, "match", lambda self, frame: matched)
    alignment = KeyframeAligner(settings, DisFlow(), MotionModel()).by_corners(keyframe, frame, np.eye(4))
    assert alignment is not None
    assert alignment.is_supported == supported
    assert alignment.coverage == coverage
