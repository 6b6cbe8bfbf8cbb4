"""Fusion against closed forms (sphere, plane), against a brute-force field and against one dense marching cubes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chosen_settings import chosen
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import FusionSettings
from scopemap.config.mapping import FusionAdvanced
from scopemap.frame import Frame
from scopemap.fusion.tsdf import _sample, _whole_cells
from scopemap.fusion.volume import TsdfVolume
from scopemap.geometry.se3 import inverse, se3, so3_exp, transform

WIDE = PinholeCamera(46.0, 47.0, 59.3, 60.2, 120, 121)
VIEW = PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120)
LENIENT = FusionSettings(voxel_mm=1.0, truncation_mm=5.0, max_depth_mm=150.0, advanced=FusionAdvanced(min_weight=0.2))
GREY = (120, 110, 100)


def _lenient(**advanced: float) -> FusionSettings:
    return chosen(LENIENT, **advanced)


def rays_of(camera: PinholeCamera, T: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return camera.unproject(np.stack([u, v], -1)) @ T[:3, :3].T


def frame_of(camera: PinholeCamera, T: np.ndarray, depth_mm: np.ndarray, rgb: np.ndarray | tuple = GREY) -> Frame:
    picture = np.broadcast_to(np.asarray(rgb, np.uint8), (*depth_mm.shape, 3))
    return Frame(0, 0.0, picture, camera, np.ones(depth_mm.shape, bool), depth_mm.astype(np.float32), T)


def sphere_frame(T: np.ndarray, radius_mm: float, centre_mm: np.ndarray | None = None, rgb: tuple = GREY) -> Frame:
    """See a sphere from inside: the far root of the ray's quadratic."""
    rays, origin = rays_of(WIDE, T), T[:3, 3] - (np.zeros(3) if centre_mm is None else centre_mm)
    a, b, c = (rays**2).sum(-1), rays @ origin, origin @ origin - radius_mm**2
    return frame_of(WIDE, T, (np.sqrt(b * b - a * c) - b) / a, rgb)


def plane_frame(normal: np.ndarray, offset_mm: float, T: np.ndarray | None = None, rgb: tuple = GREY) -> Frame:
    """See the plane normal . X = offset."""
    T = np.eye(4) if T is None else T
    depth = (offset_mm - T[:3, 3] @ normal) / (rays_of(VIEW, T) @ normal)
    return frame_of(VIEW, T, np.where(depth > 0, depth, np.nan), rgb)


def all_around(centre_mm: np.ndarray | None = None, off_mm: float = 4.0) -> list[np.ndarray]:
    """Twelve poses near the centre: the six directions of the cube, twice, from different places."""
    rng = np.random.default_rng(5)
    turns = [(0, k * np.pi / 2, 0) for k in range(4)] + [(np.pi / 2, 0, 0), (-np.pi / 2, 0, 0)]
    centre = np.zeros(3) if centre_mm is None else centre_mm
    return [
        se3(so3_exp(np.array(turn) + rng.normal(0, 0.05, 3)), centre + rng.uniform(-off_mm, off_mm, 3))
        for turn in turns * 2
    ]


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


def test_welded_chunks_equal_one_dense_marching_cubes(sphere: TsdfVolume) -> None:
    # The sphere crosses chunk borders at 0 in all three axes; 8 blocks from -4 on hold it whole.
    dense = sphere._blocks.dense(np.full(3, -4), 8)
    known = dense.weight >= LENIENT.advanced.min_weight
    corners = np.stack([known[i : 63 + i, j : 63 + j, k : 63 + k] for i, j, k in np.ndindex(2, 2, 2)])
    mask = np.zeros(known.shape, bool)
    mask[1:, 1:, 1:] = corners.all(axis=0)
    vertices, faces, _, _ = marching_cubes(dense.tsdf, 0.0, mask=mask)
    mesh = sphere.extract_mesh()
    assert (len(mesh.vertices), len(mesh.faces)) == (len(vertices), len(faces))
    distance, _ = cKDTree(vertices - 32.0).query(mesh.vertices)
    # Vertices within a thousandth of a grid corner are moved off it.
    assert distance.max() < 3e-3
    assert np.median(distance) < 1e-5


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


