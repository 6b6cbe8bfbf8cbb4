"""What a camera sees: walls and folds in closed form, brute-force lines of sight, a phantom's own shape as referee."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.se3 import inverse, se3, so3_exp, transform
from scopemap_bench.evaluation.true_surface import pixels_near, seen_points, visible_from
from scopemap_bench.phantom.render import prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import seen_surface
from tests.support.tiny_phantom import SIZE

EYE = PinholeCamera(80.0, 80.0, 79.5, 63.5, 160, 128)
HERE = np.eye(4)


def plate(z_mm: float, x_mm: tuple[float, float], y_mm: tuple[float, float] = (-30.0, 30.0)) -> trimesh.Trimesh:
    corners = [[x, y, z_mm] for x in x_mm for y in y_mm]
    return trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]], process=False)


def grid_at(z_mm: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-39.5, 40), np.arange(-29.5, 30))
    return np.stack([x, y, np.full_like(x, z_mm)], -1).reshape(-1, 3)


def depth_behind_a_curtain() -> np.ndarray:
    """A wall at 50 mm, and a curtain at 25 mm before the left half of the picture."""
    return np.where(EYE.rays[..., 0] < 0, 25.0, 50.0).astype(np.float32)


def blocked(points: np.ndarray, eye: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Whether a triangle cuts the line of sight to each point: Moeller and Trumbore, every line with every triangle."""
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    hit = []
    for point in points:
        ray = point - eye
        p = np.cross(ray, c - a)
        determinant = np.sum((b - a) * p, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.sum((eye - a) * p, axis=1) / determinant
            q = np.cross(eye - a, b - a)
            v = (q @ ray) / determinant
            t = np.sum((c - a) * q, axis=1) / determinant
            hit.append(bool(np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-6))))
    return np.array(hit)


def test_what_hides_behind_a_curtain_is_not_seen() -> None:
    wall = grid_at(50.0)
    seen = seen_points(wall, EYE, (HERE, depth_behind_a_curtain()))
    np.testing.assert_array_equal(seen, wall[:, 0] > 0)


def test_the_tolerance_is_a_share_of_the_depth() -> None:
    depth = np.full((128, 160), 50.0, np.float32)
    points = np.array([[0, 0, z] for z in (48.9, 49.1, 50.9, 51.1)])
    assert seen_points(points, EYE, (HERE, depth)).tolist() == [False, True, True, False]


def test_a_phantom_is_seen_where_no_tissue_cuts_the_line_of_sight() -> None:
    spec = PhantomSpec(frames=40, width=SIZE[0], height=SIZE[1], seed=3)
    phantom = prepare(spec)
    volume = phantom.volume
    whole = seen_surface(volume, np.ones(volume.coefficients.shape, bool))
    points = whole.vertices[np.random.default_rng(0).permutation(len(whole.vertices))[:600]]

    def in_sight(T_world_camera: np.ndarray) -> np.ndarray:
        local = transform(inverse(T_world_camera), points)
        column, row = np.nan_to_num(spec.camera.project(local), nan=-9).T
        free = (column > -0.5) & (column < SIZE[0] - 0.5) & (row > -0.5) & (row < SIZE[1] - 0.5)
        # Tissue is where the shape is negative; the last 0.6 mm before the point itself do not count.
        for share in np.linspace(0, 1, 500)[1:]:
            there = points + share * (T_world_camera[:3, 3] - points)
            free &= (np.linalg.norm(there - points, axis=1) < 0.6) | (volume.values_at(there)[0] > 0)
        return free

    views = [(phantom.poses[k], render_frame(phantom, k)[1].depth_mm) for k in (0, 39)]
    expected = in_sight(views[0][0]) | in_sight(views[1][0])
    seen = seen_points(points, spec.camera, views[0]) | seen_points(points, spec.camera, views[1])
    assert 0.3 < expected.mean() < 0.7
    assert np.mean(seen[expected]) > 0.95
    assert np.mean(expected[seen]) > 0.95
    # Far more lies inside the image than is in sight: the folds do hide.
    anywhere = [np.isfinite(spec.camera.project(transform(inverse(T), points))).all(1) for T, _ in views]
    assert np.mean(anywhere[0] | anywhere[1]) > 1.3 * seen.mean()


