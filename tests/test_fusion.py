"""Fusion against closed forms (sphere, plane), against a brute-force field and against one dense marching cubes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from chosen_settings import chosen
from drawn_surfaces import AHEAD, LENIENT, VIEW, all_around, frame_of, plane_frame, sphere_frame
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from scopemap.config import FusionSettings
from scopemap.frame import Frame
from scopemap.fusion.surface_fusion import TsdfVolume
from scopemap.geometry.se3 import inverse, se3, so3_exp, transform


def _lenient(**advanced: float) -> FusionSettings:
    return chosen(LENIENT, **advanced)


def sphere_volume(radius_mm: float, centre_mm: np.ndarray | None = None) -> TsdfVolume:
    volume = TsdfVolume(LENIENT)
    for T in all_around(centre_mm):
        volume.integrate(sphere_frame(T, radius_mm, centre_mm))
    return volume


@pytest.fixture(scope="module")
def sphere() -> TsdfVolume:
    return sphere_volume(25.0)


def test_sphere_from_inside_is_accurate_closed_and_faces_the_cameras(sphere: TsdfVolume) -> None:
    mesh = sphere.extract_mesh()
    error_mm = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 25.0)
    assert error_mm.mean() < 0.01
    assert error_mm.max() < 0.15
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert (np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center) < 0).mean() > 0.999
    assert abs(mesh.volume) == pytest.approx(4 / 3 * np.pi * 25**3, rel=5e-3)


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(20, 80))
def test_slanted_plane_is_exact_and_ends_with_the_view(tilt_x: float, tilt_y: float, distance_mm: float) -> None:
    normal = so3_exp(np.array([tilt_x, tilt_y, 0.0]))[:, 2]
    volume, frame = TsdfVolume(LENIENT), plane_frame(normal, distance_mm * normal[2])
    for _ in range(3):
        volume.integrate(frame)
    mesh = volume.extract_mesh()
    assert len(mesh.faces) > 200
    error_mm = np.abs(mesh.vertices @ normal - distance_mm * normal[2])
    assert error_mm.max() < 0.01
    pixels = VIEW.project(mesh.vertices)
    # One voxel beyond the border pixel at most: nothing closes the frustum.
    slack_px = VIEW.fx * LENIENT.voxel_mm / mesh.vertices[:, 2].min() + 1
    assert pixels.min() > -slack_px
    assert (pixels.max(axis=0) < np.array([VIEW.width, VIEW.height]) + slack_px).all()
    assert not mesh.is_watertight
    assert (mesh.face_normals @ normal < 0).all()


def brute_force_field(frames: list[Frame], points: np.ndarray, given: FusionSettings) -> tuple[np.ndarray, np.ndarray]:
    """The field at `points` (N, 3) by plain array operations: one smooth surface, no depth edges."""
    total, weights = np.zeros(len(points)), np.zeros(len(points))
    for frame in frames:
        camera, depth = frame.camera, frame.depth_mm.astype(np.float64)
        local = transform(inverse(frame.T_world_camera), points)
        u, v = camera.project(local).T
        inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1) & (local[:, 2] > 0)
        surface = camera.unproject(np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1))
        surface *= depth[..., None]
        tangent_u, tangent_v = np.gradient(surface, axis=1), np.gradient(surface, axis=0)
        normals = np.cross(tangent_u, tangent_v)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        col, row = np.round(u[inside]).astype(int), np.round(v[inside]).astype(int)
        n, z = normals[row, col], local[inside, 2]
        seen = 1 / map_coordinates(1 / depth, [v[inside], u[inside]], order=1)
        hit = local[inside] * (seen / z)[:, None]
        distance = np.clip(np.einsum("ij,ij->i", n, hit - local[inside]), -given.truncation_mm, given.truncation_mm)
        far = np.linalg.norm(surface[row, col], axis=1)
        weight = np.einsum("ij,ij->i", n, surface[row, col]) / far / (1 + (2 * far / given.max_depth_mm) ** 2)
        weight *= np.clip((given.truncation_mm + seen - z) / (0.8 * given.truncation_mm), 0, 1)
        total[inside] += weight * distance
        weights[inside] += weight
    return total / np.maximum(weights, 1e-9), weights


def test_field_agrees_with_brute_force() -> None:
    poses = [se3(so3_exp(np.array([0.1 * k, -0.2 * k, 0.3])), np.array([k, -k, 2.0 * k])) for k in range(3)]
    frames = [sphere_frame(T, 25.0) for T in poses]
    volume = TsdfVolume(LENIENT)
    for frame in frames:
        volume.integrate(frame)
    voxels = volume._blocks.dense(np.array([-1, -1, 2]), 2)
    i, j, k = np.meshgrid(*[np.arange(16)] * 3, indexing="ij")
    points = np.stack([i - 8, j - 8, k + 16], -1).reshape(-1, 3).astype(np.float64)
    field, weight = brute_force_field(frames, points, LENIENT)
    # Farther in front, blocks are made only where a ray passes within the truncation.
    known = (weight > 0.5) & (np.abs(field) < 2.5)
    assert known.sum() > 1000
    assert np.abs(voxels.weight.ravel() - weight)[known].max() < 0.02
    assert np.abs(voxels.tsdf.ravel() - field)[known].max() < 0.03


def test_no_wall_grows_behind_a_silhouette() -> None:
    depth = np.full((VIEW.height, VIEW.width), 60.0)
    depth[:, :80] = 40.0
    volume = TsdfVolume(LENIENT)
    for shift_mm in (0.0, 0.3, 0.6):
        volume.integrate(frame_of(VIEW, se3(np.eye(3), np.array([0.0, shift_mm, 0.0])), depth))
    z = volume.extract_mesh().vertices[:, 2]
    assert np.minimum(np.abs(z - 40), np.abs(z - 60)).max() < 0.3
    assert (np.abs(z - 40) < 0.3).sum() > 300
    assert (np.abs(z - 60) < 0.3).sum() > 300


def test_far_from_the_origin_nothing_changes(sphere: TsdfVolume) -> None:
    # 10 m away and in negative coordinates, by whole voxels: the same mesh, moved.
    centre = np.array([-9999.0, 4321.0, -777.0])
    moved, mesh = sphere_volume(25.0, centre).extract_mesh(), sphere.extract_mesh()
    assert len(moved.vertices) == pytest.approx(len(mesh.vertices), rel=0.001)
    assert cKDTree(mesh.vertices).query(moved.vertices - centre)[0].max() < 0.01
    assert moved.is_watertight


def test_colours_come_from_the_pixels() -> None:
    plane = plane_frame(AHEAD, 40.0)
    picture = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)
    picture[:, :80], picture[:, 80:] = (200, 20, 40), (10, 90, 250)
    volume = TsdfVolume(LENIENT.model_copy(update={"colours": "raw"}))
    for _ in range(2):
        volume.integrate(replace(plane, rgb=picture))
    mesh = volume.extract_mesh()
    colours, x = np.asarray(mesh.visual.vertex_colors), mesh.vertices[:, 0]
    assert (colours[x < -1] == (200, 20, 40, 255)).all()
    assert (colours[x > 1] == (10, 90, 250, 255)).all()


def test_floaters_go_and_the_largest_part_stays() -> None:
    depth = np.full((VIEW.height, VIEW.width), np.nan)
    depth[:, :100] = 40.0
    depth[50:70, 120:140] = 60.0
    volume = TsdfVolume(_lenient(min_component_share=0.2))
    volume.integrate(frame_of(VIEW, np.eye(4), depth))
    assert np.allclose(volume.extract_mesh().vertices[:, 2], 40.0, atol=0.01)
    volume.settings = _lenient(min_component_share=0.0)
    assert (volume.extract_mesh().vertices[:, 2] > 50).any()
    volume.settings = _lenient(min_component_share=1.0)
    assert len(volume.extract_mesh().faces) > 100


def test_pixels_that_must_not_count_do_not() -> None:
    wall = plane_frame(AHEAD, 40.0)
    grazing = plane_frame(so3_exp(np.array([1.5, 0.0, 0.0]))[:, 2], 5.0)
    unusable = [
        replace(wall, depth_mm=np.full_like(wall.depth_mm, np.nan)),
        replace(wall, depth_mm=np.full_like(wall.depth_mm, np.inf)),
        replace(wall, depth_mm=-wall.depth_mm),
        replace(wall, depth_mm=wall.depth_mm * 10),
        replace(wall, valid=np.zeros_like(wall.valid)),
    ]
    volume = TsdfVolume(LENIENT)
    for frame in unusable:
        volume.integrate(frame)
    assert volume.block_count == 0
    assert volume.extract_mesh().vertices.shape == (0, 3)
    strict = TsdfVolume(_lenient(min_incidence=0.5))
    strict.integrate(grazing)
    assert strict.block_count == 0


def test_frames_without_depth_or_pose_are_refused() -> None:
    volume, frame = TsdfVolume(LENIENT), plane_frame(AHEAD, 40.0)
    with pytest.raises(ValueError, match="no depth_mm"):
        volume.integrate(replace(frame, depth_mm=None))
    with pytest.raises(ValueError, match="no T_world_camera"):
        volume.integrate(replace(frame, T_world_camera=None))
    for bad in (np.nan, np.inf, 1e9):
        with pytest.raises(ValueError, match="pose"):
            volume.integrate(replace(frame, T_world_camera=se3(np.eye(3), np.array([0.0, bad, 0.0]))))


def test_a_highlight_that_stays_in_place_is_fused_with_little_weight() -> None:
    frame = frame_of(VIEW, np.eye(4), np.full((VIEW.height, VIEW.width), 40.0))
    valid, shown = frame.valid.copy(), frame.rgb.copy()
    row, col = VIEW.height // 2, VIEW.width // 2
    valid[row - 5 : row + 5, col - 5 : col + 5] = False
    shown[row - 5 : row + 5, col - 5 : col + 5] = 255
    valid[:, :30] = False
    x_mm, y_mm = (40 * VIEW.rays[[row - 3, row + 3], [col - 3, col + 3], axis] for axis in (0, 1))

    def fused(*, highlights: bool = True, **advanced: float) -> tuple[trimesh.Trimesh, np.ndarray]:
        """The mesh, and which vertices are under the highlight."""
        volume = TsdfVolume(_lenient(**advanced))
        for _ in range(5):
            volume.integrate(replace(frame, valid=valid, rgb=shown, highlights=~valid if highlights else None))
        mesh = volume.extract_mesh()
        x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
        return mesh, (x > x_mm[0]) & (x < x_mm[1]) & (y > y_mm[0]) & (y < y_mm[1])

    mesh, under = fused()
    assert under.sum() >= 1
    assert np.abs(mesh.vertices[under, 2] - 40).max() < 0.1
    confidence, colours = mesh.vertex_attributes["confidence"], np.asarray(mesh.visual.vertex_colors, float)
    assert confidence[under].max() < 0.4 * np.median(confidence[~under])
    assert np.abs(colours[under] - np.median(colours, axis=0)).max() < 12
    # What is masked at the picture's border is no highlight, nor what is masked for another reason.
    assert mesh.vertices[:, 0].min() > 40 * VIEW.rays[row, 27, 0]
    assert not fused(weighted=False)[1].any()
    assert not fused(highlights=False)[1].any()