def test_weight_follows_its_formula() -> None:
    volume = TsdfVolume(LENIENT)
    volume.integrate(plane_frame(np.array([0.0, 0.0, 1.0]), 48.0))
    on_axis = volume._blocks.dense(np.array([0, 0, 6]), 1)
    assert on_axis.weight[0, 0, 0] == pytest.approx(1 / (1 + (2 * 48 / LENIENT.max_depth_mm) ** 2), rel=1e-3)
    assert on_axis.tsdf[0, 0, 0] == pytest.approx(0.0, abs=1e-4)
    # The band ends one truncation behind the surface, and its last voxels hardly count.
    assert 0 < on_axis.weight[0, 0, 4] < 0.3 * on_axis.weight[0, 0, 0]
    assert (on_axis.weight[0, 0, 5:] == 0).all()


def test_min_weight_needs_a_second_look() -> None:
    volume = TsdfVolume(FusionSettings(voxel_mm=1.0, advanced=FusionAdvanced(min_weight=1.0)))
    frame = plane_frame(np.array([0.0, 0.0, 1.0]), 40.0)
    volume.integrate(frame)
    assert len(volume.extract_mesh().faces) == 0
    volume.integrate(frame)
    assert len(volume.extract_mesh().faces) > 200


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


def test_depth_is_not_interpolated_across_an_edge() -> None:
    smooth = np.float32([[1.0, 1.1], [1.2, 1.3]]) / 50
    edge, hole = smooth.copy(), smooth.copy()
    edge[:, 1], hole[1, 1] = 1 / 80, np.nan

    def sample(inverse_depth: np.ndarray, u: float, v: float) -> float:
        return _sample(inverse_depth, _whole_cells(inverse_depth, 0.2), u, v)

    assert sample(smooth, 0.25, 0.5) == pytest.approx((1 + 0.025 + 0.1) / 50, rel=1e-6)
    assert sample(smooth, -0.4, 0.0) == pytest.approx((1 - 0.04) / 50, rel=1e-6)
    assert sample(edge, 0.25, 0.6) == edge[1, 0]
    assert sample(edge, 0.75, 0.4) == edge[0, 1]
    assert sample(hole, 0.6, 0.2) == hole[0, 1]


def test_far_from_the_origin_nothing_changes(sphere: TsdfVolume) -> None:
    # 10 m away and in negative coordinates, by whole voxels: the same mesh, moved.
    centre = np.array([-9999.0, 4321.0, -777.0])
    moved, mesh = sphere_volume(25.0, centre).extract_mesh(), sphere.extract_mesh()
    assert len(moved.vertices) == pytest.approx(len(mesh.vertices), rel=0.001)
    assert cKDTree(mesh.vertices).query(moved.vertices - centre)[0].max() < 0.01
    assert moved.is_watertight


def test_colours_come_from_the_pixels() -> None:
    T = np.eye(4)
    plane = plane_frame(np.array([0.0, 0.0, 1.0]), 40.0)
    picture = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)
    picture[:, :80], picture[:, 80:] = (200, 20, 40), (10, 90, 250)
    volume = TsdfVolume(LENIENT.model_copy(update={"colours": "raw"}))
    for _ in range(2):
        volume.integrate(frame_of(VIEW, T, plane.depth_mm, picture))
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
    wall = plane_frame(np.array([0.0, 0.0, 1.0]), 40.0)
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
    volume, frame = TsdfVolume(LENIENT), plane_frame(np.array([0.0, 0.0, 1.0]), 40.0)
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

    def fused(*, highlights: bool = True, **advanced: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Vertices, their confidence, colours, and whether they are under the highlight."""
        volume = TsdfVolume(_lenient(**advanced))
        for _ in range(5):
            volume.integrate(replace(frame, valid=valid, rgb=shown, highlights=~valid if highlights else None))
        mesh = volume.extract_mesh()
        x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
        under = (x > x_mm[0]) & (x < x_mm[1]) & (y > y_mm[0]) & (y < y_mm[1])
        colours = np.asarray(mesh.visual.vertex_colors)[:, :3]
        return np.asarray(mesh.vertices), np.asarray(mesh.vertex_attributes["confidence"]), colours, under

    vertices, confidence, colours, under = fused()
    assert under.sum() >= 1
    assert np.abs(vertices[under, 2] - 40).max() < 0.1
    assert confidence[under].max() < 0.4 * np.median(confidence[~under])
    np.testing.assert_allclose(colours[under], np.broadcast_to(np.median(colours, axis=0), (under.sum(), 3)), atol=12)
    # What is masked at the picture's border is no highlight.
    assert vertices[:, 0].min() > 40 * VIEW.rays[row, 27, 0]
    assert not fused(weighted=False)[3].any()
    # Nor is what is masked for another reason, such as an instrument.
    assert not fused(highlights=False)[3].any()
