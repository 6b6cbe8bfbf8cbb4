"""States of moving tissue: of surfaces and frames, in files, and played by another program."""

from __future__ import annotations

import shutil
from base64 import b64encode
from pathlib import Path

import numpy as np
import pytest
import trimesh
from drawn_run import FRAMES, IN_RESULT, draw_run, drawn_result, tube, wavering
from trimesh.viewer.notebook import scene_to_html

from scopemap.apps.export.formats import export_run
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import surface_agreement, surface_views, vertex_sigmas
from scopemap.engine.fusion.mesh_files import T_GLTF_WORLD, read_mesh, save_mesh_over_time
from scopemap.engine.fusion.reference_state import SurfaceState, in_surface_state
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.engine.mapping.tissue_states import TISSUE_MOTION, TissueStates
from scopemap.report.page_data import page_data, shown_meshes
from scopemap.result.result import Result

CAMERA = PinholeCamera(100.0, 100.0, 79.5, 63.5, 160, 128)
Z_MM = 50.0
MOVED = np.array([1.5, -1.0, 4.0])  # mm, of all tissue, where the curve is 1
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


def sliding(T_world_camera: np.ndarray) -> TissueStates:
    """A wall in front of a camera that moves as a whole, by `MOVED` in the camera, from frame 0 to frame 1."""
    x, y = np.meshgrid(np.linspace(-60, 60, 5), np.linspace(-50, 50, 4))
    nodes = np.stack([x, y, np.full(x.shape, Z_MM)], -1).reshape(-1, 3)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    index, curves = np.array([0, 10]), np.array([[0.0], [1.0]])
    modes = np.tile(R @ MOVED, (1, len(nodes), 1))
    return TissueStates(nodes @ R.T + t, modes, index, index / 10, curves, np.zeros(1))


def wall(depth_mm: float, aside: np.ndarray, index: int, T_world_camera: np.ndarray) -> Frame:
    """A frame of a wall across the view with a smooth pattern, displaced by `aside` (2,), mm, in its plane."""
    x, y = np.moveaxis(CAMERA.rays[..., :2] * depth_mm - aside, -1, 0)
    grey = 128 + 50 * np.sin(x / 4) + 50 * np.sin(y / 5)
    rgb = np.repeat(grey[..., None], 3, -1).astype(np.uint8)
    depth = np.full(rgb.shape[:2], depth_mm, np.float32)
    return Frame(index, index / 10, rgb, CAMERA, depth > 0, depth, T_world_camera, depth_sigma_mm=0.01 * depth)


@pytest.mark.parametrize("index", [3, 10])
def test_a_frame_is_moved_to_what_its_camera_would_have_seen_in_the_state_of_the_surface(index: int) -> None:
    pose = se3(so3_exp(np.array([0.2, -0.4, 0.1])), np.array([10.0, 20.0, 5.0]))
    moved = MOVED * index / 10
    seen, wanted = wall(Z_MM + moved[2], moved[:2], index, pose), wall(Z_MM, np.zeros(2), 0, pose)
    found = SurfaceState(sliding(pose)).fused(seen)
    assert found.valid[10:-10, 10:-10].all()
    assert np.asarray(found.depth_mm)[found.valid] == pytest.approx(Z_MM, abs=0.02)
    difference = np.abs(found.rgb.astype(int) - wanted.rgb)[found.valid]
    assert np.percentile(difference, 95) <= 4
    assert np.abs(seen.rgb.astype(int) - wanted.rgb)[found.valid].mean() > 3 * difference.mean()


def test_what_comes_into_view_is_not_usable_and_a_frame_in_that_state_stays_as_it_is() -> None:
    pose = np.eye(4)
    assert in_surface_state(frame := wall(Z_MM, np.zeros(2), 0, pose), sliding(pose)) is frame
    holes = wall(Z_MM, np.zeros(2), 10, pose)
    holes.valid[60:70, 70:90] = False
    assert holes.depth_mm is not None
    holes.depth_mm[20:30, 20:30] = np.nan
    found = in_surface_state(holes, sliding(pose))
    assert 0.7 * 200 < (~found.valid[40:90, 50:120]).sum() < 1.6 * 200  # as large as before, elsewhere
    assert np.isnan(np.asarray(found.depth_mm)[10:45, 10:45]).sum() == pytest.approx(100, rel=0.5)
    empty = wall(Z_MM, np.zeros(2), 10, pose)
    empty.depth_mm[:] = np.nan  # type: ignore[index]
    assert in_surface_state(empty, sliding(pose)) is empty


def test_frames_of_different_states_agree_with_one_surface() -> None:
    pose, states = np.eye(4), sliding(np.eye(4))
    frames = [wall(Z_MM + MOVED[2] * k / 10, MOVED[:2] * k / 10, k, pose) for k in range(11)]
    settings = drawn_result().config.fusion.model_copy(update={"voxel_mm": 1.0})
    one_state, mean = TsdfVolume(settings), TsdfVolume(settings)
    for frame in frames:
        one_state.integrate(in_surface_state(frame, states))
        mean.integrate(frame)
    sharp, smeared = one_state.extract_mesh(), mean.extract_mesh()
    views = surface_views(sharp, frames, states)
    found, worse = (surface_agreement(seen, settings) for seen in (views, surface_views(smeared, frames)))
    assert found["depth_error"] < 0.002 < 0.015 < worse["depth_error"]
    sigma_mm = vertex_sigmas(len(sharp.vertices), views)
    assert np.nanmedian(sigma_mm) == pytest.approx(0.01 * Z_MM, rel=0.1)  # that of the depth itself


