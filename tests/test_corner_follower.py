"""Corners of a keyframe in later frames, on a textured plane whose truth is a closed form, and in a whole run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import plane_scene
from plane_scene import CAMERA

from scopemap.flow.dis import DisFlow
from scopemap.flow.follow import CornerFollower
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse

HERE = plane_scene.pose()
THERE = plane_scene.pose(at_mm=(2.0, 0.6, 0.5), turn_rad=(0.01, -0.01, 0.02))


def _frame(index: int, T_world_camera: np.ndarray) -> Frame:
    view = plane_scene.see(T_world_camera)
    return Frame(index, index / 30, view.rgb, CAMERA, plane_scene.EVERYWHERE, view.depth_mm, T_world_camera)


def test_corners_are_found_where_the_plane_says() -> None:
    follower = CornerFollower(DisFlow(), 1.0)
    assert follower.find(_frame(1, THERE)) is None
    follower.start(_frame(4, HERE))
    seen = follower.find(_frame(5, THERE))
    assert seen is not None
    assert seen.host == 4
    assert 0.8 < seen.share <= 1
    T = inverse(THERE) @ HERE
    away = CAMERA.project(seen.points_mm @ T[:3, :3].T + T[:3, 3]) - seen.pixels
    assert np.median(np.linalg.norm(away, axis=1)) < 0.25


def test_corners_of_masked_or_unknown_tissue_are_not_followed() -> None:
    follower, frame = CornerFollower(DisFlow(), 1.0), _frame(0, HERE)
    half = plane_scene.EVERYWHERE.copy()
    half[:, 120:] = False
    follower.start(frame)
    seen = follower.find(replace(_frame(1, HERE), valid=half))
    assert seen is not None
    assert seen.pixels[:, 0].max() < 120.5
    follower.start(replace(frame, depth_mm=np.full_like(frame.depth_mm, np.nan)))
    assert follower.find(_frame(1, THERE)) is None
