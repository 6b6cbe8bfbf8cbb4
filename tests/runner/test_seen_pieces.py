"""What is shown of a surface while it grows: nothing that was seen vanishes when tracking begins anew."""

from __future__ import annotations

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame
from scopemap.runner import seen_pieces
from scopemap.runner.seen_pieces import SeenPieces

CAMERA = PinholeCamera(fx=40, fy=40, cx=19.5, cy=14.5, width=40, height=30)


def frame(index: int, x_mm: float) -> Frame:
    """One that looks at a wall 20 mm away from x."""
    pose = np.eye(4)
    pose[0, 3] = x_mm
    shape = (CAMERA.height, CAMERA.width)
    rgb, depth_mm = np.full((*shape, 3), 90, np.uint8), np.full(shape, 20.0, np.float32)
    return Frame(index, index / 10, rgb, CAMERA, np.ones(shape, bool), depth_mm, pose)


def put(pieces: SeenPieces, *frames: Frame) -> None:
    for one in frames:
        pieces.put(one, with_points=True)


def test_earlier_pieces_stay_and_the_next_begins_where_the_camera_was() -> None:
    pieces = SeenPieces()
    put(pieces, frame(0, 0.0), frame(1, 5.0))
    before = pieces.map(frame(1, 0))
    assert before is not None
    assert len(before.earlier) == 0
    pieces.begin()
    put(pieces, frame(4, 0.0))
    seen = pieces.map(frame(4, 0))
    assert seen is not None
    np.testing.assert_array_equal(seen.earlier, before.points)
    assert seen.index.tolist() == [4]
    np.testing.assert_allclose(seen.T_world_camera[0, :3, 3], [5, 0, 0])
    assert np.isclose(seen.points[:, 2], 20).all()
    assert pieces.count == len(before.points) + len(seen.points)


def test_a_frame_that_is_tracked_again_takes_the_place_of_itself() -> None:
    pieces = SeenPieces()
    put(pieces, frame(0, 0.0), frame(1, 5.0))
    of_a_frame = pieces.count // 2
    pieces.begin()
    left = []
    for index in (0, 1):
        put(pieces, frame(index, 7.0 * index))
        seen = pieces.map(frame(index, 0))
        assert seen is not None
        left.append(len(seen.earlier))
    assert left == [of_a_frame, 0]


def test_where_there_are_many_points_every_frame_keeps_some(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seen_pieces, "_MOST_POINTS", 3000)
    pieces, spread = SeenPieces(), []
    for index in range(40):
        if index == 20:
            pieces.begin()
        put(pieces, frame(index, 2.0 * index if index < 20 else 2.0 * (index - 20)))
        seen = pieces.map(frame(index, 0))
        assert seen is not None
        shown = np.concatenate([seen.points, seen.earlier])
        assert len(shown) <= 3000
        spread.append(np.ptp(shown[:, 0]))
    step_mm = 5.0  # between points of a frame
    assert (np.diff(spread) > -step_mm).all(), "no part of the surface goes"
    assert spread[-1] > 2 * 38
