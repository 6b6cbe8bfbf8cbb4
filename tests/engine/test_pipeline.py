"""The story from end to end on a tiny phantom: poses, truth kept out, losses, order, the camera, the look-ahead."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from scopemap import Config, Result, open_sequence, reconstruct
from scopemap.engine.config import PRESETS
from scopemap.engine.depth import mapis
from scopemap.engine.errors import WeightsError
from scopemap.engine.estimators import Estimators
from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step
from scopemap.engine.tracking.track import KeyframeDecision, Track
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.estimators import create_estimators
from tests.support.spied_depth import SpyDepth, spied
from tests.support.tiny_phantom import FRAMES, SIZE, only_images, true_poses, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

WITHOUT_NETWORKS = {"networks__flow": "dis", "networks__perceptual": "structure"}
WEMA = {"smoothing__method": "wema", "smoothing__dynamic": False}
OK = ["ok"] * FRAMES


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "sound")


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "interrupted", "black:4-4")


def _approach(folder: Path, step_mm: float) -> Path:
    """Three frames and depth files of a textured wall 60 mm away, which the camera approaches."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (480, 640, 3)).astype(np.float32), (0, 0), 3)
    texture = np.clip(128 + 6 * (texture - texture.mean()), 20, 235)
    for n in range(3):
        depth_mm = 60.0 - n * step_mm
        # At 60 mm a pixel of the picture is two of the texture.
        scale = 2 * depth_mm / 60.0
        x, y = np.meshgrid(np.arange(SIZE[0]) - (SIZE[0] - 1) / 2, np.arange(SIZE[1]) - (SIZE[1] - 1) / 2)
        maps = (319.5 + scale * x).astype(np.float32), (239.5 + scale * y).astype(np.float32)
        cv2.imwrite(str(folder / f"{n:04d}_color.png"), cv2.remap(texture, *maps, cv2.INTER_LINEAR).astype(np.uint8))
        np.save(folder / f"{n:04d}_depth.npy", np.full(SIZE[::-1], depth_mm, np.float32))
    (folder / "camera.txt").write_text(f"150 150 {(SIZE[0] - 1) / 2} {(SIZE[1] - 1) / 2}\n")
    return folder


def _status(result: Result) -> list[str]:
    return result.trajectory.status.tolist()


def _position_errors_mm(result: Result, folder: Path) -> np.ndarray:
    return np.linalg.norm(result.trajectory.positions_mm - true_poses(folder)[:, :3, 3], axis=1)


def test_every_frame_is_tracked_and_a_surface_found(folder: Path) -> None:
    result = reconstruct(open_sequence(folder), with_true_depth(folder))
    assert _status(result) == ["initial", *OK[1:]]
    assert result.trajectory.indices.tolist() == list(range(FRAMES))
    assert _position_errors_mm(result, folder).max() < 0.6
    assert len(result.mesh.faces) > 1000
    truth = trimesh.load(folder / "mesh_truth.ply", process=False)
    world = trimesh.transform_points(result.mesh.vertices, read_trajectory(folder).T_world_camera[0])
    distances_mm, _ = KDTree(truth.vertices).query(world)
    assert np.median(distances_mm) < 1.0


