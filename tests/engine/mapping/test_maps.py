"""Submaps of a run whose camera is lost for good: those of the same place are merged, the largest is the result."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import trimesh

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import Config, MappingSettings
from scopemap.engine.depth.mapis import Mapis
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, so3_exp
from scopemap.engine.mapping import Backend, Mapper, TrackedPose
from scopemap.engine.mapping.correction import FinalFrames
from scopemap.engine.mapping.pose_graph import PoseGraph, optimise_pose_graph
from scopemap.engine.tracking.relocalisation import Relocaliser
from scopemap.engine.tracking.track import Track
from scopemap.evaluation.poses import match, pose_report
from scopemap.result.depth_maps import DepthReader
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap_bench.climb.submission import submission_problems, write_submission
from scopemap_bench.datasets.c3vd import C3vdFolder
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from tests.support import plane_scene
from tests.support.front_door import said, warned
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import SIZE, true_poses, with_true_depth

pytestmark = pytest.mark.slow

FIRST, SECOND, LOST_BEFORE_NEW = 10, 13, 2
LIGHT = {
    "networks__flow": "dis",
    "networks__perceptual": "structure",
    "tracking__new_map_after": LOST_BEFORE_NEW,
    "fusion__colours": "raw",
}


def _spliced(target: Path, frames: list[tuple[Path, int]]) -> Path:
    """A sequence of frames of phantoms, by their folders and numbers."""
    target.mkdir()
    poses = []
    for number, (folder, index) in enumerate(frames):
        for source in folder.glob(f"{index:04d}_*"):
            shutil.copy(source, target / f"{number:04d}{source.name[4:]}")
        poses.append((folder / "pose.txt").read_text().splitlines()[index])
    shutil.copy(frames[0][0] / "camera.yaml", target)
    (target / "pose.txt").write_text("\n".join(poses) + "\n")
    return target


@pytest.fixture(scope="module")
def spliced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten frames of one scene, then thirteen of another."""
    folder, (width, height) = tmp_path_factory.mktemp("maps"), SIZE
    write_phantom(PhantomSpec(frames=FIRST, seed=3, width=width, height=height), folder / "0")
    write_phantom(PhantomSpec(frames=SECOND, seed=5, width=width, height=height), folder / "1")
    frames = [(folder / "0", n) for n in range(FIRST)] + [(folder / "1", n) for n in range(SECOND)]
    return _spliced(folder / "both", frames)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run") / "out"


@pytest.fixture(scope="module")
def begun() -> list[float]:
    """The scales at which the maps of the result begin."""
    return []


@pytest.fixture(scope="module")
def result(spliced: Path, out: Path, begun: list[float]) -> Result:
    def rescale(self: Mapis, scale: float) -> None:
        begun.append(scale)
        whole(self, scale)

    whole = Mapis.rescale
    with patch.object(Mapis, "rescale", rescale):
        return reconstruct(open_sequence(spliced), with_true_depth(spliced, **LIGHT), out=out)


def test_the_largest_submap_is_the_result_and_other_frames_are_lost_or_in_other_maps(result: Result) -> None:
    rest = SECOND - LOST_BEFORE_NEW
    other = ["other-map"] * FIRST + ["lost"] * LOST_BEFORE_NEW
    assert result.frames["status"].tolist() == [*other, "initial", *["ok"] * (rest - 1)]
    assert result.frames["map"].tolist() == [1] * FIRST + [-1] * LOST_BEFORE_NEW + [0] * rest
    assert result.lost["index"].tolist() == list(range(FIRST, FIRST + LOST_BEFORE_NEW))
    counts = {name: result.provenance[name] for name in ("frames", "tracked", "lost", "in_other_maps")}
    expected = {"frames": FIRST + SECOND, "tracked": rest, "lost": LOST_BEFORE_NEW, "in_other_maps": FIRST}
    assert counts == expected
    assert result.frames["reason"][0] == "tracked in maps/1"
    assert "keyframe" in result.frames["reason"][FIRST]
    assert any("2 submaps stay apart" in text for text in warned(result.provenance))


