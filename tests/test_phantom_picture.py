"""The phantom's pictures: the physics of its lamp, its noise, its bad segments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scopemap_bench.phantom.deformation import REST
from scopemap_bench.phantom.march import march
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.shading import develop, shade
from scopemap_bench.phantom.spec import PhantomSpec, parse_events
from scopemap_bench.phantom.volume import Volume

SMALL = {"width": 64, "height": 48, "frames": 6}


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
    spec = PhantomSpec(deform=True, breath_frames=8.0, **SMALL)
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
    plain = prepare(PhantomSpec(noise=0.0, **SMALL))
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
