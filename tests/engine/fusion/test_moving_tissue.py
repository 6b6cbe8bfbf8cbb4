"""Tissue that moves on its own is told from noise, counted in the world, and, with a camera at rest, all that moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import Correspondences2D3D
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import REGIONS, Frame
from scopemap.engine.fusion.depth_mesh import depth_mesh
from scopemap.engine.fusion.moving_tissue import MovingTissue
from scopemap.engine.geometry.se3 import se3_exp
from scopemap.engine.odometry import Step
from scopemap.engine.tracking.at_rest import CameraAtRest
from scopemap.engine.tracking.corner_pose import nonrigidity
from scopemap.engine.tracking.track import MOVING_SIGMAS
from scopemap.input.decoding import read_decoded
from scopemap.runner.estimators import create_estimators, largest_depth_mm
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom
from tests.support.alike_runs import check_alike
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(160.0, 160.0, 159.5, 119.5, 320, 240)
MOTION = se3_exp(np.array([0.01, -0.02, 0.01, 2.0, 0.5, -1.0]))
COUNT = 800


def _correspondences(moved_px: np.ndarray, depth_error: float = 0.0) -> tuple[Correspondences2D3D, np.ndarray]:
    """Corners all over the picture, their pixels moved (COUNT, 2) beside what the motion explains, with noise."""
    rng = np.random.default_rng(5)
    points = CAMERA.unproject(rng.uniform([0, 0], [320, 240], (COUNT, 2))) * rng.uniform(30, 50, (COUNT, 1))
    seen = CAMERA.project(points @ MOTION[:3, :3].T + MOTION[:3, 3])
    pixels = seen + moved_px + rng.normal(0, 0.3, (COUNT, 2))
    points = points * np.exp(rng.normal(0, depth_error, (COUNT, 1)))
    return Correspondences2D3D(points, pixels, 1.0, 0), seen


def _moves(correspondences: Correspondences2D3D) -> np.ndarray:
    return np.nan_to_num(nonrigidity(correspondences, CAMERA, MOTION, 0.2)) > MOVING_SIGMAS


@pytest.mark.parametrize("depth_error", [0.0, 0.15])
def test_nothing_moves_in_a_rigid_scene(depth_error: float) -> None:
    assert not _moves(_correspondences(np.zeros((COUNT, 2)), depth_error)[0]).any()


def test_the_region_that_moves_is_found_and_no_other() -> None:
    _, seen = _correspondences(np.zeros((COUNT, 2)))
    there = (seen[:, 0] >= 200) & (seen[:, 0] < 280) & (seen[:, 1] >= 80) & (seen[:, 1] < 160)
    moves = _moves(_correspondences(np.where(there[:, None], [3.0, 3.0], 0.0))[0])
    expected = np.zeros(REGIONS, bool)
    expected[2:4, 5:7] = True
    np.testing.assert_array_equal(moves, expected)


def test_regions_with_few_corners_are_unknown() -> None:
    all_of_them, seen = _correspondences(np.zeros((COUNT, 2)))
    kept = seen[:, 0] < 150
    few = Correspondences2D3D(all_of_them.points_mm[kept], all_of_them.pixels[kept], 1.0, 0)
    found = nonrigidity(few, CAMERA, MOTION, 0.2)
    assert np.isfinite(found[:, :3]).all()
    assert np.isnan(found[:, 4:]).all()


def test_shares_are_of_the_frames_that_see_a_place() -> None:
    moving = MovingTissue(10.0)
    wall = np.full((240, 320), 60.0)
    wall[:, :160] = np.nan  # the left half is never seen
    pushed = np.zeros(REGIONS, np.float32)
    pushed[:, 6:] = 8.0
    for values in (pushed, np.zeros(REGIONS, np.float32), np.full(REGIONS, np.nan, np.float32), pushed):
        moving.put(wall, values, CAMERA, np.eye(4))
    rays = CAMERA.unproject(np.array([[300.0, 120.0], [190.0, 120.0], [40.0, 120.0]]))
    np.testing.assert_allclose(moving.shares(60.0 * rays), [2 / 3, 0, 0], atol=1e-6)
    assert MovingTissue(10.0).shares(rays).tolist() == [0, 0, 0]


def _frame(depth_mm: np.ndarray, valid: np.ndarray) -> Frame:
    rgb = np.broadcast_to(np.array([200, 90, 80], np.uint8), (240, 320, 3)).copy()
    return Frame(3, 0.1, rgb, CAMERA, valid, depth_mm.astype(np.float32), np.eye(4))


def test_a_frames_surface_has_its_usable_pixels_and_no_wall_between_depths() -> None:
    depth_mm = np.full((240, 320), 40.0)
    depth_mm[:, 160:] = 80.0
    valid = np.ones((240, 320), bool)
    valid[100:140, 40:80] = False
    mesh = depth_mesh(_frame(depth_mm, valid), 2, 0.1)
    assert sorted(set(np.round(mesh.vertices[:, 2]))) == [40, 80]
    assert len(set(np.ptp(np.round(mesh.triangles[:, :, 2]), axis=1))) == 1  # no face joins the two depths
    pixels = np.round(CAMERA.project(np.asarray(mesh.vertices))).astype(int)
    assert valid[pixels[:, 1], pixels[:, 0]].all()
    assert len(mesh.vertices) == 120 * 160 - 20 * 20
    assert (mesh.face_normals[:, 2] < 0).all()
    assert (mesh.visual.vertex_colors[:, :3] == [200, 90, 80]).all()


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera at rest before a wall of which a part is pushed."""
    folder = tmp_path_factory.mktemp("pushed")
    write_tiny(folder / "moving", frames=6)
    pose = (folder / "moving" / "pose.txt").read_text().splitlines()[0]
    path = folder / "path.txt"
    path.write_text("\n".join([pose] * 10) + "\n")
    spec = PhantomSpec("laparoscopy", width=160, height=128, seed=3, path_file=path, events=parse_events("poke:4-6"))
    write_phantom(spec, folder / "phantom")
    return folder / "phantom"