def test_the_kept_map_is_right_and_its_world_is_its_first_frame(result: Result, spliced: Path) -> None:
    begin = FIRST + LOST_BEFORE_NEW
    poses = result.trajectory.T_world_camera
    assert np.isnan(poses[:begin]).all()
    np.testing.assert_array_equal(poses[begin], np.eye(4))
    off = inverse(poses[begin:]) @ true_poses(spliced, begin)[begin:]
    assert rotation_angle_rad(off[:, :3, :3]).max() < np.radians(0.5)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.5


def test_the_smaller_submap_is_saved_beside_it(result: Result, spliced: Path, out: Path) -> None:
    (other,) = result.others
    assert other.frames["index"].tolist() == list(range(FIRST))
    assert set(other.frames["map"].tolist()) == {1}
    off = inverse(other.trajectory.T_world_camera) @ true_poses(spliced)[:FIRST]
    assert rotation_angle_rad(off[:, :3, :3]).max() < np.radians(0.5)
    assert other.provenance["tracked"] == FIRST
    for part, scene, first in ((result, "1", LOST_BEFORE_NEW), (other, "0", 0)):
        folder = spliced.parent / scene
        alone = reconstruct(open_sequence(folder, frames=slice(first, None)), with_true_depth(folder, **LIGHT))
        np.testing.assert_allclose(part.mesh.bounds, alone.mesh.bounds, atol=2.0 if first else 1e-3)
    written = read_trajectory(out / "maps" / "1")
    assert written.indices.tolist() == list(range(FIRST))
    assert written.tracked.all()
    assert read_trajectory(out).tracked.tolist() == (result.frames["map"] == 0).tolist()
    assert [row["map"] for row in frame_rows(out)][:FIRST] == ["1"] * FIRST
    mesh = trimesh.load_mesh(out / "maps" / "1" / "mesh.ply")
    np.testing.assert_allclose(mesh.bounds, other.mesh.bounds, atol=1e-3)


def test_each_submap_of_a_run_is_exported_to_climb(result: Result, out: Path, tmp_path: Path) -> None:
    write_submission(out, tmp_path, "Seq_001_a")
    assert submission_problems(tmp_path) == []
    found = read_trajectory(tmp_path / "Seq_001_a" / "5")
    for number, (submap, one) in enumerate(zip((found, *found.others), (result, *result.others), strict=True)):
        known = one.trajectory.rows(one.trajectory.tracked)
        assert submap.indices.tolist() == known.indices.tolist()
        np.testing.assert_allclose(submap.T_world_camera, known.T_world_camera, atol=1e-6)
        points = np.loadtxt(tmp_path / "Seq_001_a" / "5" / "3D_maps" / str(number) / "points3D.txt")[:, 1:4]
        assert (points >= one.mesh.bounds[0] - 1e-3).all()
        assert (points <= one.mesh.bounds[1] + 1e-3).all()


@pytest.mark.usefixtures("result")
def test_overwriting_removes_saved_submaps(spliced: Path, out: Path, tmp_path: Path) -> None:
    shutil.copytree(out, tmp_path / "out")
    short = with_true_depth(spliced, **LIGHT)
    again = reconstruct(open_sequence(spliced, frames=slice(0, 3)), short, out=tmp_path / "out", overwrite=True)
    assert again.others == []
    assert not (tmp_path / "out" / "maps").exists()


def test_frames_that_are_fused_as_they_come_are_fused_by_map(spliced: Path, result: Result) -> None:
    at_once = {"mapping__method": "none", "fusion__voxel_mm": 1.0, "fusion__truncation_mm": 4.0}
    live = reconstruct(open_sequence(spliced), with_true_depth(spliced, **LIGHT, **at_once))
    assert live.frames["status"].tolist() == result.frames["status"].tolist()
    for part, stored in zip([live, *live.others], [result, *result.others], strict=True):
        np.testing.assert_allclose(part.mesh.bounds, stored.mesh.bounds, atol=6.0)  # of other voxels
        assert part.provenance["surface"]["coverage_mean"] > 0.5


def _keyframe(
    number: int, at_mm: tuple[float, float, float], S_map_true: Similarity, factor: float
) -> tuple[Frame, TrackedPose]:
    """A keyframe of a plane, its pose in another world, its depth times `factor`; each map has its own factor."""
    view = plane_scene.see(plane_scene.pose(at_mm=at_mm))
    T_world_camera = S_map_true.transform_poses(view.T_world_camera)
    depth_mm = (factor * view.depth_mm).astype(np.float32)
    frame = Frame(
        10 * number, number / 3, view.rgb, plane_scene.CAMERA, plane_scene.EVERYWHERE, depth_mm, T_world_camera
    )
    return frame, TrackedPose(int(factor != 1), 10 * max(number - 2, 0), T_world_camera)


