"""The story from end to end on a tiny phantom: poses, truth kept out, losses, order, the camera, the look-ahead."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from spied_depth import SpyDepth, spied
from tiny_phantom import FRAMES, SIZE, only_images, true_poses, with_true_depth, write_black, write_tiny

from scopemap import Config, open_sequence, reconstruct
from scopemap.config import PRESETS
from scopemap.depth.anchor import depth_downscale
from scopemap.errors import InputError, SettingsError, WeightsError
from scopemap.estimators import create_estimators
from scopemap.frame import Frame
from scopemap.fusion.volume import TsdfVolume
from scopemap.odometry import Step
from scopemap.preprocessing import Estimators
from scopemap.tracking.track import Track
from scopemap.tracking.tracker import Tracker
from scopemap.trajectory.formats.opening import read_trajectory

WITHOUT_NETWORKS = {"networks__flow": "dis", "networks__perceptual": "structure"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "sound")


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "interrupted", "black:4-4")


def _called(monkeypatch: pytest.MonkeyPatch, owner: type, name: str, note: Callable[..., None]) -> None:
    real = getattr(owner, name)

    def watched(self: Any, *arguments: Any, **options: Any) -> Any:
        note(*arguments)
        return real(self, *arguments, **options)

    monkeypatch.setattr(owner, name, watched)


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


def _position_errors_mm(result: Any, folder: Path) -> np.ndarray:
    return np.linalg.norm(result.trajectory.positions_mm - true_poses(folder)[:, :3, 3], axis=1)


def test_every_frame_is_tracked_and_a_surface_found(folder: Path) -> None:
    result = reconstruct(open_sequence(folder), with_true_depth(folder))
    assert result.frames["status"].tolist() == ["initial"] + ["ok"] * (FRAMES - 1)
    assert result.frames["index"].tolist() == list(range(FRAMES))
    assert _position_errors_mm(result, folder).max() < 0.6
    assert not len(result.lost)
    assert len(result.mesh.faces) > 1000
    truth = trimesh.load(folder / "mesh_truth.ply", process=False)
    world = trimesh.transform_points(result.mesh.vertices, read_trajectory(folder).T_world_camera[0])
    distances_mm, _ = KDTree(truth.vertices).query(world)
    assert np.median(distances_mm) < 1.0


def test_the_same_input_gives_the_same_result(folder: Path) -> None:
    once, again = (reconstruct(open_sequence(folder), with_true_depth(folder)) for _ in range(2))
    np.testing.assert_array_equal(once.trajectory.T_world_camera, again.trajectory.T_world_camera)
    np.testing.assert_array_equal(once.mesh.faces, again.mesh.faces)
    np.testing.assert_allclose(once.mesh.vertices, again.mesh.vertices, atol=1e-5)


def test_truth_is_never_handed_to_an_estimator(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spies = spied(monkeypatch)
    tracked: list[Any] = []
    _called(monkeypatch, Tracker, "track", tracked.append)
    reconstruct(open_sequence(folder), with_true_depth(folder))
    assert len(spies[0].seen) == len(tracked) == FRAMES
    for frame in [*spies[0].seen, *tracked]:
        assert type(frame) is Frame
        assert frame.T_world_camera is None
    assert all(frame.depth_mm is None for frame in spies[0].seen)


def test_depth_is_estimated_at_a_smaller_size_and_given_at_the_frames(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spies, found = spied(monkeypatch), {}
    for downscale in (1, 2):
        steps: list[Step] = []
        config = Config.load(settings={"depth.backend": "shading", "depth.downscale": downscale})
        result = reconstruct(open_sequence(folder), config, observers=(steps.append,))
        assert {frame.valid.shape for frame in spies.pop().seen} == {(SIZE[1] // downscale, SIZE[0] // downscale)}
        assert not len(result.lost)
        depths = [(step.raw_mm, step.frame.depth_mm, step.frame.depth_sigma_mm) for step in steps]
        assert {mm.shape for depth in depths for mm in depth if mm is not None} == {SIZE[::-1]}
        found[downscale] = np.stack([step.frame.depth_mm for step in steps if step.frame.depth_mm is not None])
    ratio = found[2] / found[1]
    assert 0.0 < np.nanmedian(np.abs(ratio / np.nanmedian(ratio) - 1)) < 0.1
    # Files are read at their own size.
    reconstruct(open_sequence(folder), with_true_depth(folder, depth__downscale=2))
    assert {frame.valid.shape for frame in spies.pop().seen} == {SIZE[::-1]}


@pytest.mark.parametrize(
    ("settings", "longest_px", "expected"),
    [
        ({}, 128, 1),
        ({}, 319, 1),
        ({}, 337, 2),
        ({}, 1280, 8),
        ({"depth.downscale": 3}, 1280, 3),
        ({"depth.backend": "shading"}, 1280, 1),
        ({"depth.backend": "files:depth", "depth.downscale": 2}, 320, 1),
    ],
)
def test_scopenet_sees_images_of_about_its_training_size(
    settings: dict[str, Any], longest_px: int, expected: int
) -> None:
    assert depth_downscale(Config.load(settings=settings).depth, longest_px) == expected


def test_depth_is_not_estimated_on_next_to_nothing() -> None:
    settings = Config.load(settings={"depth.downscale": 6}).depth
    assert depth_downscale(settings, 192) == 6
    with pytest.raises(SettingsError, match=r"depth\.downscale=6: .* at most 5 here"):
        depth_downscale(settings, 191)


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
            return Track(frame.index, status, "", np.eye(4), 0)

        def needs_keyframe(self) -> bool:
            return True

        def insert_keyframe(self, frame: Frame, *, measured: bool) -> bool:
            self.inserted.append(frame.index)
            return measured

    tracker = Standing()
    result = reconstruct(open_sequence(folder), with_true_depth(folder), tracker=tracker)
    lost = result.lost["index"].tolist()
    assert lost == [index for index in range(FRAMES) if index % 3 == 2]
    assert tracker.inserted == [index for index in range(FRAMES) if index not in lost]
    assert np.isnan(result.frames["T_world_camera"][lost]).all()
    assert (result.frames["T_world_camera"][result.frames.tracked] == np.eye(4)).all()


def test_removing_the_truth_changes_nothing(folder: Path, tmp_path: Path) -> None:
    bare = only_images(folder, tmp_path / "bare")
    (bare / "camera.yaml").write_bytes((folder / "camera.yaml").read_bytes())
    truth, none = open_sequence(folder), open_sequence(bare)
    assert next(iter(truth))[1] is not None
    assert next(iter(none))[1] is None
    config = Config.load()
    with_truth, without = reconstruct(truth, config), reconstruct(none, config)
    np.testing.assert_array_equal(with_truth.trajectory.T_world_camera, without.trajectory.T_world_camera)


def test_a_black_frame_is_lost_and_tracking_resumes(interrupted: Path) -> None:
    steps: list[Step] = []
    config = with_true_depth(interrupted, mapis__advanced__frame_scale="robust")  # measured depth alone needs no link
    result = reconstruct(open_sequence(interrupted), config, observers=(steps.append,))
    assert result.lost["index"].tolist() == [4]
    assert result.lost["reason"][0].startswith("only ")
    assert np.isnan(result.frames["T_world_camera"][4]).all()
    assert steps[4].frame.T_world_camera is None
    assert np.delete(_position_errors_mm(result, interrupted), 4).max() < 0.6
    assert steps[4].refined.warped_share == 0.0
    assert steps[5].refined.warped_share == 0.0
    assert steps[6].refined.warped_share > 0.5


@pytest.mark.parametrize("noisy", [False, True])
def test_black_frames_at_the_start_are_left_behind(noisy: bool, tmp_path: Path) -> None:
    """The noise of a sensor in the dark (0.4 % of its range) must not pass for tissue: it would fix the world."""
    folder = write_tiny(tmp_path / "late", "black:0-1", frames=6)
    for index in () if noisy else (0, 1):
        cv2.imwrite(str(folder / f"{index:04d}_color.png"), np.zeros((*SIZE[::-1], 3), np.uint8))
    result = reconstruct(open_sequence(folder), with_true_depth(folder))
    assert result.frames["status"].tolist() == ["lost"] * 2 + ["initial"] + ["ok"] * 3
    np.testing.assert_array_equal(result.frames["T_world_camera"][2], np.eye(4))
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
    reconstruct(open_sequence(bare, frames=slice(0, 3)), config, observers=(steps.append,))
    assert [step.track.status for step in steps] == ["lost", "initial", "ok"]
    assert steps[0].frame.valid.mean() > 0.02
    assert np.isnan(steps[0].raw_mm).all()
    distance_mm = steps[1].raw_mm * np.linalg.norm(steps[1].frame.camera.rays, axis=-1)
    assert np.nanmedian(distance_mm[steps[1].frame.valid]) == pytest.approx(35.0, rel=1e-3)


def test_smoothing_forgets_what_was_before_a_loss(interrupted: Path) -> None:
    smoothing = {"smoothing__method": "wema", "smoothing__dynamic": False}
    raw: list[np.ndarray] = []
    result = reconstruct(
        open_sequence(interrupted),
        with_true_depth(interrupted, **smoothing),
        observers=(lambda step: raw.append(step.track.T_world_camera),),
    )
    moved = np.abs(result.trajectory.T_world_camera - raw).max(axis=(1, 2))
    np.testing.assert_array_equal(moved[[0, 1, 5, 6]], 0.0)
    assert np.isnan(result.trajectory.T_world_camera[4]).all()
    assert moved[[2, 3, 7, 8]].min() > 1e-3


def test_nothing_but_black_is_an_input_error(tmp_path: Path) -> None:
    black = write_black(tmp_path / "black")
    with pytest.raises(InputError, match=r"no frame of .*black could be used: .*usable"):
        reconstruct(open_sequence(black), out=tmp_path / "out")
    assert not (tmp_path / "out" / "trajectory.tum").exists()


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_tracks_all_frames(preset: str, folder: Path) -> None:
    config = with_true_depth(folder, preset, **WITHOUT_NETWORKS, depth__anchor="auto")
    result = reconstruct(open_sequence(folder), config)
    assert not len(result.lost)
    assert _position_errors_mm(result, folder).max() < 1.5


@pytest.mark.parametrize(("order", "moved"), [("track-first", True), ("refine-first", False)])
def test_the_warped_depth_is_moved_only_where_the_motion_is_known(
    order: str, moved: bool, folder: Path, tmp_path: Path
) -> None:
    """A wall that the camera approaches by 2 mm a frame: without the motion its values are warped as they are."""
    sequence = open_sequence(_approach(tmp_path / "wall", step_mm=2.0))
    depth = {"depth__files_kind": "depth", "mapis__paper__blend": "constant", "mapis__paper__constant_weight": 1.0}
    plain = {"mapis__paper__order": order, "mapis__advanced__frame_scale": "none", "mapping__method": "none"}
    config = with_true_depth(tmp_path / "wall", **(WITHOUT_NETWORKS | depth | plain))
    steps: list[Step] = []
    reconstruct(sequence, config, observers=(steps.append,))
    assert [step.track.status for step in steps] == ["initial", "ok", "ok"]
    centre = [float(np.nanmedian(step.refined.depth_mm[50:70, 60:100])) for step in steps]
    expected = [60.0, 58.0, 56.0] if moved else [60.0, 60.0, 60.0]
    assert centre == pytest.approx(expected, abs=0.6)


def test_the_papers_form_runs_on_predicted_depth(folder: Path) -> None:
    chosen = {**WITHOUT_NETWORKS, "depth__backend": "shading", "depth__anchor": "auto"}
    result = reconstruct(open_sequence(folder), with_true_depth(folder, "paper", **chosen))
    assert result.provenance["tracked"] >= FRAMES - 1
    assert result.provenance["estimators"]["anchor"].startswith("shading prior")
    assert result.frames["depth_scale"].tolist() == [1.0] * FRAMES


def test_smoothing_is_of_the_result_and_not_of_the_tracking(folder: Path) -> None:
    smoothing = {"smoothing__method": "wema", "smoothing__dynamic": False}
    tracked: list[np.ndarray] = []
    rough = reconstruct(open_sequence(folder), with_true_depth(folder))
    smooth = reconstruct(
        open_sequence(folder),
        with_true_depth(folder, **smoothing),
        observers=(lambda step: tracked.append(step.track.T_world_camera),),
    )
    x, y = rough.trajectory.positions_mm, smooth.trajectory.positions_mm
    np.testing.assert_array_equal(y[:2], x[:2])
    np.testing.assert_allclose(y[2:], 0.6 * x[2:] + 0.3 * x[1:-1] + 0.1 * x[:-2], atol=2e-3)
    np.testing.assert_array_equal(rough.trajectory.T_world_camera, tracked)


@pytest.mark.parametrize(("every", "fused"), [(1, [0, 1, 2, 3, 5, 6, 7, 8]), (3, [0, 3, 7])])
def test_lost_frames_are_not_fused_and_every_counts_tracked_ones(
    every: int, fused: list[int], interrupted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    _called(monkeypatch, TsdfVolume, "integrate", lambda frame: seen.append(frame.index))
    reconstruct(open_sequence(interrupted), with_true_depth(interrupted, fusion__every=every))
    assert seen == fused


def test_depth_files_take_the_scale_of_the_inputs_calibration(folder: Path, tmp_path: Path) -> None:
    """Depth maps kept apart from the frames mean what the frames' camera.yaml says of them."""
    for file in folder.glob("*_depth.tiff"):
        units = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(tmp_path / file.with_suffix(".png").name), units)
    steps: list[Step] = []
    reconstruct(open_sequence(folder), with_true_depth(tmp_path), observers=(steps.append,))
    truth = next(iter(open_sequence(folder)))[1]
    assert truth is not None
    np.testing.assert_allclose(steps[0].raw_mm, truth.depth_mm, rtol=1e-5)


