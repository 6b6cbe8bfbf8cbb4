"""What a phantom shows: its lamp and noise, its camera, its path, and what happens on the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3, so3_exp
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.opening import open_sequence
from scopemap.input.trajectory.text import read_poses
from scopemap_bench.phantom.instrument import Capsules, insert
from scopemap_bench.phantom.march import Volume, march, rays_of
from scopemap_bench.phantom.motion import REST, lumen_path, sweep_path, turned
from scopemap_bench.phantom.render import Phantom, light, prepare, render_frame
from scopemap_bench.phantom.shading import VideoCoding, develop, lagging_gains, shade
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.writer import write_phantom

pytestmark = pytest.mark.slow

# ---- the camera: motion blur, exposure, coding, lens


STILL = PhantomSpec(width=64, height=48, frames=6, seed=3, noise=0.0)


@pytest.fixture(scope="module")
def still() -> Phantom:
    return prepare(STILL)


def turning(phantom: Phantom, step_rad: float) -> Phantom:
    """The phantom with a camera that yaws by `step_rad` from frame to frame."""
    start = phantom.poses[2]
    poses = np.stack([start @ se3(so3_exp(np.array([0, n * step_rad, 0])), np.zeros(3)) for n in range(5)])
    return replace(phantom, poses=poses)


def test_motion_blurs_across_its_direction_alone_and_leaves_depth(still: Phantom) -> None:
    moving = turning(still, 8.0 / STILL.camera.fx)
    sharp, surface = light(moving, 2)
    blurred, same = light(replace(moving, spec=replace(STILL, shutter=1.0)), 2)
    np.testing.assert_array_equal(surface.depth_mm, same.depth_mm)
    np.testing.assert_allclose(blurred.mean(), sharp.mean(), rtol=0.1)

    def roughness(image: np.ndarray, axis: int) -> float:
        return float(np.abs(np.diff(np.log(image[..., 1] + 1e-9), 2, axis)).mean())

    assert roughness(blurred, 1) < 0.5 * roughness(sharp, 1)
    assert roughness(blurred, 0) > 1.5 * roughness(blurred, 1)
    still = turning(still, 0.0)
    np.testing.assert_array_equal(light(replace(still, spec=replace(STILL, shutter=1.0)), 2)[0], light(still, 2)[0])


def test_gains_follow_late() -> None:
    wanted = np.array([1.0, 4.0, 4.0, 4.0, 4.0])
    np.testing.assert_allclose(lagging_gains(wanted, 0.0), wanted)
    late = lagging_gains(wanted, 2.0)
    np.testing.assert_allclose(np.log(late) / np.log(4), 1 - np.exp(-np.arange(5) / 2))


def test_coding_is_coarser_with_a_larger_factor_and_repeatable(still: Phantom) -> None:
    frames = [render_frame(still, n)[0][:47, :63] for n in range(4)]
    errors = {}
    for crf in (10, 40):
        coding = VideoCoding(crf, 63, 47)
        first = [coding(rgb) for rgb in frames]
        again = VideoCoding(crf, 63, 47)
        for one, rgb in zip(first, frames, strict=True):
            assert one.shape == rgb.shape
            np.testing.assert_array_equal(one, again(rgb))
        errors[crf] = [np.abs(a.astype(int) - b).mean() for a, b in zip(first, frames, strict=True)]
    assert max(errors[10]) < 6
    assert np.mean(errors[40]) > 1.5 * np.mean(errors[10])


def test_a_scene_is_seen_through_the_lens_of_a_calibration(tmp_path: Path) -> None:
    lens = FisheyeCamera(PinholeCamera(60.0, 60.0, 63.0, 48.0, 128, 96), (-0.14, 0.0, 0.0015, -0.0001))
    write_calibration(lens, tmp_path / "lens.yaml")
    spec = replace(STILL, frames=2, camera_file=tmp_path / "lens.yaml")
    write_phantom(spec, tmp_path / "seen")
    sequence = open_sequence(tmp_path / "seen")
    found = sequence.rectifier.source
    assert isinstance(found, FisheyeCamera)
    assert found.plane == lens.resized(64, 48).plane
    # Both cameras show the same surface: what the lens saw at a pixel is at the place where a pinhole sees it.
    fisheye, pinhole = prepare(spec), prepare(replace(STILL, frames=2))
    rays = rays_of(fisheye.spec.camera)
    seen = march(fisheye.volume, fisheye.spec.camera, fisheye.poses[0], fisheye.motion.at(0)).depth_mm
    assert np.isnan(rays[0, 0]).all()
    assert np.isnan(seen[0, 0])
    points = (rays * seen[..., None])[20:28, 28:36].reshape(-1, 3)
    plain = march(pinhole.volume, STILL.camera, pinhole.poses[0], pinhole.motion.at(0)).depth_mm
    x, y = np.rint(STILL.camera.project(points)).astype(int).T
    # Nearly everywhere: behind the edges of folds a pixel's rounding sees something else.
    assert np.mean(np.abs(plain[y, x] / points[:, 2] - 1) < 0.05) > 0.8
    rgb, _ = render_frame(fisheye, 0)
    assert rgb[0, 0].max() < 20 < rgb[24, 32].max()


# ---- events


SMALL = {"width": 64, "height": 48}


def with_events(events: str, frames: int = 30, scene: str = "colon") -> Phantom:
    return prepare(PhantomSpec(scene=scene, frames=frames, seed=5, events=parse_events(events), **SMALL))  # type: ignore[arg - type]


def turns_deg(poses: np.ndarray) -> np.ndarray:
    return np.degrees(rotation_angle_rad((inverse(poses[:-1]) @ poses[1:])[:, :3, :3]))


def test_a_turn_is_30_degrees_and_stays() -> None:
    poses = np.broadcast_to(np.eye(4), (20, 4, 4))
    cut = turned(poses, 8, 8)
    np.testing.assert_allclose(turns_deg(cut), np.where(np.arange(19) == 7, 30.0, 0.0), atol=1e-5)
    slow = turned(poses, 4, 9)
    assert turns_deg(slow).max() < 9
    assert turns_deg(slow)[[0, 1, 2, 9, 10]].max() < 1e-4
    np.testing.assert_allclose(turned(cut, 12, 15, back=True)[15:], poses[15:], atol=1e-12)
    np.testing.assert_array_equal(slow[:, :3, 3], 0)


def test_contact_comes_to_4_mm_of_the_wall_and_goes_back() -> None:
    touching, plain = with_events("contact:6-20"), with_events("")
    space_mm = touching.volume.values_at(touching.poses[:, :3, 3])[0]
    assert 4.0 <= space_mm.min() < 4.6
    assert 12 <= space_mm.argmin() <= 14
    np.testing.assert_allclose(touching.poses[[5, 21]], plain.poses[[5, 21]], atol=1e-9)
    assert turns_deg(touching.poses).max() < 20


@pytest.mark.parametrize("scene", ["colon", "laparoscopy"])
def test_an_instrument_comes_and_goes_and_hides_the_depth_behind_it(scene: str) -> None:
    with_tool = with_events("instrument:4-24", scene=scene)
    without = replace(with_tool, spec=replace(with_tool.spec, events=()))
    hidden = []
    for index in (3, 8, 14, 24, 25):
        (radiance, surface), (bare, tissue) = light(with_tool, index), light(without, index)
        tool = np.isnan(surface.depth_mm) & np.isfinite(tissue.depth_mm)
        np.testing.assert_array_equal(radiance[~tool], bare[~tool])
        np.testing.assert_array_equal(surface.depth_mm[~tool], tissue.depth_mm[~tool])
        hidden.append(tool.mean())
    assert hidden[0] == hidden[4] == 0
    assert 0.02 < hidden[2] < 0.4
    assert hidden[3] < hidden[2]


def test_a_ray_meets_a_capsule_at_its_radius() -> None:
    seen = with_events("")
    _, surface = light(seen, 0)
    camera, ends = seen.spec.camera, np.array([[3.0, -2.0, 9.0], [-2.0, 1.0, 14.0]])
    far = replace(surface, distance_mm=np.full_like(surface.distance_mm, 1e3))
    inserted = []
    for radius in (1.5, 1.6):
        tool = Capsules(ends[None], np.array([radius]), np.ones((1, 3)))
        inserted.append(np.isnan(insert(tool, np.zeros((48, 64, 3), np.float32), far, camera)[1].depth_mm))
    # A ray meets it where it passes the segment at no more than the radius.
    rays = camera.rays / np.linalg.norm(camera.rays, axis=-1, keepdims=True)
    share = np.linspace(0, 1, 2001)[:, None]
    points = ends[0] + share * (ends[1] - ends[0])
    passes = np.min([np.linalg.norm(np.cross(rays, point), axis=-1) for point in points[::10]], axis=0)
    assert inserted[0].sum() > 50
    assert not (inserted[0] & (passes > 1.501)).any()
    assert not ((passes < 1.499) & ~inserted[0]).any()
    assert inserted[1].sum() > inserted[0].sum()


def test_pushed_tissue_moves_two_ways_and_stays_so() -> None:
    pushed = with_events("push:5-15", scene="laparoscopy")
    right, down, ahead = pushed.poses[5, :3, :3].T
    middle = pushed.poses[5, :3, 3] + 60 * ahead
    points = np.stack([middle - 25 * right, middle, middle + 25 * right])
    moved = [pushed.motion.at(time).at(points) @ down for time in (0, 5, 10, 15, 29)]
    np.testing.assert_allclose(moved[:2], 0, atol=1e-9)
    np.testing.assert_allclose(moved[4], moved[3])
    np.testing.assert_allclose(moved[2], 0.5 * moved[3])
    assert moved[3][0] < -4
    assert moved[3][2] > 4
    assert abs(moved[3][1]) < 1e-9


# ---- the picture


SIX = {"width": 64, "height": 48, "frames": 6}


@pytest.fixture(scope="module")
def wall() -> Volume:
    """A plane facing the camera at z = 60."""
    z = np.arange(80.0, dtype=np.float32)[None, None, :]
    return Volume(np.broadcast_to(60.0 - z, (150, 150, 80)).copy(), np.array([-75.0, -75.0, 0.0]), 1.0)


def at_depth(wall: Volume, z: float) -> tuple[np.ndarray, np.ndarray]:
    camera = PhantomSpec(width=41, height=41, fov_deg=60).camera
    T = np.eye(4)
    T[2, 3] = 60.0 - z
    surface = march(wall, camera, T, REST)
    zero = np.zeros((41, 41, 3), np.float32)
    return shade(surface, zero + np.float32(0.5), zero, zero[..., 0], camera)[..., 0], surface.depth_mm


def test_brightness_falls_as_cosine_over_squared_distance(wall: Volume) -> None:
    camera = PhantomSpec(width=41, height=41, fov_deg=60).camera
    cosine = 1 / np.linalg.norm(camera.rays, axis=-1)
    for z in (12.0, 24.0, 48.0):
        radiance, depth = at_depth(wall, z)
        np.testing.assert_allclose(depth, z, atol=1e-4)
        np.testing.assert_allclose(radiance, 0.5 * cosine**3 / z**2, rtol=1e-4)


def test_highlights_sit_where_the_surface_faces_the_lamp(wall: Volume) -> None:
    camera = PhantomSpec(width=41, height=41, fov_deg=60).camera
    T = np.eye(4)
    T[2, 3] = 30.0
    surface = march(wall, camera, T, REST)
    zero = np.zeros((41, 41, 3), np.float32)
    shiny = shade(surface, zero, zero, np.ones((41, 41), np.float32), camera)[..., 0]
    assert np.unravel_index(shiny.argmax(), shiny.shape) == (20, 20)
    assert shiny[20, 30] < 0.01 * shiny[20, 20]


def test_texture_sticks_to_moving_tissue() -> None:
    spec = PhantomSpec(deform=True, breath_frames=8.0, **SIX)
    phantom = prepare(spec)
    displacement = phantom.motion.at(4)
    surface = march(phantom.volume, spec.camera, phantom.poses[0], displacement)
    footprint = np.full(surface.depth_mm.shape, 0.1, np.float32)
    rest = surface.rest_mm.reshape(-1, 3).astype(float)
    moved = displacement.move(rest)
    assert np.linalg.norm(moved - rest, axis=1).max() > 0.5
    again = (moved - displacement.at(moved)).reshape(surface.rest_mm.shape).astype(np.float32)
    look = phantom.appearance
    np.testing.assert_allclose(look.albedo(surface.rest_mm, footprint), look.albedo(again, footprint), atol=1e-3)


def test_noise_has_the_stated_strength() -> None:
    rng = np.random.default_rng(0)
    dark = np.full((200, 200, 3), 0.001, np.float32)
    levels = develop(dark, 0.0, rng).astype(float)
    assert levels.std() == 0
    bright = develop(np.full((200, 200, 3), 0.3, np.float32), 0.01, rng)
    slope = 255 * 1.055 / 2.4 * 0.3 ** (1 / 2.4 - 1)
    expected = slope * 0.01 * np.sqrt(1 + 2.5**2 * 0.3)
    assert bright.astype(float).std() == pytest.approx(expected, rel=0.05)


def test_events_are_seen_where_they_were_ordered() -> None:
    plain = prepare(PhantomSpec(noise=0.0, **SIX))
    events = parse_events("black:1-1, blur:2-3,smoke:4-4")
    bad = replace(plain, spec=replace(plain.spec, events=events))
    pictures = {i: render_frame(bad, i)[0].astype(float) for i in range(6)}
    clear = {i: render_frame(plain, i)[0].astype(float) for i in range(6)}

    def sharpness(rgb: np.ndarray) -> float:
        return float(np.abs(np.diff(rgb[..., 1], axis=1)).mean())

    for index in (0, 5):
        np.testing.assert_array_equal(pictures[index], clear[index])
    assert pictures[1].mean() < 12
    for index in (2, 3):
        assert sharpness(pictures[index]) < 0.75 * sharpness(clear[index])
    assert pictures[4].reshape(-1, 3).std(0).mean() < 0.6 * clear[4].reshape(-1, 3).std(0).mean()
    assert np.abs(pictures[4].mean((0, 1)) - pictures[4].mean()).max() < 15
    np.testing.assert_array_equal(render_frame(bad, 4)[1].depth_mm, render_frame(plain, 4)[1].depth_mm)


# ---- the path


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


@pytest.mark.parametrize(("route", "axis", "share"), [("sideways", 0, 1 / 3), ("withdrawal", 2, None)])
def test_straight_routes_go_where_they_are_told(route: str, axis: int, share: float | None) -> None:
    scene = "abdominal_wall" if share else "colon"
    seen = prepare(PhantomSpec(scene=scene, route=route, seed=5, width=64, height=48))  # type: ignore[arg-type]
    way = np.ptp(seen.poses[:, :3, 3], axis=0)
    assert way[axis] > 4 * np.delete(way, axis).max()
    assert np.linalg.norm(np.diff(seen.poses[:, :3, 3], axis=0), axis=1).max() < 1.0
    if share:
        depth_mm = light(seen, 100)[1].depth_mm
        assert way[axis] / np.median(depth_mm) == pytest.approx(share, rel=0.25)
        assert np.ptp(depth_mm) < 0.25 * np.median(depth_mm)
    assert share or seen.poses[-1, 2, 3] == pytest.approx(-52, abs=3)
    with pytest.raises(SettingsError, match="route wander"):
        replace(seen.spec, loop=True)


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