def test_each_map_begins_at_the_scale_of_the_depth(result: Result, begun: list[float]) -> None:
    assert begun == [1.0] * (1 + len(result.submaps))  # the metric depth that fixes the scale begins one, too


def test_maps_of_the_same_place_are_merged() -> None:
    worlds = (Similarity.identity(), Similarity(1.3, so3_exp(np.array([0.2, -0.9, 0.4])), np.array([30.0, -8.0, 5.0])))
    places = [(2.0 * number, 0.5 * number, 0.1 * number) for number in range(10)]
    backend = Backend(MappingSettings(), DisFlow())
    frames, tracked = [], {}
    for number, at_mm in enumerate(places):
        # Every other keyframe is of the other map.
        frame, tracked[10 * number] = _keyframe(number, at_mm, worlds[number % 2], worlds[number % 2].scale)
        backend.add(frame, tracked[10 * number])
        frames.append(frame)
    correction = plane_scene.only(backend.adjust(0, tracked))
    assert sorted(correction.S_common_map) == [0, 1]
    assert correction.notice.values["maps"] == 2
    final = FinalFrames(correction, {frame.index: frame.T_world_camera for frame in frames}, lambda n: frames[n // 10])
    for moved, at_mm in zip(final.frames(None), places, strict=True):
        np.testing.assert_allclose(moved.T_world_camera, plane_scene.pose(at_mm=at_mm), atol=0.1)
        np.testing.assert_allclose(moved.depth_mm, plane_scene.see(plane_scene.pose(at_mm=at_mm)).depth_mm, rtol=0.05)


@pytest.mark.parametrize("swelling", [False, True])
def test_a_map_that_does_not_fit_is_not_merged(swelling: bool) -> None:
    backend, rng = Backend(MappingSettings(), DisFlow()), np.random.default_rng(0)
    for number in range(15):
        frame, pose = _keyframe(number, (1.5 * number, 0.4 * number, 0.0), Similarity.identity(), 1.0)
        if swelling and number % 3 == 1:
            x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (240, 180)))
            swell = cv2.GaussianBlur(rng.normal(0, 1, (180, 240, 2)).astype(np.float32), (0, 0), 10)
            swell *= 4 / np.abs(swell).max()
            frame = replace(frame, rgb=cv2.remap(frame.rgb, x + swell[..., 0], y + swell[..., 1], cv2.INTER_LINEAR))
        backend.add(frame, pose._replace(map=number % 3))
    assert sorted(plane_scene.only(backend.adjust(0)).S_common_map) == ([0, 2] if swelling else [0, 1, 2])


@pytest.mark.parametrize("zoom", [0.0, 0.2])
def test_the_pose_graph_merges_no_maps_whose_depths_then_disagree(zoom: float, monkeypatch: pytest.MonkeyPatch) -> None:
    def with_other_scales(*given: Any) -> PoseGraph:
        graph = optimise_pose_graph(*given)
        return graph._replace(log_scale=graph.log_scale + zoom * (np.arange(len(graph.log_scale)) % 2))

    monkeypatch.setattr("scopemap.engine.mapping.keyframes.optimise_pose_graph", with_other_scales)
    # No adjustment is so exact: all are refused, as where tissue moves.
    backend = Backend(MappingSettings(max_sigma_px=1e-3), DisFlow())
    for number in range(10):
        frame, pose = _keyframe(number, (2.0 * number, 0.5 * number, 0.0), Similarity.identity(), 1.0)
        backend.add(frame, pose._replace(map=number % 2))
    corrections = [segment.correction for segment in backend.adjust(0)]
    for correction in corrections:
        assert correction is not None
        assert correction.refused
        assert sorted(correction.S_common_map) == ([0] if zoom else [0, 1])


