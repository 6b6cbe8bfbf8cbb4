"""The folder of a run: what lies in it, that it can be read back, and what may not be overwritten."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest
import trimesh

from scopemap import Result, open_sequence, reconstruct
from scopemap.engine.cameras.camera import source_pixel
from scopemap.engine.config import Config
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import FrameAgreement, agreement_figures, compare_rendering, lit_like
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.odometry import Step
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.sequence import Sequence
from scopemap.result.depth_maps import DEPTH_SCALE_MM, DepthReader, DepthWriter
from scopemap.result.trajectories import read_trajectory
from scopemap.result.verdict import verdict
from tests.support.drawn_run import changed
from tests.support.front_door import said, warned
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import FRAMES, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

COLUMNS = "index time_s name status reason map segment keyframe residual inlier_share correlation overlap iterations"
COLUMNS += " depth_scale warped_share usable sharpness motion quality cause orientation"
COLUMNS += " moving_share moving_x moving_y"
LOST = 6
STORED = 1.6e-4  # relative error of depth in the frame store


@dataclass(frozen=True)
class _Run:
    phantom: Path
    out: Path
    result: Result
    steps: list[Step]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> _Run:
    folder = tmp_path_factory.mktemp("run")
    phantom = write_tiny(folder / "phantom", f"black:{LOST}-{LOST}")
    steps: list[Step] = []
    config = with_true_depth(phantom)
    result = reconstruct(open_sequence(phantom), config, out=folder / "out", observers=(steps.append,))
    return _Run(phantom, folder / "out", result, steps)


def test_contents(run: _Run) -> None:
    names = "SHA256SUMS camera.yaml config.toml depth depth_preview depth_sigma frames.csv mesh.glb mesh.ply"
    names += " provenance.json source_camera.yaml surfaces trajectory.tum"
    assert sorted(path.name for path in run.out.iterdir()) == names.split()
    depth = [f"{i:06d}.png" for i in range(FRAMES) if i != LOST]
    assert sorted(path.name for path in (run.out / "depth").iterdir()) == [*depth, "depth.json"]
    assert sorted(path.name for path in (run.out / "surfaces").iterdir()) == ["segment_000.ply", "segments.csv"]
    assert (run.out / "surfaces" / "segment_000.ply").read_bytes() == (run.out / "mesh.ply").read_bytes()


def test_frames_table(run: _Run) -> None:
    rows = frame_rows(run.out)
    assert list(rows[0]) == COLUMNS.split()
    assert [int(row["index"]) for row in rows] == list(range(FRAMES))
    expected = ["initial", *["ok"] * (FRAMES - 1)]
    expected[LOST] = "lost"
    assert [row["status"] for row in rows] == expected
    assert [row["name"] for row in rows] == [f"{i:04d}_color.png" for i in range(FRAMES)]
    assert [int(row["keyframe"]) for row in rows] == run.result.frames["keyframe"].tolist()
    np.testing.assert_allclose([float(row["time_s"]) for row in rows], np.arange(FRAMES) / 30, atol=1e-6)
    assert rows[LOST]["reason"]
    assert [row["cause"] for row in rows] == ["too dark" if index == LOST else "" for index in range(FRAMES)]
    assert all(row["reason"] == "" for row in rows if row["status"] == "ok")
    assert [row["map"] for row in rows] == ["" if index == LOST else "0" for index in range(FRAMES)]


def test_the_folder_is_read_back_and_its_table_written_the_same(run: _Run, tmp_path: Path) -> None:
    folder = Result(run.out).checked()
    folder.frames.write(tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == (run.out / "frames.csv").read_bytes()
    np.testing.assert_allclose(folder.camera.matrix, run.result.camera.matrix)
    assert (folder.config, folder.scale_known) == (run.result.config, True)
    assert folder.frames.counts == run.result.frames.counts


def test_trajectory_is_read_back(run: _Run) -> None:
    for source in (run.out, run.out / "trajectory.tum"):
        back = read_trajectory(source)
        poses = back.rows(back.tracked).T_world_camera
        np.testing.assert_allclose(poses, np.delete(run.result.trajectory.T_world_camera, LOST, axis=0), atol=1e-8)
    back = read_trajectory(run.out)
    np.testing.assert_array_equal(back.indices, run.result.trajectory.indices)
    np.testing.assert_array_equal(back.status, run.result.trajectory.status)
    assert np.isnan(back.T_world_camera[LOST]).all()
    assert len(read_trajectory(run.out / "trajectory.tum")) == FRAMES - 1


def test_depth_is_read_back_to_half_a_unit(run: _Run) -> None:
    scale = json.loads((run.out / "depth" / "depth.json").read_text())
    assert (scale["scale_mm"], scale["unknown"], scale["scale_known"]) == (DEPTH_SCALE_MM, 0, True)
    for step in (step for step in run.steps if step.frame.index != LOST):
        image = cv2.imread(str(run.out / "depth" / f"{step.frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint16
        known = np.isfinite(step.refined.depth_mm)
        np.testing.assert_array_equal(image > 0, known)
        error = np.abs(image[known] * scale["scale_mm"] - step.refined.depth_mm[known])
        assert (error <= 0.501 * DEPTH_SCALE_MM + STORED * step.refined.depth_mm[known]).all()


def test_depth_folder_serves_as_depth_files(run: _Run) -> None:
    steps: list[Step] = []
    again = reconstruct(open_sequence(run.phantom), with_true_depth(run.out / "depth"), observers=(steps.append,))
    assert again.provenance["estimators"]["depth_kind"] == "measured"
    assert again.provenance["estimators"]["depth_scale"] == "0.01 mm per unit (depth.json)"
    for before, after in zip(run.steps, steps, strict=True):
        depth_mm = before.refined.depth_mm
        np.testing.assert_allclose(after.raw_mm, depth_mm, rtol=STORED, atol=0.501 * DEPTH_SCALE_MM)
    difference = again.trajectory.positions_mm - run.result.trajectory.positions_mm
    assert np.abs(np.delete(difference, LOST, axis=0)).max() < 0.02


def test_mesh_files_hold_the_surface(run: _Run) -> None:
    ply = trimesh.load(run.out / "mesh.ply", process=False)
    np.testing.assert_allclose(ply.vertices, run.result.mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(ply.faces, run.result.mesh.faces)
    glb = trimesh.load(run.out / "mesh.glb", force="mesh", process=False)
    np.testing.assert_allclose(np.sort(glb.extents), np.sort(ply.extents) / 1000, rtol=1e-3)


def test_surface_is_compared_with_the_video_in_the_light_of_the_lamp(run: _Run) -> None:
    """The mesh has the colours of the tissue; unlit they would tell nothing about the surface."""
    trajectory, depth = read_trajectory(run.out), DepthReader(run.out)
    agreements: dict[bool, list[FrameAgreement]] = {True: [], False: []}
    for step in run.steps:
        depth_mm, pose = depth.read(step.frame.index), trajectory.T_world_camera[step.frame.index]
        if step.frame.index != LOST and depth_mm is not None:
            camera, rgb, known_mm = step.frame.camera, step.frame.rgb, np.where(step.frame.valid, depth_mm, np.nan)
            unlit = render_mesh(run.result.mesh, camera, pose)
            for lit, found in agreements.items():
                view = lit_like(unlit, camera, rgb, known_mm) if lit else unlit
                found.append(compare_rendering(view, rgb, known_mm))
    told = run.result.provenance["surface"]
    # The store's JPEG changes little.
    lit, unlit = (agreement_figures(agreements[lit])["ssim"] for lit in (True, False))
    assert told["frames"] == len(agreements[True]) == FRAMES - 1
    assert abs(told["ssim"] - lit) < 0.2 * abs(lit - unlit)


def test_camera_and_settings_are_read_back(run: _Run) -> None:
    camera = run.result.camera
    back = read_calibration(run.out / "camera.yaml", (camera.width, camera.height)).camera.central
    np.testing.assert_allclose(back.matrix, camera.matrix, rtol=1e-9)
    source = run.result.source_camera
    assert source is not None
    assert read_calibration(run.out / "source_camera.yaml", (source.width, source.height)).camera == source
    pixels = np.array([[3.0, 4.0], [20.5, 11.0]])
    rays = back.unproject(pixels)
    np.testing.assert_allclose(source_pixel(pixels, back, source), source.project(7.0 * rays), atol=1e-9)
    assert Config.load(file=run.out / "config.toml") == run.result.config


def test_provenance(run: _Run) -> None:
    told = json.loads((run.out / "provenance.json").read_text())
    assert told == json.loads(json.dumps(run.result.provenance))
    assert (told["frames"], told["tracked"], told["dataset"]) == (FRAMES, FRAMES - 1, "c3vd")
    assert told["input"] == str(run.phantom)
    assert "camera.yaml" in told["camera"]["source"]
    assert told["camera"]["fx"] == pytest.approx(80.0)
    assert told["estimators"]["anchor"] == "measured depth"
    assert set(told["versions"]) >= {"scopemap", "numpy", "onnxruntime", "python"}
    parts = told["seconds"]
    assert {"read", "preprocess", "match", "track", "fuse", "total"} <= set(parts)
    assert parts["total"] >= max(parts["track"], parts["fuse"])


def test_the_verdict_is_a_field_and_that_of_the_report(run: _Run) -> None:
    found, stated = verdict(Result(run.out)), run.result.verdict
    assert stated is not None
    assert stated == (found.level, tuple(reason.code for reason in found.reasons))
    facts = json.loads((run.out / "provenance.json").read_text())["verdict"]
    assert (facts["level"], facts["word"]) == (found.level, found.word)
    assert stated.level == "bad"
    assert {"code": "frames-too-few", "level": "bad"} in facts["reasons"]
    assert changed(run.result, provenance={}).verdict is None


def test_a_result_in_memory_can_be_saved_later(run: _Run, tmp_path: Path) -> None:
    run.result.save(tmp_path / "deep" / "later")
    for name in ("trajectory.tum", "frames.csv", "config.toml", "camera.yaml", "provenance.json", "mesh.ply"):
        assert (tmp_path / "deep" / "later" / name).read_bytes() == (run.out / name).read_bytes()


def test_without_a_folder_nothing_is_written(run: _Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = with_true_depth(run.phantom, fusion__enabled=False)
    result = reconstruct(open_sequence(run.phantom, frames=slice(0, 3)), config)
    assert list(tmp_path.iterdir()) == []
    assert any(text.startswith("Only 3 frames are in the result: too few") for text in said(result.provenance))
    assert warned(run.result.provenance) == []
    result.save(tmp_path / "empty")
    assert not (tmp_path / "empty" / "mesh.glb").exists()


def test_depth_writer_at_the_ends_of_its_range(run: _Run, tmp_path: Path) -> None:
    step = run.steps[0]
    depth = np.full(step.refined.depth_mm.shape, np.nan, np.float32)
    depth[0, :6] = [0.01, 0.014, 655.34, 655.36, 5000.0, np.inf]
    frame = replace(step.frame, index=1234567, depth_mm=depth)
    DepthWriter(tmp_path)(frame)
    image = cv2.imread(str(tmp_path / "depth" / "1234567.png"), cv2.IMREAD_UNCHANGED)
    assert image[0, :6].tolist() == [1, 1, 65534, 0, 0, 0]
    assert not image[1:].any()


def test_the_deviation_of_depth_is_read_back_to_two_hundredths(run: _Run, tmp_path: Path) -> None:
    step = run.steps[0]
    depth_mm = np.full(step.refined.depth_mm.shape, 80.0, np.float32)
    sigma_mm = np.full(depth_mm.shape, np.nan, np.float32)
    sigma_mm[0, :6] = [0.08, 0.5, 4.0, 8.0, 30.0, 140.0]
    sigma_mm[1, :2] = [0.0, np.inf]
    depth_mm[2], sigma_mm[2] = np.nan, 1.0
    frame = replace(step.frame, depth_mm=depth_mm, depth_sigma_mm=sigma_mm)
    DepthWriter(tmp_path)(frame)
    DepthWriter(tmp_path)(replace(frame, index=7, depth_sigma_mm=None))
    back = DepthReader(tmp_path).read_sigma(frame.index)
    assert back is not None
    np.testing.assert_allclose(back[0, :6], sigma_mm[0, :6], rtol=0.02)
    np.testing.assert_allclose(back[1, :2] / 80, [0.001, 0.001 * 1.03**254], rtol=1e-4)
    assert np.isnan(back[0, 6:]).all()
    assert np.isnan(back[1:, 2:]).all()
    assert DepthReader(tmp_path).read_sigma(7) is None
    assert DepthReader(tmp_path).read(7) is not None


def test_a_run_that_is_stopped_writes_the_frames_until_then(
    run: _Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, asked, every = Event(), Event(), Sequence.frames

    def frames(self: Sequence, after: int = -1) -> Iterator[Frame]:
        for frame in every(self):
            if frame.index == LOST - 1:
                read.set()
                assert asked.wait(60)
            yield frame

    def ask(step: Step) -> bool:
        return step.frame.index == 1 and read.wait(60)

    def told_after(step: Step) -> None:
        if step.frame.index == 2:
            asked.set()

    monkeypatch.setattr(Sequence, "frames", frames)
    config, out = with_true_depth(run.phantom), tmp_path / "out"
    result = reconstruct(open_sequence(run.phantom), config, out=out, observers=(ask, told_after))
    last = LOST - 2
    told = json.loads((out / "provenance.json").read_text())
    assert told["interrupted_at_frame"] == result.frames["index"][-1] == last
    assert f"The run was stopped at frame {last}: later frames are missing." in warned(told)
    assert [int(row["index"]) for row in frame_rows(out)] == list(range(last + 1))
    assert len(read_trajectory(out)) == last + 1
    assert len(trimesh.load_mesh(out / "mesh.ply").faces) > 100
    assert run.result.provenance["interrupted_at_frame"] is None


def test_overwrite_takes_away_the_earlier_run_and_nothing_else(run: _Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    config = with_true_depth(run.phantom, fusion__enabled=False)
    reconstruct(open_sequence(run.phantom, frames=slice(0, 4)), config, out=out)
    (out / "notes.txt").write_text("keep")
    (out / "mine").mkdir()
    (out / "mine" / "a.png").write_text("keep")
    (out / "mesh.glb").write_text("of the earlier run")
    with pytest.raises(InputError, match="not empty"):
        reconstruct(open_sequence(run.phantom), config, out=out)
    reconstruct(open_sequence(run.phantom, frames=slice(5, 8)), config, out=out, overwrite=True)
    assert (out / "notes.txt").read_text() == "keep"
    assert (out / "mine" / "a.png").read_text() == "keep"
    assert not (out / "mesh.glb").exists()
    assert sorted(path.name for path in (out / "depth").glob("*.png")) == ["000005.png", "000007.png"]
    assert [row["index"] for row in frame_rows(out)] == ["5", "6", "7"]


@pytest.mark.parametrize(
    ("largest_mm", "scale_mm"),
    [(0.0, 0.01), (300.0, 0.01), (655.34, 0.01), (656.0, 0.02), (5000.0, 0.1), (65534.0, 1.0)],
)
def test_the_unit_of_depth_grows_with_the_largest_depth(
    run: _Run, largest_mm: float, scale_mm: float, tmp_path: Path
) -> None:
    step = run.steps[0]
    depth_mm = np.full(step.refined.depth_mm.shape, largest_mm, np.float32)
    DepthWriter(tmp_path, largest_mm)(replace(step.frame, depth_mm=depth_mm))
    assert json.loads((tmp_path / "depth" / "depth.json").read_text()) == {"scale_mm": scale_mm, "unknown": 0}
    image = cv2.imread(str(tmp_path / "depth" / f"{step.frame.index:06d}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(image * scale_mm, largest_mm, atol=0.501 * scale_mm)


def test_a_room_of_several_metres_is_kept_and_told(run: _Run, tmp_path: Path) -> None:
    """Measured depth is known however far it is: ten centimetres of phantom, taken as ten metres, in larger voxels."""
    config = with_true_depth(run.phantom, depth__files_scale_mm=0.15)
    result = reconstruct(open_sequence(run.phantom, frames=slice(0, 3)), config, out=tmp_path / "out")
    scale_mm = json.loads((tmp_path / "out" / "depth" / "depth.json").read_text())["scale_mm"]
    assert scale_mm == 0.2
    depth = cv2.imread(str(tmp_path / "out" / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED) * scale_mm
    assert (depth > 0).mean() > 0.9
    assert np.median(depth) > 1000
    assert not any("not fused" in text for text in warned(result.provenance))
    assert result.config.fusion.voxel_mm == pytest.approx(100 * run.result.config.fusion.voxel_mm, rel=0.1)
    assert np.ptp(result.mesh.vertices, axis=0).max() > 1000
