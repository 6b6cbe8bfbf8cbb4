"""A run whose camera is lost for good: the largest map is kept, the rest is said to be elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import plane_scene
import pytest
from tiny_phantom import SIZE, true_poses, with_true_depth

from scopemap import Reconstruction, open_sequence, reconstruct
from scopemap.backend import Backend
from scopemap.config import BackendSettings
from scopemap.frame import Frame
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.phantom import PhantomSpec, write_phantom

FIRST, SECOND, GIVEN_UP = 6, 11, 2
LIGHT = {"networks__flow": "dis", "networks__perceptual": "structure", "odometry__new_map_after": GIVEN_UP}


@pytest.fixture(scope="module")
def spliced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of one scene, then eleven of another."""
    folder = tmp_path_factory.mktemp("maps")
    width, height = SIZE
    parts = (PhantomSpec(frames=FIRST, seed=3), PhantomSpec(scene="laparoscopy", frames=SECOND, seed=5))
    poses: list[str] = []
    for number, spec in enumerate(parts):
        write_phantom(spec.with_settings({"width": width, "height": height}), folder / str(number))
        for source in sorted((folder / str(number)).glob("0*_*")):
            index = int(source.name[:4]) + number * FIRST
            target = folder / "both" / f"{index:04d}{source.name[4:]}"
            target.parent.mkdir(exist_ok=True)
            shutil.copy(source, target)
        poses += (folder / str(number) / "pose.txt").read_text().splitlines()
    shutil.copy(folder / "0" / "camera.yaml", folder / "both")
    (folder / "both" / "pose.txt").write_text("\n".join(poses) + "\n")
    return folder / "both"


@pytest.fixture(scope="module")
def result(spliced: Path) -> Reconstruction:
    return reconstruct(open_sequence(spliced), with_true_depth(spliced, **LIGHT))


def test_the_largest_map_is_kept_and_the_rest_lost(result: Reconstruction) -> None:
    lost = FIRST + GIVEN_UP
    assert [r.track.status for r in result.records] == ["lost"] * lost + ["initial"] + ["ok"] * (SECOND - GIVEN_UP - 1)
    assert result.records[0].track.reason == "tracked in another map, number 0"
    assert "keyframe" in result.records[FIRST].track.reason
    note = next(text for text in result.provenance["warnings"] if text.startswith("maps:"))
    assert "there are 2" in note
    assert f"of {FIRST + SECOND - GIVEN_UP} frames tracked, the {SECOND - GIVEN_UP} of the largest" in note


def test_the_kept_map_is_right_and_its_world_is_its_first_frame(result: Reconstruction, spliced: Path) -> None:
    begin = FIRST + GIVEN_UP
    poses = result.trajectory.T_world_camera
    np.testing.assert_array_equal(poses[: begin + 1], np.broadcast_to(np.eye(4), (begin + 1, 4, 4)))
    off = inverse(poses[begin:]) @ true_poses(spliced, begin)[begin:]
    assert rotation_angle_rad(off[:, :3, :3]).max() < np.radians(0.5)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.5


def test_only_the_kept_map_is_fused(result: Reconstruction, spliced: Path) -> None:
    scene = spliced.parent / "1"
    alone = reconstruct(open_sequence(scene, frames=slice(GIVEN_UP, None)), with_true_depth(scene, **LIGHT))
    for one, other in zip(result.mesh.bounds, alone.mesh.bounds, strict=True):
        np.testing.assert_allclose(one, other, atol=2.0)


def test_where_frames_are_fused_as_they_come_there_is_one_map(spliced: Path) -> None:
    at_once = {"backend__method": "none", "fusion__voxel_mm": 1.0, "fusion__truncation_mm": 4.0}
    result = reconstruct(open_sequence(spliced), with_true_depth(spliced, **LIGHT, **at_once))
    assert [r.track.status for r in result.records] == ["initial"] + ["ok"] * (FIRST - 1) + ["lost"] * SECOND
    assert {record.track.map for record in result.records} == {0}
    assert len(result.mesh.faces) > 0


def test_maps_are_adjusted_apart() -> None:
    backend = Backend(BackendSettings())
    with pytest.raises(ValueError, match="no keyframe"):
        backend.adjust()
    for number in range(6):
        view = plane_scene.see(plane_scene.pose(at_mm=(2.0 * number, 0.5 * number, 0.0)))
        frame = Frame(
            10 * number,
            number / 3,
            view.rgb,
            plane_scene.CAMERA,
            plane_scene.EVERYWHERE,
            view.depth_mm,
            view.T_world_camera,
        )
        backend.add(frame, number % 2)
    assert [backend.keyframes(number) for number in range(3)] == [3, 3, 0]
    np.testing.assert_array_equal(backend.adjust(1).index, [10, 30, 50])