def test_of_a_sphere_the_near_cap_is_visible() -> None:
    radius_mm, away_mm = 10.0, 40.0
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=radius_mm).apply_translation([0, 0, away_mm])
    cap = visible_from(sphere, EYE, HERE)
    assert isinstance(cap, trimesh.Trimesh)
    assert cap.area == pytest.approx(2 * np.pi * radius_mm**2 * (1 - radius_mm / away_mm), rel=0.05)
    horizon_mm = away_mm - radius_mm**2 / away_mm
    assert cap.vertices[:, 2].max() < horizon_mm + 1.0


def test_a_mesh_hides_what_lies_behind_it_and_points_hide_nothing() -> None:
    scene = trimesh.util.concatenate([plate(50.0, (-30, 30)), plate(25.0, (-15, 0))])
    visible = visible_from(scene, EYE, HERE)
    assert isinstance(visible, trimesh.Trimesh)
    on_wall = visible.triangles_center[visible.triangles_center[:, 2] > 40]
    hidden = (on_wall[:, 0] < -1) & (np.abs(on_wall[:, 1]) < 29) & (on_wall[:, 0] > -29)
    assert not hidden.any()
    assert on_wall[:, 0].max() > 28
    points = np.array([[-10, 0, 25.0], [-20, 0, 50.0], [20, 0, 50.0], [0, 0, -50.0], [90, 0, 50.0]])
    np.testing.assert_array_equal(visible_from(points, EYE, HERE), points[:3])


def test_only_what_falls_on_valid_pixels_is_kept() -> None:
    wall = plate(50.0, (-30, 30))
    left = np.arange(160)[None] < 79.5
    valid = np.broadcast_to(left, (128, 160)).copy()
    kept = visible_from(wall, EYE, HERE, valid)
    assert isinstance(kept, trimesh.Trimesh)
    assert kept.triangles_center[:, 0].max() < 0
    assert kept.area == pytest.approx(30 * 60, rel=0.05)
    assert len(visible_from(wall, EYE, HERE, np.zeros((128, 160), bool)).faces) == 0
    assert len(visible_from(trimesh.Trimesh(), EYE, HERE).faces) == 0


@pytest.mark.parametrize("tilt_rad", [0.0, 0.9, 1.35])
def test_hills_are_visible_where_no_triangle_cuts_the_line_of_sight(tilt_rad: float) -> None:
    u, v = np.meshgrid(0.7 * np.arange(36) - 12.5, 0.7 * np.arange(36) - 12.5, indexing="ij")
    a = np.arange(36 * 36).reshape(36, 36)
    faces = [[a[:-1, :-1], a[1:, :-1], a[:-1, 1:]], [a[1:, :-1], a[1:, 1:], a[:-1, 1:]]]
    hills = np.stack([u, v, 3 * np.sin(0.6 * u) * np.cos(0.4 * v)], -1).reshape(-1, 3)
    mesh = trimesh.Trimesh(hills, np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in faces]), process=False)
    mesh.apply_transform(se3(so3_exp(np.array([tilt_rad, 0.2, 0.0])), np.array([0.0, 0.0, 45.0])))
    visible = visible_from(mesh, EYE, HERE)
    assert isinstance(visible, trimesh.Trimesh)
    chosen = np.random.default_rng(0).permutation(len(mesh.faces))[:300]
    centres = mesh.triangles_center[chosen]
    kept = {tuple(np.round(centre, 6)) for centre in visible.triangles_center}
    found = np.array([tuple(np.round(centre, 6)) in kept for centre in centres])
    expected = ~blocked(centres, np.zeros(3), mesh)
    assert np.mean(found == expected) > 0.95
    assert tilt_rad == 0 or expected.mean() < 0.9


def test_pixels_near_points_are_discs() -> None:
    near = pixels_near(np.array([[0.25, 0.25, 40.0], [0, 0, -40.0], [500, 0, 40.0]]), EYE, HERE, radius_px=3)
    row, column = np.nonzero(near)
    assert near[64, 80]
    assert np.hypot(row - 64, column - 80).max() == 3
    assert near.sum() == 29
    assert not pixels_near(np.array([[0.0, 0, -1]]), EYE, HERE, radius_px=3).any()
