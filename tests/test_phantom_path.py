"""Camera paths of the phantom: read in every form, made up smooth, closed when asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.errors import InputError, SettingsError
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.trajectory.formats.text import read_poses
from scopemap_bench.phantom.camera_path import lumen_path, sweep_path
from scopemap_bench.phantom.render import prepare
from scopemap_bench.phantom.spec import PhantomSpec


def test_the_first_poses_of_a_file_are_used(tmp_path: Path) -> None:
    poses = lumen_path(12, False, 3)
    file = tmp_path / "path.txt"
    np.savetxt(file, poses.transpose(0, 2, 1).reshape(-1, 16))
    phantom = prepare(PhantomSpec(path_file=file, frames=7, width=32, height=32))
    np.testing.assert_allclose(phantom.poses, poses[:7], atol=1e-6)
    with pytest.raises(InputError, match="holds 12 poses, 13 frames"):
        prepare(PhantomSpec(path_file=file, frames=13, width=32, height=32))


@given(seed=st.integers(0, 10_000), frames=st.integers(2, 700), loop=st.booleans())
@settings(max_examples=25, deadline=None)
def test_made_up_paths_move_like_a_hand(seed: int, frames: int, loop: bool) -> None:
    frames = max(frames, 60 if loop else 2)
    for poses in (lumen_path(frames, loop, seed), sweep_path(frames, loop, seed)):
        steps = inverse(poses[:-1]) @ poses[1:]
        assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 1.5
        assert np.degrees(rotation_angle_rad(steps[:, :3, :3])).max() < 1.5
        assert np.abs(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < 1e-9


@pytest.mark.parametrize("make", [lumen_path, sweep_path])
def test_loop_closes_exactly_and_goes_somewhere(make: object) -> None:
    poses = make(300, True, 4)  # type: ignore[operator]
    np.testing.assert_array_equal(poses[-1], poses[0])
    distance = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    assert distance.max() > 10.0
    # No jump at the seam: the last step is as small as any other.
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps[-1] < 2 * steps.mean()


def test_a_loop_along_a_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="loop"):
        PhantomSpec(loop=True, path_file=tmp_path / "path.txt")


@pytest.mark.real
def test_real_pose_files_agree_in_both_forms(real_data: Path) -> None:
    plain = read_poses(real_data / "endoscopy" / "c3vd_camera_paths" / "c1v1.txt")
    stored = read_poses(real_data / "endoscopy" / "c3vd" / "cecum_t1_a" / "pose.txt")
    np.testing.assert_allclose(plain, stored, atol=1e-3)