def test_fusion_can_be_turned_off(folder: Path) -> None:
    result = reconstruct(open_sequence(folder), with_true_depth(folder, fusion__enabled=False))
    assert len(result.mesh.faces) == 0
    assert result.provenance["tracked"] == FRAMES


def test_stages_run_ahead_in_threads_and_not_too_far(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spies = spied(monkeypatch)
    seen: list[int] = []

    def wait_for_the_next(step: Step) -> None:
        for _ in range(1000):
            if len(spies[0].seen) >= min(step.frame.index + 2, FRAMES):
                break
            time.sleep(0.01)
        seen.append(len(spies[0].seen))

    reconstruct(open_sequence(folder), with_true_depth(folder), observers=(wait_for_the_next,))
    # Three stages, each with two frames done and one at work.
    assert all(min(i + 2, FRAMES) <= count <= i + 10 for i, count in enumerate(seen))
    assert threading.main_thread().name not in spies[0].threads


def test_overlapping_stages_change_no_bit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threaded = reconstruct(open_sequence(folder), Config.load())
    monkeypatch.setattr("scopemap.runner.run.in_thread", lambda items, thread, count=2: (item for item in items))
    serial = reconstruct(open_sequence(folder), Config.load())
    assert threaded.trajectory.T_world_camera.tobytes() == serial.trajectory.T_world_camera.tobytes()
    assert len(serial.mesh.faces) > 100
    assert threaded.mesh.vertices.tobytes() == serial.mesh.vertices.tobytes()
    assert threaded.mesh.visual.vertex_colors.tobytes() == serial.mesh.visual.vertex_colors.tobytes()


@pytest.mark.parametrize("fails_at", [1, 4, FRAMES])
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


def test_a_frame_of_another_size_is_told_from_the_look_ahead(folder: Path, tmp_path: Path) -> None:
    bare = only_images(folder, tmp_path / "bare")
    cv2.imwrite(str(bare / "0005.png"), np.full((60, 80, 3), 90, np.uint8))
    with pytest.raises(InputError, match=r"0005\.png: it is 80x60 px"):
        reconstruct(open_sequence(bare), Config.load())


def test_an_observers_error_ends_the_run(folder: Path) -> None:
    def stop(step: Step) -> None:
        if step.frame.index == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(open_sequence(folder), with_true_depth(folder), observers=(stop,))