def test_the_surface_is_in_the_most_usual_state() -> None:
    states = sliding(np.eye(4))
    curves = np.array([0, 0.1, 1, 0.1, 0.12, 0])[:, None]
    index = np.arange(6)
    many = TissueStates(states.nodes, states.modes, index, index / 10, curves, np.zeros(1))
    assert many.in_usual_state().reference == pytest.approx([0.1])


def test_a_result_keeps_its_states(tmp_path: Path) -> None:
    states = wavering()
    run = Result(draw_run(tmp_path, states=states))
    assert run.states is not None
    for name, values in vars(states).items():
        np.testing.assert_array_equal(getattr(run.states, name), values)
    shown = page_data(run, shown_meshes(run, 2000))["maps"]
    assert len(shown[0]["changes"]) == FRAMES
    assert shown[0]["changes"][0] == [-3.0]
    assert "changes" not in shown[1]
    (tmp_path / TISSUE_MOTION).write_bytes(b"damaged")
    with pytest.raises(InputError, match=TISSUE_MOTION):
        assert Result(tmp_path).states
    np.savez(tmp_path / TISSUE_MOTION, **(vars(states) | {"modes": states.modes[:, 1:]}))
    with pytest.raises(InputError, match="damaged"):
        assert Result(tmp_path).states


def test_other_programs_read_the_surface_over_time(tmp_path: Path) -> None:
    states, file = wavering(), tmp_path / "mesh_over_time.glb"
    save_mesh_over_time(tube(), states, file)
    read = trimesh.load(file, force="mesh", process=False)
    assert isinstance(read, trimesh.Trimesh)
    lowest = states.moved(tube(), 0)
    assert np.asarray(read.vertices) == pytest.approx(lowest.vertices @ T_GLTF_WORLD[:3, :3].T, abs=1e-6)
    assert len(read.faces) == len(tube().faces)
    save_mesh_over_time(trimesh.Trimesh(), states, other := tmp_path / "none.glb")
    assert not other.exists()


def test_the_surface_of_each_frame_is_exported(tmp_path: Path) -> None:
    states, run = wavering(), draw_run(tmp_path / "run", states=wavering())
    export_run(run, "surfaces", tmp_path / "out", unit="m", axes="ras")
    assert len(list((tmp_path / "out").iterdir())) == IN_RESULT
    read = read_mesh(tmp_path / "out" / "000005.ply")
    wanted = states.moved(Result(run).mesh, 5).vertices * [-0.001, -0.001, 0.001]
    assert np.asarray(read.vertices) == pytest.approx(wanted, abs=1e-6)
    with pytest.raises(InputError, match="at rest"):
        export_run(draw_run(tmp_path / "rigid"), "surfaces", tmp_path / "none")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)")
def test_the_surface_over_time_plays_in_a_browser(tmp_path: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    states, file = wavering(), tmp_path / "mesh_over_time.glb"
    save_mesh_over_time(tube(), states, file)
    # The page that trimesh brings holds three.js, whose loader and player are asked here.
    page_file = tmp_path / "three.html"
    page_file.write_text(scene_to_html(trimesh.Scene(trimesh.creation.box())))
    play = """([content, seconds]) => new Promise((done, failed) => new THREE.GLTFLoader().load(content, (read) => {
        const mixer = new THREE.AnimationMixer(read.scene), found = [];
        const [clip] = read.animations, mesh = read.scene.getObjectByProperty('isMesh', true);
        mixer.clipAction(clip).play();
        const start = mesh.morphTargetInfluences[0], position = mesh.geometry.attributes.position;
        const target = mesh.geometry.morphAttributes.position[0];
        for (const second of seconds) {
            mixer.setTime(second);
            const weight = mesh.morphTargetInfluences[0];
            found.push([0, 1, 2].map((k) => position.array[k] + weight * target.array[k]));
        }
        done({ start, found, duration: clip.duration });
    }, undefined, failed))"""
    content = "data:model/gltf-binary;base64," + b64encode(file.read_bytes()).decode()
    with playwright.sync_playwright() as driver:
        arguments = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        page = driver.chromium.launch(executable_path=CHROMIUM, args=arguments).new_page()
        page.goto(page_file.as_uri())
        played = page.evaluate(play, [content, [0.0, 5 / 25, 20 / 25]])
    assert played["duration"] == pytest.approx((FRAMES - 1) / 25)
    assert played["start"] == pytest.approx(3 / (FRAMES - 1))
    for index, found in zip((0, 5, 20), played["found"], strict=True):
        assert found == pytest.approx(T_GLTF_WORLD[:3, :3] @ states.moved(tube(), index).vertices[0], abs=1e-6)
