"""7-Scenes: colour, depth and poses of a Kinect's two cameras, brought to one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.config import DepthSettings
from scopemap.input.opening import open_sequence
from scopemap.runner.depth_backends import create_depth
from tests.support.drawn_inputs import number_in, poses, write_sevenscenes


def test_sevenscenes_bring_depth_and_poses_to_the_colour_camera(tmp_path: Path) -> None:
    folder = write_sevenscenes(tmp_path / "s")
    np.savetxt(folder / "camera-intrinsics.txt", [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    sequence = open_sequence(folder)
    assert sequence.source.name == "7-scenes"
    assert sequence.camera.fx == pytest.approx(525 / 2)
    assert any("depth camera" in note for note in sequence.notes)
    files = create_depth(DepthSettings(backend=f"files:{folder}"), sequence.depth_rectifier, "cpu")
    for (frame, truth), T_world_depth in zip(sequence, poses(3), strict=True):
        assert number_in(frame.rgb) == frame.index
        # The colour camera sits 25 mm to the depth camera's right.
        colour_in_depth_mm = np.linalg.inv(T_world_depth) @ truth.T_world_camera @ [0, 0, 0, 1]
        np.testing.assert_allclose(colour_in_depth_mm, [25, 0, 0, 1], atol=1e-6)
        np.testing.assert_array_equal(files.estimate(frame).values, truth.depth_mm)
        # A wall at 1500 mm, whose 10 first rows are unknown: the top edge is out of sight of the wider colour camera.
        rows, columns = np.nonzero(np.isfinite(truth.depth_mm))
        np.testing.assert_allclose(truth.depth_mm[rows, columns], 1500)
        assert rows.min() == pytest.approx((525 / 585 * (10 - 240) + 240) / 2, abs=1)
        assert columns.min() == pytest.approx((525 / 585 * -320 + 320 - 525 * 25 / 1500) / 2, abs=1)
        assert columns.max() == pytest.approx((525 / 585 * 319 + 320 - 525 * 25 / 1500) / 2, abs=1)


def test_sevenscenes_with_other_intrinsics_count_as_registered(tmp_path: Path) -> None:
    folder = write_sevenscenes(tmp_path / "s")
    np.savetxt(folder / "camera-intrinsics.txt", [[500, 0, 310], [0, 501, 250], [0, 0, 1]])
    (folder / "frame-000001.pose.txt").write_text("nan " * 16)
    sequence = open_sequence(folder)
    assert sequence.camera.fx == pytest.approx(250)
    assert any("registered" in note for note in sequence.notes)
    truths = [truth for _, truth in sequence]
    assert [truth.T_world_camera is None for truth in truths] == [False, True, False]
    np.testing.assert_allclose(truths[2].T_world_camera, poses(3)[2], atol=1e-6)
    assert np.isnan(truths[0].depth_mm[:4]).all()
    np.testing.assert_allclose(truths[0].depth_mm[6:], 1500)