def test_poses_are_read_anew_where_as_many_were_forgotten_as_added() -> None:
    mapper = Mapper(MappingSettings(method="none"), DisFlow())
    for number in range(4):
        mapper.observe(Track(number, "ok", "", np.eye(4), 0))
    assert mapper.submaps()[0][0].frames == {0, 1, 2, 3}
    mapper.forget([0, 1])
    for number in (4, 5):
        mapper.observe(Track(number, "ok", "", np.eye(4), 2))
    assert mapper.submaps()[0][0].frames == {2, 3, 4, 5}


@pytest.mark.parametrize(("far", "found", "split"), [(True, False, True), (True, True, False), (False, False, False)])
def test_a_map_is_split_where_nothing_supports_an_alignment_after_a_loss(far: bool, found: bool, split: bool) -> None:
    mapper = Mapper(MappingSettings(), DisFlow())
    for number in range(10):
        after = number >= 4
        at_mm = ((40.0 if far and after else -60.0) + 2 * number, 0.0, 0.0)
        frame, pose = _keyframe(number, at_mm, Similarity.identity(), 1.0)
        if number == 4:
            mapper.observe(Track(10 * number - 5, "lost", "blur", frame.T_world_camera, 30))
        # After the loss, too, the frame is aligned to the keyframe before it.
        keyframe = 10 * max(number - 1, 0)
        track = Track(frame.index, "ok", "", pose.T_world_camera, keyframe, relocalised=found and number == 4)
        mapper.add_keyframe(frame, track)
        mapper.observe(track)
    submaps, notices = mapper.submaps()
    assert sorted(submaps[0].frames) == ([*range(40, 100, 10)] if split else [*range(0, 100, 10)])
    assert [notice.values["submaps"] for notice in notices] == ([2] if split else [])
    assert submaps[0].main == int(split)
    if split:
        correction = submaps[0].correction(0)
        poses = np.stack([correction.pose(n, plane_scene.pose(at_mm=(40 + n / 5, 0, 0))) for n in (40, 60)])
        np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)
        np.testing.assert_allclose(poses[1, :3, 3], [4, 0, 0], atol=0.1)


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera that goes into a colon and comes out again, filmed with a break on the way in."""
    folder, (width, height) = tmp_path_factory.mktemp("cut"), SIZE
    write_phantom(PhantomSpec(frames=61, seed=3, loop=True, width=width, height=height), folder / "whole")
    return _spliced(folder / "cut", [(folder / "whole", n) for n in (*range(10), *range(28, 61))])


def test_a_map_that_returns_to_an_older_one_is_merged_with_it(
    cut: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fused: list[int] = []

    def integrate(self: TsdfVolume, frame: Frame) -> None:
        fused.append(frame.index)
        whole(self, frame)

    whole = TsdfVolume.integrate
    monkeypatch.setattr(TsdfVolume, "integrate", integrate)
    # Features would find the camera at once: no map would begin.
    monkeypatch.setattr(Relocaliser, "find", lambda *_, **__: None)
    light = {key.replace("__", "."): value for key, value in LIGHT.items()}
    config = Config.load(settings=light | {"tracking.keyframe_every": 3, "fusion.every": 1})
    result = reconstruct(open_sequence(cut), config, out=tmp_path / "out")
    status = result.frames["status"].tolist()
    assert status == ["initial"] + ["ok"] * 42
    assert result.frames["reason"][10 : 11 + LOST_BEFORE_NEW].tolist() == [
        *["tracked backwards"] * LOST_BEFORE_NEW,
        "new map",
    ]
    assert any("in 2 maps." in note for note in said(result.provenance))
    assert not [text for text in warned(result.provenance) if "submaps" in text]
    np.testing.assert_allclose(result.frames["T_world_camera"][0], np.eye(4), atol=1e-9)
    report = pose_report(match(result.trajectory, read_trajectory(cut), "sim3"))
    assert report["ate_rmse_mm"] < 0.4
    assert set(fused) == set(result.frames["index"].tolist()) - set(result.lost["index"].tolist())
    # Depth is in the same millimetres before the break and after it.
    truth, depth = C3vdFolder(cut), DepthReader(tmp_path / "out")
    ratios = []
    for index in (2, 8, 20, 30, 41):
        true, depth_mm = truth.truth(index), depth.read(index)
        ratios.append(np.nanmedian(depth_mm / np.where(true.depth_mm > 0, true.depth_mm, np.nan)))
    np.testing.assert_allclose(np.log(ratios), np.log(np.median(ratios)), atol=0.1)