@pytest.fixture(scope="module")
def run(pushed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("at_rest") / "run"
    settings = {"depth.backend": f"files:{pushed}", "tracking.camera_at_rest": True, "tracking.keyframe_every": 4}
    reconstruct(open_sequence(pushed), Config.load(settings=settings), out=out)
    return out


def test_a_camera_at_rest_stays_and_every_frame_has_its_surface(run: Path, pushed: Path) -> None:
    rows = frame_rows(run)
    assert [row["status"] for row in rows] == ["initial"] + ["ok"] * 9
    share = np.array([float(row["moving_share"] or "nan") for row in rows])
    assert np.nanmax(share[:5]) == 0.0
    assert 0.02 < np.nanmax(share[5:8]) < 0.5
    most = rows[int(np.nanargmax(share))]
    assert (float(most["moving_x"]), float(most["moving_y"])) == pytest.approx((0.68, 0.5), abs=0.15)
    lines = [line for line in (run / "trajectory.tum").read_text().splitlines() if not line.startswith("#")]
    assert {line.split(" ", 1)[1] for line in lines} == {lines[0].split(" ", 1)[1]}
    assert sorted(file.name for file in (run / "surfaces").glob("0*.ply")) == [
        f"{index:06d}.ply" for index in range(10)
    ]
    camera = open_sequence(pushed).camera
    for index in (0, 9):
        vertices = np.asarray(trimesh.load(run / "surfaces" / f"{index:06d}.ply", process=False).vertices)
        column, row = np.rint(camera.project(vertices)).astype(int).T
        truth_mm = read_decoded(pushed / f"{index:04d}_depth.tiff")[row, column] * np.float64(100 / 65535)
        assert len(vertices) > 5000
        assert np.median(np.abs(vertices[:, 2] - truth_mm)) < 0.05


@pytest.mark.parametrize(("stated", "stays"), [(None, True), (False, False)])
def test_the_camera_rests_where_the_data_set_states_it(
    pushed: Path, tmp_path: Path, stated: bool | None, stays: bool
) -> None:
    sequence = open_sequence(pushed)
    sequence.source.camera_at_rest = True
    settings = {"depth.backend": f"files:{pushed}", "tracking.camera_at_rest": stated, "fusion.enabled": False}
    found = reconstruct(sequence, Config.load(settings=settings), out=tmp_path / "run")
    codes = {notice["code"] for notice in found.provenance["notices"]}
    assert ("camera-at-rest-stated" in codes) is stays
    assert (tmp_path / "run" / "surfaces" / "000009.ply").is_file() is stays
    assert found.config.tracking.camera_at_rest is stays


def test_depth_of_a_camera_at_rest_leaves_no_room_for_an_adjustment(pushed: Path) -> None:
    def largest_mm(settings: dict[str, object]) -> float:
        config = Config.load(settings=settings)
        return largest_depth_mm(config, create_estimators(config, open_sequence(pushed)))

    at_rest_mm = largest_mm({"tracking.camera_at_rest": True})
    assert at_rest_mm == largest_mm({"mapping.method": "none"})
    assert at_rest_mm < largest_mm({})


@pytest.mark.parametrize("at_rest", [True, False])
def test_depth_is_averaged_where_no_parallax_corrects_it(pushed: Path, at_rest: bool) -> None:
    config = Config.load(settings={"tracking.camera_at_rest": at_rest})
    assert ("answers" in create_estimators(config, open_sequence(pushed)).depth.provenance()) == at_rest


def test_a_killed_run_of_a_camera_at_rest_ends_alike(
    run: Path, pushed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scopemap.runner.checkpoints._LEAST_S", 0.0)
    monkeypatch.setattr("scopemap.runner.checkpoints._SHARE", 1.0)
    config, out = Config.load(file=run / "config.toml"), tmp_path / "killed"

    for last in (3, 6, 8):

        def kill(step: Step, last: int = last) -> None:
            if step.frame.index >= last:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            reconstruct(open_sequence(pushed), config, out=out, observers=(kill,))
    resumed = reconstruct(open_sequence(pushed), config, out=out)
    assert resumed.provenance["resumed_after_frame"] >= 1
    whole = reconstruct(open_sequence(pushed), config, out=tmp_path / "whole")
    check_alike(resumed, whole)
    names = [sorted(file.name for file in (folder / "surfaces").iterdir()) for folder in (out, tmp_path / "whole")]
    assert names[0] == names[1]


def test_a_black_frame_is_lost_and_the_next_is_not() -> None:
    settings = Config().tracking
    tracker = CameraAtRest(settings, DisFlow())
    wall, everywhere = np.full((240, 320), 40.0), np.ones((240, 320), bool)
    status = []
    for valid in (everywhere, np.zeros_like(everywhere), everywhere):
        frame = _frame(wall, valid)
        track = tracker.track(frame)
        status.append(track.status)
        if track.decision.kind == "new":
            assert tracker.update(frame, track.decision, measured=False)
    assert status == ["initial", "lost", "ok"]
    unknown = CameraAtRest(settings, DisFlow())
    decision = unknown.track(_frame(wall, everywhere)).decision
    assert not unknown.update(_frame(np.full((240, 320), np.nan), everywhere), decision, measured=False)
