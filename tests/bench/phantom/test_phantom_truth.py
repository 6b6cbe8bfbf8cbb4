"""The phantom's truth is exact: depth, poses and mesh agree with the shape and with each other."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from scopemap.engine.geometry.se3 import inverse, transform
from scopemap_bench.phantom.march import Volume, march
from scopemap_bench.phantom.motion import REST, breathing
from scopemap_bench.phantom.render import Phantom, build_scene, camera_path, prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import seen_surface

pytestmark = pytest.mark.slow

SMALL = {"width": 96, "height": 80, "frames": 12}


@pytest.fixture(scope="module", params=["colon", "laparoscopy", "abdominal_wall", "tube"])
def phantom(request: pytest.FixtureRequest) -> Phantom:
    return prepare(PhantomSpec(scene=request.param, **SMALL))


@pytest.fixture(scope="module")
def breathing_colon() -> Phantom:
    return prepare(PhantomSpec(deform=True, breath_mm=3.0, breath_frames=10.0, **SMALL))


def distances_at(volume: Volume, points: np.ndarray) -> np.ndarray:
    """Distance (N,) in mm, to first order, of points (N, 3) near the surface: value over slope."""
    value, gradient = volume.values_at(points)
    return value / np.linalg.norm(gradient, axis=1)


def world_points(phantom: Phantom, index: int) -> np.ndarray:
    _, surface = render_frame(phantom, index)
    points = phantom.spec.camera.rays.astype(float) * surface.depth_mm[..., None]
    points = points[np.isfinite(surface.depth_mm)]
    return transform(phantom.poses[index], points)


@pytest.fixture(scope="module")
def ball() -> Volume:
    grid = np.stack(np.meshgrid(*[np.arange(-30.0, 31.0)] * 3, indexing="ij"), -1)
    return Volume((20.0 - np.linalg.norm(grid, axis=-1)).astype(np.float32), np.full(3, -30.0), 1.0)


def test_the_inside_of_a_ball_is_met_where_the_formula_says(ball: Volume) -> None:
    camera = PhantomSpec(width=64, height=48).camera
    T = np.eye(4)
    T[:3, 3] = [3.0, -4.0, 5.0]
    seen = march(ball, camera, T, REST)
    d = camera.rays.astype(float) / np.linalg.norm(camera.rays, axis=-1, keepdims=True)
    b = d @ T[:3, 3]
    # The spline smooths the cone of distances, which shifts the sphere a little: its radius is read off on one axis.
    radius = 20.0 + float(ball.values_at(np.array([[20.0, 0.0, 0.0]]))[0][0])
    expected = -b + np.sqrt(b**2 - 50.0 + radius**2)
    np.testing.assert_allclose(seen.distance_mm, expected, atol=2e-3)
    towards_centre = -(d * expected[..., None] + T[:3, 3]) / radius
    np.testing.assert_allclose(seen.normal, towards_centre, atol=2e-3)


def test_the_distance_map_never_promises_too_much(phantom: Phantom) -> None:
    volume = phantom.volume
    rng = np.random.default_rng(0)
    cells = np.argwhere(volume.skip > 1)
    cells = cells[rng.choice(len(cells), 300)]
    points = (cells + rng.uniform(0, 1, cells.shape)) * volume.voxel_mm + volume.origin_mm
    radius = (volume.skip[tuple(cells.T)] - 1.0) * volume.voxel_mm
    for _ in range(20):
        direction = rng.normal(size=points.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        value, _ = volume.values_at(points + direction * radius[:, None])
        assert (value[np.isfinite(value)] > 0).all()


def test_gradient_agrees_with_finite_differences(phantom: Phantom) -> None:
    points = world_points(phantom, 0)[::97]
    _, gradient = phantom.volume.values_at(points)
    step = 1e-4
    for axis, offset in enumerate(step * np.eye(3)):
        ahead, behind = (phantom.volume.values_at(points + s * offset)[0] for s in (1, -1))
        np.testing.assert_allclose(gradient[:, axis], (ahead - behind) / (2 * step), atol=1e-5)


def test_backprojected_depth_lies_on_the_surface(phantom: Phantom) -> None:
    for index in (0, 7):
        points = world_points(phantom, index)
        assert len(points) > 0.95 * 96 * 80
        assert np.abs(distances_at(phantom.volume, points)).max() < 1e-3


def test_nothing_lies_before_the_depth(phantom: Phantom) -> None:
    _, surface = render_frame(phantom, 3)
    eye = phantom.poses[3][:3, 3]
    points = world_points(phantom, 3)
    for share in np.linspace(0.02, 0.98, 25):
        value, _ = phantom.volume.values_at(eye + share * (points - eye))
        assert value.min() > -1e-3
    assert np.nanmin(surface.depth_mm) > 3.0


def test_frames_agree_with_each_other(phantom: Phantom) -> None:
    camera = phantom.spec.camera
    _, other = render_frame(phantom, 9)
    seen = transform(inverse(phantom.poses[9]), world_points(phantom, 2))
    pixels = camera.project(seen)
    flat = ndimage.maximum_filter(other.depth_mm, 3) - ndimage.minimum_filter(other.depth_mm, 3) < 1.0
    u, v = pixels.T
    fine = (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    expected = ndimage.map_coordinates(np.nan_to_num(other.depth_mm), [v[fine], u[fine]], order=1)
    smooth = ndimage.map_coordinates(flat.astype(float), [v[fine], u[fine]], order=1) > 0.999
    error = np.abs(expected - seen[fine, 2])[smooth]
    # Bilinear depth between pixels is off by the surface's curvature, some hundredths of a mm on small bumps.
    assert len(error) > 500
    assert np.median(error) < 0.02
    assert np.percentile(error, 95) < 0.2


def seen_mesh(phantom: Phantom, *indices: int) -> trimesh.Trimesh:
    seen = np.zeros(phantom.volume.coefficients.shape, bool)
    for index in indices:
        seen[phantom.volume.cells_of(render_frame(phantom, index)[1].rest_mm)] = True
    return seen_surface(phantom.volume, seen)


def test_mesh_lies_on_the_surface_and_faces_the_camera(phantom: Phantom) -> None:
    mesh = seen_mesh(phantom, 0, 5, 11)
    corners = mesh.vertices[mesh.faces]
    middle = np.abs(distances_at(phantom.volume, corners.mean(1)))
    assert np.abs(distances_at(phantom.volume, mesh.vertices)).max() < 1e-3
    assert middle.mean() < 0.05
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, gradient = phantom.volume.values_at(corners.mean(1))
    assert ((normals * gradient).sum(1) > 0).mean() > 0.99


def test_depth_of_moving_tissue_lies_on_moving_tissue(breathing_colon: Phantom) -> None:
    displacement = breathing_colon.motion.at(5)
    points = world_points(breathing_colon, 5)
    shift = displacement.at(points)
    assert np.linalg.norm(shift, axis=1).max() > 1.0
    assert np.abs(distances_at(breathing_colon.volume, points - shift)).max() < 1e-3
    assert np.abs(distances_at(breathing_colon.volume, points)).mean() > 0.1


def test_path_keeps_clear_of_the_wall(phantom: Phantom) -> None:
    spec = PhantomSpec(scene=phantom.spec.scene, frames=60, width=32, height=32, seed=5)
    poses = camera_path(spec)
    volume, _ = build_scene(spec, poses)
    for displacement in (REST, breathing(2.0, 10.0, 5).at(5)):
        positions = poses[:, :3, 3] - displacement.at(poses[:, :3, 3])
        assert volume.values_at(positions)[0].min() > 5.0
        for index in (0, 30, 59):
            assert np.nanmin(march(volume, spec.camera, poses[index], displacement).distance_mm) > 5.0
