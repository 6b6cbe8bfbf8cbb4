"""The true trajectory of a sequence: cheap, stamped as the frames are, and the same as the truth frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.input import images
from scopemap.input.opening import open_sequence
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.input.video import VideoFile
from scopemap.result.reference import reference_trajectory
from scopemap_bench.datasets import scared
from scopemap_bench.datasets.scared import ScaredKeyframe
from tests.support.drawn_inputs import write_c3vd, write_sevenscenes
from tests.support.drawn_scared import write_scared, write_scared_c

Writer = Callable[[Path], Path]


@pytest.mark.parametrize(
    "write",
    [
        write_c3vd,
        lambda folder: write_sevenscenes(folder, 5),
        write_scared,
        lambda folder: write_scared_c(folder, [2, 3, 5, 9]),
    ],
    ids=["c3vd", "7-scenes", "scared", "scared-c"],
)
@pytest.mark.parametrize("selection", [slice(None), slice(1, None, 2)])
def test_it_is_the_truth_of_the_selected_frames(
    write: Writer, selection: slice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = open_sequence(write(tmp_path / "input"), frames=selection)
    expected = [(frame.index, frame.time_s, truth.T_world_camera) for frame, truth in sequence]

    def refuse(*_: object) -> None:
        raise AssertionError("an image or a depth file is read")

    for owner, name in (
        (VideoFile, "frames"),
        (ScaredKeyframe, "_depth_mm"),
        (scared, "decoded"),
        (images, "read_decoded"),
    ):
        monkeypatch.setattr(owner, name, refuse)
    reference = reference_trajectory(sequence)
    assert isinstance(reference, Trajectory)
    assert list(reference.indices) == [index for index, _, _ in expected]
    np.testing.assert_allclose(reference.times_s, [time_s for _, time_s, _ in expected])
    np.testing.assert_array_equal(reference.T_world_camera, [pose for _, _, pose in expected])
    assert list(reference.status) == ["initial"] + ["ok"] * (len(expected) - 1)
    assert reference.has_indices


def test_frames_without_a_pose_are_left_out(tmp_path: Path) -> None:
    folder = write_sevenscenes(tmp_path / "s", 4)
    (folder / "frame-000001.pose.txt").write_text("nan " * 16)
    (folder / "frame-000002.pose.txt").unlink()
    assert list(reference_trajectory(open_sequence(folder)).indices) == [0, 3]