def test_depth_is_estimated_at_a_smaller_size_and_given_at_the_frames(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spies, steps = spied(monkeypatch), list[Step]()
    monkeypatch.setattr("scopemap.engine.depth.anchor._SCOPENET_PX", SIZE[0] // 2)
    reconstruct(open_sequence(folder), Config(), observers=(steps.append,))
    assert {frame.valid.shape for frame in spies.pop().seen} == {(SIZE[1] // 2, SIZE[0] // 2)}
    depths = [(step.raw_mm, step.frame.depth_mm, step.frame.depth_sigma_mm) for step in steps]
    assert {mm.shape for depth in depths for mm in depth if mm is not None} == {SIZE[::-1]}
    # Files are read at their own size.
    reconstruct(open_sequence(folder), with_true_depth(folder))
    assert {frame.valid.shape for frame in spies.pop().seen} == {SIZE[::-1]}


def test_another_odometry_takes_the_place_of_ours(folder: Path) -> None:
    """It gets the same masked frames with their raw depth, and its word is final: lost frames stay lost."""

    class Standing:
        """Believes that the camera never moves, and loses every third frame."""

        def __init__(self) -> None:
            self.inserted: list[int] = []

        def track(self, frame: Frame) -> Track:
            assert frame.depth_mm is not None
            assert np.isfinite(frame.depth_mm).any()
            status = "initial" if frame.index == 0 else "lost" if frame.index % 3 == 2 else "ok"
            return Track(frame.index, status, "", np.eye(4), 0, decision=KeyframeDecision("new"))

        def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
            assert decision.kind == "new"
            self.inserted.append(frame.index)
            return measured

    tracker = Standing()
    result = reconstruct(open_sequence(folder), with_true_depth(folder), tracker=tracker)
    lost = np.arange(FRAMES) % 3 == 2
    assert [status == "lost" for status in _status(result)] == lost.tolist()
    assert tracker.inserted == np.flatnonzero(~lost).tolist()
    poses = result.trajectory.T_world_camera
    assert np.isnan(poses[lost]).all()
    assert (poses[~lost] == np.eye(4)).all()


def test_truth_changes_nothing(folder: Path, tmp_path: Path) -> None:
    bare = only_images(folder, tmp_path / "bare")
    (bare / "camera.yaml").write_bytes((folder / "camera.yaml").read_bytes())
    truth, none = open_sequence(folder), open_sequence(bare)
    assert next(iter(truth))[1] is not None
    assert next(iter(none))[1] is None
    with_truth, without = reconstruct(truth, Config()), reconstruct(none, Config())
    np.testing.assert_array_equal(with_truth.trajectory.T_world_camera, without.trajectory.T_world_camera)


def test_a_black_frame_is_lost_and_tracking_resumes(interrupted: Path, tmp_path: Path) -> None:
    steps: list[Step] = []
    # Measured depth alone needs no correspondence.
    config = with_true_depth(interrupted, mapis__frame_scale="robust")
    result = reconstruct(open_sequence(interrupted), config, observers=(steps.append,), out=tmp_path / "out")
    assert _status(result) == ["initial", *OK[1:4], "lost", *OK[5:]]
    rows = (tmp_path / "out" / "frames.csv").read_text().splitlines()
    assert "only " in rows[5]
    assert steps[4].frame.T_world_camera is None
    assert np.delete(_position_errors_mm(result, interrupted), 4).max() < 0.6
    assert [steps[index].refined.warped_share > 0.5 for index in (4, 5, 6)] == [False, False, True]


@pytest.mark.parametrize("noisy", [False, True])
def test_black_frames_at_the_start_are_left_behind(noisy: bool, tmp_path: Path) -> None:
    """The noise of a sensor in the dark (0.4 % of its range) must not pass for tissue: it would fix the world."""
    folder = write_tiny(tmp_path / "late", "black:0-1", frames=6)
    for index in () if noisy else (0, 1):
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), np.zeros((*SIZE[::-1], 3), np.uint8))
    result = reconstruct(open_sequence(folder), with_true_depth(folder))
    assert _status(result) == ["lost"] * 2 + ["initial"] + ["ok"] * 3
    np.testing.assert_array_equal(result.trajectory.T_world_camera[2], np.eye(4))
    errors = result.trajectory.positions_mm[2:] - true_poses(folder, 2)[2:, :3, 3]
    assert np.linalg.norm(errors, axis=1).max() < 0.6


def test_a_frame_that_is_too_dark_to_track_fixes_no_scale(folder: Path, tmp_path: Path) -> None:
    """A bright corner is tissue, but no more than the tracker would refuse: the next frame's median is the prior."""
    bare = only_images(folder, tmp_path / "bare")
    first = cv2.imread(str(bare / "0000.png"))
    first[: 4 * SIZE[1] // 5] = 0
    first[:, SIZE[0] // 3 :] = 0
    cv2.imwrite(str(bare / "0000.png"), first)
    steps: list[Step] = []
    config = Config.load(settings={"depth.backend": "shading"})
    result = reconstruct(open_sequence(bare, frames=slice(0, 3)), config, observers=(steps.append,))
    assert _status(result) == ["lost", "initial", "ok"]
    assert steps[0].frame.valid.mean() > 0.02
    assert np.isnan(steps[0].raw_mm).all()
    distance_mm = steps[1].raw_mm * np.linalg.norm(steps[1].frame.camera.rays, axis=-1)
    assert np.nanmedian(distance_mm[steps[1].frame.valid]) == pytest.approx(35.0, rel=1e-3)


def test_smoothing_is_of_the_result_alone_and_forgets_what_was_before_a_loss(interrupted: Path) -> None:
    sequence = open_sequence(interrupted)
    rough = reconstruct(sequence, with_true_depth(interrupted)).trajectory.positions_mm
    smooth = reconstruct(sequence, with_true_depth(interrupted, **WEMA)).trajectory.positions_mm
    expected = rough.copy()
    for k in (2, 3, 7, 8):
        expected[k] = 0.6 * rough[k] + 0.3 * rough[k - 1] + 0.1 * rough[k - 2]
    np.testing.assert_allclose(smooth, expected, atol=2e-3)
    np.testing.assert_array_equal(smooth[[0, 1, 5, 6]], rough[[0, 1, 5, 6]])


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_tracks_all_frames(preset: str, folder: Path) -> None:
    config = with_true_depth(folder, preset, **WITHOUT_NETWORKS, depth__anchor="auto")
    result = reconstruct(open_sequence(folder), config)
    assert "lost" not in _status(result)
    assert _position_errors_mm(result, folder).max() < 1.5


@pytest.mark.parametrize(("order", "moved"), [("track-first", True), ("refine-first", False)])
def test_the_warped_depth_is_moved_only_where_the_motion_is_known(
    order: str, moved: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wall that the camera approaches by 2 mm a frame: without the motion its values are warped as they are."""
    sequence = open_sequence(_approach(tmp_path / "wall", step_mm=2.0))
    monkeypatch.setattr(mapis, "_CONSTANT_WEIGHT", 1.0)
    depth = {"depth__files_kind": "depth", "mapis__blend": "constant"}
    plain = {"mapis__order": order, "mapis__frame_scale": "none", "mapping__method": "none"}
    config = with_true_depth(tmp_path / "wall", **(WITHOUT_NETWORKS | depth | plain))
    steps: list[Step] = []
    assert _status(reconstruct(sequence, config, observers=(steps.append,))) == ["initial", "ok", "ok"]
    centre = [float(np.nanmedian(step.refined.depth_mm[50:70, 60:100])) for step in steps]
    assert centre == pytest.approx([60.0, 58.0, 56.0] if moved else [60.0, 60.0, 60.0], abs=0.6)


def test_overlapping_stages_change_no_bit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spies = spied(monkeypatch)
    threaded = reconstruct(open_sequence(folder), Config.load())
    assert threading.main_thread().name not in spies[0].threads
    monkeypatch.setattr("scopemap.runner.run.in_thread", lambda items, thread, count=2: (item for item in items))
    serial = reconstruct(open_sequence(folder), Config.load())
    assert threaded.trajectory.T_world_camera.tobytes() == serial.trajectory.T_world_camera.tobytes()
    assert len(serial.mesh.faces) > 100
    assert threaded.mesh.vertices.tobytes() == serial.mesh.vertices.tobytes()
    assert threaded.mesh.visual.vertex_colors.tobytes() == serial.mesh.visual.vertex_colors.tobytes()


@pytest.mark.parametrize("fails_at", [1, FRAMES])
def test_a_known_error_ahead_comes_out(fails_at: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create = create_estimators

    def breaking(config: Config, sequence: Any, own: Any) -> Estimators:
        parts = create(config, sequence)
        spy = SpyDepth(parts.depth)
        spy.fails_at, spy.error = fails_at, WeightsError("the network broke")
        return replace(parts, depth=spy)

    monkeypatch.setattr("scopemap.runner.preparation.create_estimators", breaking)
    steps: list[Step] = []
    with pytest.raises(WeightsError, match="the network broke"):
        reconstruct(open_sequence(folder), with_true_depth(folder), observers=(steps.append,))
    assert len(steps) == fails_at - 1
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("preprocess")]
