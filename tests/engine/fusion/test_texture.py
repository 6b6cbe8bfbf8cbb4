"""The texture of a surface: known cameras see a plane with a known pattern, and the texture reproduces it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.apps.export.surfaces import write_surface
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.mesh_files import read_textured, save_mesh
from scopemap.engine.fusion.open_glb import texture_picture
from scopemap.engine.fusion.texture import textured_mesh
from scopemap.engine.fusion.texture_levels import chart_vertices, level_gains
from scopemap.engine.fusion.texture_views import choose_views, pieces_of, spread
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.result.result import Result

CAMERA = PinholeCamera(100.0, 100.0, 79.5, 59.5, 160, 120)
FINE = CAMERA.resized(640, 480)
FAR_MM, SPACING_MM = 50.0, 2.0


def _pattern(points: np.ndarray) -> np.ndarray:
    """Return the colours (..., 3), levels, of places x, y in mm: a wave shorter than a triangle, on a smooth ground."""
    x, y = points[..., 0], points[..., 1]
    wave = 25 * np.sin(2 * np.pi * x / 1.6) * np.sin(2 * np.pi * y / 1.6)
    return np.stack([150 + wave + 0.3 * x, 100 + wave, 90 + wave - 0.3 * y], axis=-1)


def _plane(half_mm: float, z_mm: float) -> trimesh.Trimesh:
    axis = np.arange(-half_mm, half_mm + SPACING_MM / 2, SPACING_MM)
    x, y = np.meshgrid(axis, axis)
    vertices = np.stack([x, y, np.full_like(x, z_mm)], axis=-1).reshape(-1, 3)
    n = len(axis)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + n, first + 1], 1), np.stack([first + 1, first + n, first + n + 1], 1)]
    )
    smooth = _pattern(vertices) - (_pattern(vertices)[:, 1:2] - 100)
    return trimesh.Trimesh(vertices, faces, vertex_colors=np.round(smooth).astype(np.uint8), process=False)


def _pose(x_mm: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x_mm
    return pose


def _picture(camera: PinholeCamera, x_mm: float, gain: float) -> np.ndarray:
    """Return what a camera at x sees of the plane, 4 x 4 rays a pixel, (H, W, 3) uint8."""
    fine = camera.resized(4 * camera.width, 4 * camera.height)
    levels = _pattern(fine.rays[..., :2] * FAR_MM + [x_mm, 0])
    mean = levels.reshape(camera.height, 4, camera.width, 4, 3).mean(axis=(1, 3))
    return np.clip(np.round(gain * mean), 0, 255).astype(np.uint8)


def _frames(gains: Sequence[float] = (1.0, 1.0), valid: np.ndarray | None = None) -> list[Frame]:
    valid = np.ones((CAMERA.height, CAMERA.width), bool) if valid is None else valid
    places = (-12.0, 12.0)
    return [
        Frame(number, 0.0, _picture(CAMERA, x, gain), CAMERA, valid, T_world_camera=_pose(x))
        for number, (x, gain) in enumerate(zip(places, gains, strict=True))
    ]


def _textured(mesh: trimesh.Trimesh, frames: list[Frame], gains: Sequence[float] = (1.0, 1.0)) -> trimesh.Trimesh:
    def pictures(numbers: Sequence[int], camera: PinholeCamera) -> Iterator[tuple[int, np.ndarray]]:
        for index in numbers:
            pose = frames[index].T_world_camera
            assert pose is not None
            yield index, _picture(camera, float(pose[0, 3]), gains[index])

    numbers, label = choose_views(mesh, frames)
    views = [frames[index] for index in numbers]
    return textured_mesh(mesh, label, views, frames, pictures, FINE.width)


def _errors(shown: trimesh.Trimesh, x_mm: float = 0.0) -> np.ndarray:
    """Return the difference to the pattern in the middle of a view, levels."""
    wanted = _picture(FINE, x_mm, 1.0).astype(float)[120:360, 160:480]
    return np.abs(render_mesh(shown, FINE, _pose(x_mm)).rgb[120:360, 160:480] - wanted)


@pytest.mark.slow
def test_texture_shows_the_pattern_that_vertex_colours_cannot() -> None:
    mesh = _plane(30, FAR_MM)
    shown = _textured(mesh, _frames())
    assert np.median(_errors(mesh)) > 6
    assert np.median(_errors(shown)) < 2
    assert np.percentile(_errors(shown), 99) < 8


def test_triangles_keep_their_order_and_place() -> None:
    mesh = _plane(30, FAR_MM)
    shown = _textured(mesh, _frames())
    np.testing.assert_allclose(shown.triangles, mesh.triangles)
    uv = np.asarray(shown.visual.uv)
    assert ((uv >= 0) & (uv <= 1)).all()


@pytest.mark.slow
def test_views_of_different_exposure_are_levelled() -> None:
    mesh, gains = _plane(30, FAR_MM), (0.7, 1.3)
    shown = _textured(mesh, _frames(gains), gains)
    assert np.median(_errors(shown)) < 4
    assert np.percentile(_errors(shown), 99) < 20


def test_a_chart_is_painted_in_its_colours() -> None:
    mesh, colour = _plane(4, FAR_MM), np.array([150, 100, 90], np.uint8)
    mesh.visual.vertex_colors = np.broadcast_to(colour, (len(mesh.vertices), 3))
    frame = replace(_frames()[0], rgb=np.full((CAMERA.height, CAMERA.width, 3), colour), T_world_camera=_pose(0.0))

    def pictures(numbers: Sequence[int], camera: PinholeCamera) -> Iterator[tuple[int, np.ndarray]]:
        yield from ((number, np.full((camera.height, camera.width, 3), colour)) for number in numbers)

    _, label = choose_views(mesh, [frame])
    shown = textured_mesh(mesh, label, [frame], [frame], pictures, FINE.width)
    texture = texture_picture(shown)
    height, width = texture.shape[:2]
    column, row = (np.asarray(shown.visual.uv) * [width, -height] + [0, height]).astype(int).T
    painted = texture[np.minimum(row, height - 1), np.minimum(column, width - 1)].astype(int)
    np.testing.assert_allclose(painted, np.broadcast_to(colour, painted.shape), atol=1)


def test_hidden_triangles_get_no_colour_from_what_is_in_front() -> None:
    far, near = _plane(30, FAR_MM), _plane(6, 25.0)
    mesh = trimesh.util.concatenate([far, near])
    frames = _frames()[:1]
    _, label = choose_views(mesh, frames)
    # The near plane, 12 mm wide, hides twice its size at twice the distance.
    centres = mesh.triangles_center
    behind = (centres[:, 2] == FAR_MM) & (np.abs(centres[:, 0] - 12) < 9) & (np.abs(centres[:, 1]) < 9)
    assert behind.any()
    assert (label[behind] == -1).all()
    assert (label[(centres[:, 2] == FAR_MM) & (centres[:, 0] < -10) & (np.abs(centres[:, 1]) < 15)] == 0).all()


def test_nothing_comes_from_the_border_of_a_mask() -> None:
    # As an instrument: black where the mask says so, and a little beyond.
    valid = np.ones((CAMERA.height, CAMERA.width), bool)
    valid[:, 100:] = False
    mesh, frames = _plane(30, FAR_MM), _frames(valid=valid)[:1]
    black = frames[0].rgb.copy()
    black[:, 99:] = 0

    def pictures(numbers: Sequence[int], camera: PinholeCamera) -> Iterator[tuple[int, np.ndarray]]:
        picture = _picture(camera, -12.0, 1.0)
        picture[:, 4 * 99 :] = 0
        yield 0, picture

    frame = Frame(0, 0.0, black, CAMERA, valid, T_world_camera=_pose(-12.0))
    numbers, label = choose_views(mesh, [frame])
    assert numbers == [0]
    shown = textured_mesh(mesh, label, [frame], [frame], pictures, FINE.width)
    seen = render_mesh(shown, FINE, _pose(0.0))
    assert seen.rgb[np.isfinite(seen.depth_mm)].min() > 30


def test_a_surface_that_no_frame_shows_keeps_the_colours_of_its_vertices() -> None:
    mesh, frames = _plane(30, FAR_MM), _frames(valid=np.zeros((CAMERA.height, CAMERA.width), bool))
    assert choose_views(mesh, frames)[0] == []
    half = np.ones((CAMERA.height, CAMERA.width), bool)
    half[:, 60:] = False
    shown = _textured(mesh, _frames(valid=half)[:1])
    unlike = np.abs(render_mesh(shown, FINE, _pose(12.0)).rgb.astype(int) - render_mesh(mesh, FINE, _pose(12.0)).rgb)
    assert unlike[:, 320:].max() <= 3


@pytest.mark.slow
def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    mesh = _plane(30, FAR_MM)
    for name in ("one.glb", "two.glb"):
        save_mesh(mesh, glb_file=tmp_path / name, textured=_textured(mesh, _frames()))
    assert (tmp_path / "one.glb").read_bytes() == (tmp_path / "two.glb").read_bytes()


@pytest.mark.slow
def test_glb_holds_the_texture(tmp_path: Path) -> None:
    mesh, file = _plane(30, FAR_MM), tmp_path / "mesh.glb"
    shown = _textured(mesh, _frames())
    save_mesh(mesh, glb_file=file, textured=shown)
    read = read_textured(file)
    assert read is not None
    np.testing.assert_allclose(read.triangles, mesh.triangles, atol=1e-3)
    np.testing.assert_allclose(read.visual.uv, shown.visual.uv, atol=1e-6)
    assert np.median(_errors(read)) < 3
    # Those of the surface, which is smooth across the seams of its texture, not those of the triangles of a piece.
    leaning = np.tile([0.6, 0.0, -0.8], (len(shown.vertices), 1))
    smooth = trimesh.Trimesh(shown.vertices, shown.faces, vertex_normals=leaning, visual=shown.visual, process=False)
    save_mesh(mesh, glb_file=file, textured=smooth)
    np.testing.assert_allclose(read_textured(file).vertex_normals, leaning, atol=1e-6)
    save_mesh(mesh, glb_file=file)
    assert read_textured(file) is None
    assert read_textured(tmp_path / "none.glb") is None


@pytest.mark.slow
def test_obj_has_the_texture_beside_it(tmp_path: Path) -> None:
    mesh = _plane(30, FAR_MM)
    shown = _textured(mesh, _frames())
    save_mesh(mesh, tmp_path / "mesh.ply", tmp_path / "mesh.glb", textured=shown)
    write_surface(Result(tmp_path), tmp_path / "mesh.obj", "mm", "ras")
    assert {"mesh.mtl", "mesh.jpg"} <= {file.name for file in tmp_path.iterdir()}
    read = trimesh.load(tmp_path / "mesh.obj", process=False)
    np.testing.assert_allclose(read.triangles, mesh.triangles * [-1, -1, 1], atol=1e-3)
    turned = trimesh.Trimesh(read.vertices * [-1, -1, 1], read.faces, visual=read.visual, process=False)
    assert np.median(_errors(turned)) < 3


@settings(deadline=None)
@given(st.integers(1, 40), st.integers(1, 12))
def test_frames_are_spread_over_all(count: int, most: int) -> None:
    numbers = list(range(0, 3 * count, 3))
    found = spread(numbers, [float(number % 5) for number in numbers], most)
    assert len(found) == min(count, most)
    assert found == sorted(set(found))
    assert set(found) <= set(numbers)


@pytest.mark.parametrize("factor", [0.6, 1.5])
def test_gains_undo_an_exposure(factor: float) -> None:
    mesh = _plane(10, FAR_MM)
    chart = (mesh.triangles_center[:, 0] > 0).astype(int)
    places = chart_vertices(np.asarray(mesh.faces), chart)
    surface = np.full((len(places.chart), 3), 100.0)
    shown = surface * np.where(places.chart == 1, factor, 1.0)[:, None]
    gains = level_gains(places, shown, surface)
    np.testing.assert_allclose(gains * shown, surface, rtol=0.01)


def test_a_small_patch_of_another_view_takes_the_view_around_it() -> None:
    mesh, window = _plane(14, FAR_MM), np.zeros((CAMERA.height, CAMERA.width), bool)
    window[49:71, 69:91] = True  # 2 px along its border are left out: 32 triangles are shown
    whole = Frame(0, 0.0, _picture(CAMERA, 0.0, 1.0), CAMERA, np.ones_like(window), T_world_camera=_pose(0.0))
    sharp_patch = replace(whole, index=1, valid=window)
    blurred = replace(whole, quality=0.5)
    assert choose_views(mesh, [sharp_patch])[0] == [1]
    numbers, label = choose_views(mesh, [blurred, sharp_patch])
    assert numbers == [0]
    assert (label == 0).all()


def test_pieces_are_connected() -> None:
    mesh = _plane(10, FAR_MM)
    label = (np.abs(mesh.triangles_center[:, 0]) > 5).astype(np.int32)
    piece, count = pieces_of(label, np.asarray(mesh.face_adjacency))
    assert count == 3
    assert len(np.unique(piece[label == 0])) == 1
