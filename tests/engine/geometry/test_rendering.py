"""Rendering of a mesh into a camera, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.rendering import render_mesh, render_points
from scopemap.engine.geometry.se3 import se3, so3_exp

CAMERA = PinholeCamera(60.0, 62.0, 39.5, 31.5, 80, 64)


def _rays() -> np.ndarray:
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    return np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)


def _mesh(vertices: list[list[float]], faces: list[list[int]], colours: list[list[int]]) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, vertex_colors=np.array(colours, np.uint8), process=False)


def test_a_tilted_plane_has_its_depth_and_colours_in_perspective() -> None:
    normal = np.array([0.3, -0.2, 1.0])  # normal . X = 50
    corners = np.array([[-90, -90], [90, -90], [90, 90], [-90, 90]], float)
    z = 50 - corners @ normal[:2]
    grey = np.interp(corners[:, 0], [-90, 90], [0, 240]).astype(int)
    plane = _mesh(np.column_stack([corners, z]).tolist(), [[0, 1, 2], [0, 2, 3]], np.stack([grey] * 3, 1).tolist())
    seen = render_mesh(plane, CAMERA, np.eye(4))
    depth_mm = 50 / (_rays() @ normal)
    np.testing.assert_allclose(seen.depth_mm, depth_mm, rtol=1e-6)
    x_mm = _rays()[..., 0] * depth_mm
    np.testing.assert_allclose(seen.rgb[..., 0], np.interp(x_mm, [-90, 90], [0, 240]), atol=0.51)


def test_a_ball_hides_what_is_behind_it_from_any_pose() -> None:
    ball, centre, radius = trimesh.creation.icosphere(6, 8.0), np.array([3.0, -2.0, 40.0]), 8.0
    ball.apply_translation(centre)
    wall = trimesh.creation.box([400.0, 400.0, 1.0])
    wall.apply_translation([0, 0, 80.0])
    T_world_camera = se3(so3_exp(np.array([0.05, -0.1, 0.4])), np.array([1.0, 2.0, -3.0]))
    scene = trimesh.util.concatenate([wall, ball])
    scene.visual.vertex_colors = np.full((len(scene.vertices), 4), 200, np.uint8)
    seen = render_mesh(scene, CAMERA, T_world_camera)
    rays = _rays() @ T_world_camera[:3, :3].T
    to_centre = centre - T_world_camera[:3, 3]
    along, squared = rays @ to_centre, (rays**2).sum(-1)
    root = along**2 - squared * (to_centre @ to_centre - radius**2)
    inside = root > 2 * squared  # the silhouette is the polyhedron's
    depth_mm = (along[inside] - np.sqrt(root[inside])) / squared[inside]
    np.testing.assert_allclose(seen.depth_mm[inside], depth_mm, rtol=2e-3)
    assert np.isfinite(seen.depth_mm).all()
    assert (seen.depth_mm[root < -2 * squared] > 60).all()


def test_what_is_behind_the_camera_or_nowhere_is_a_hole() -> None:
    colours = [[255, 0, 0]] * 3
    behind = _mesh([[-5.0, -5.0, -20.0], [5.0, -5.0, -20.0], [0.0, 5.0, -20.0]], [[0, 1, 2]], colours)
    across = _mesh([[-5.0, -5.0, -20.0], [5.0, -5.0, 20.0], [0.0, 5.0, 20.0]], [[0, 1, 2]], colours)
    empty = trimesh.Trimesh()
    for mesh in (behind, across, empty):
        seen = render_mesh(mesh, CAMERA, np.eye(4))
        assert np.isnan(seen.depth_mm).all()
        assert not seen.rgb.any()


def test_points_colour_the_pixels_that_their_squares_touch() -> None:
    z = 20.0
    pixels = np.array([[10.0, 12.0], [30.5, 20.0], [50.0, 40.25]])
    points = CAMERA.unproject(pixels) * z
    colours = np.array([[200, 0, 0], [0, 200, 0], [0, 0, 200]], np.uint8)
    T_world_camera = se3(so3_exp(np.array([0.3, -0.2, 0.1])), np.array([4.0, 5.0, 6.0]))
    world = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    seen = render_points(world, colours, CAMERA, T_world_camera)
    covered = {(12, 10), (20, 30), (20, 31), (40, 50), (41, 50)}
    # Rounding of the pose may touch a neighbour with an area of nothing.
    assert covered <= set(map(tuple, np.argwhere(np.isfinite(seen.depth_mm)).tolist()))
    for (row, column), colour in zip([(12, 10), (20, 31), (41, 50)], colours, strict=True):
        np.testing.assert_array_equal(seen.rgb[row, column], colour)
        assert seen.depth_mm[row, column] == pytest.approx(z)
    assert np.isnan(seen.depth_mm[30, 30])


def test_of_points_in_a_pixel_the_near_ones_are_seen_and_mixed() -> None:
    rays = CAMERA.unproject(np.array([[20.0, 20.0]] * 4))
    points = rays * np.array([[30.0], [30.3], [40.0], [-30.0]])
    colours = np.array([[100, 100, 100], [110, 110, 110], [255, 0, 0], [0, 255, 0]], np.uint8)
    seen = render_points(points, colours, CAMERA, np.eye(4))
    assert seen.rgb[20, 20].tolist() == [105, 105, 105]
    assert seen.depth_mm[20, 20] == pytest.approx(2 / (1 / 30 + 1 / 30.3), rel=1e-6)
    nothing = render_points(points[3:], colours[3:], CAMERA, np.eye(4))
    assert np.isnan(nothing.depth_mm).all()
    assert not nothing.rgb.any()
