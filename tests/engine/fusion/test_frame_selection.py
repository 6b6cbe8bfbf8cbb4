"""Which frames are fused: those that show tissue anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_selection import FrameSelector

CAMERA = PinholeCamera(fx=150.0, fy=150.0, cx=79.5, cy=63.5, width=160, height=128)


def seen(index: int, *, x_mm: float = 0.0, z_mm: float = 0.0, quality: float = 1.0, unit: float = 1.0) -> Frame:
    """Return a frame of a wall 50 mm from the world's origin, in other units than mm where `unit` is not 1."""
    size = (CAMERA.height, CAMERA.width)
    pose = np.eye(4)
    pose[:3, 3] = unit * x_mm, 0.0, unit * z_mm
    depth_mm = np.full(size, unit * (50.0 - z_mm), np.float32)
    rgb, valid = np.zeros((*size, 3), np.uint8), np.ones(size, bool)
    return Frame(index, index / 30, rgb, CAMERA, valid, depth_mm, pose, quality=quality)


def indices(frames: list[Frame], every: int = 0) -> list[int]:
    return [frame.index for frame in FrameSelector(every).among(frames)]


def test_one_in_four_frames_of_a_camera_at_rest_counts_for_the_others() -> None:
    chosen = list(FrameSelector().among(seen(index) for index in range(10)))
    assert [frame.index for frame in chosen] == [0, 4, 8]
    assert chosen[0].weight is None
    assert all(np.all(np.asarray(frame.weight) == 4) for frame in chosen[1:])


@pytest.mark.parametrize("other", [{"x_mm": 5.0}, {"z_mm": 12.0}], ids=["another side", "nearer"])
def test_a_frame_from_elsewhere_is_fused(other: dict[str, float]) -> None:
    assert indices([seen(0), seen(1), seen(2, **other), seen(3, **other)]) == [0, 2]


def test_a_frame_that_is_much_sharper_is_fused() -> None:
    assert indices([seen(0, quality=0.5), seen(1, quality=0.6), seen(2), seen(3)]) == [0, 2]


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_a_moving_camera_is_followed_the_same_at_any_scale(unit: float) -> None:
    slow, fast = ([seen(index, x_mm=step * index, unit=unit) for index in range(40)] for step in (0.2, 2.0))
    assert len(indices(slow)) <= 20
    assert len(indices(fast)) >= 35


def test_the_same_place_in_another_world_is_fused() -> None:
    selector = FrameSelector()
    assert selector.chosen(seen(0)) is not None
    assert selector.chosen(seen(1)) is None
    assert selector.chosen(seen(2), world=1) is not None


def test_every_third_frame_where_that_is_set() -> None:
    frames = [seen(index) for index in range(7)]
    assert indices(frames, every=3) == [0, 3, 6]
    assert all(frame.weight is None for frame in FrameSelector(3).among(frames))


def test_a_frame_without_usable_depth_is_left_out_most_often() -> None:
    unknown = replace(seen(0), valid=np.zeros((CAMERA.height, CAMERA.width), bool))
    assert indices([unknown, seen(1), seen(2)]) == [1]
