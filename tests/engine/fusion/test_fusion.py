"""Fusion against closed forms (sphere, plane), against a brute-force field and against one dense marching cubes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.fusion.tsdf import BLOCK, KEY_OFFSET, Grid, TsdfCamera, touched_blocks, unpack
from scopemap.engine.geometry.se3 import se3, so3_exp
from tests.support.drawn_surfaces import AHEAD, LENIENT, VIEW, all_around, frame_of, lenient, plane_frame, sphere_frame


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


@pytest.mark.parametrize("quarters", range(4))
@pytest.mark.parametrize("which", [np.s_[:, :], np.s_[::2, ::2], np.s_[::2, 1::2], np.s_[1::2, ::2], np.s_[1::2, 1::2]])
def test_no_block_of_a_measured_pixel_is_missed(quarters: int, which: tuple[slice, slice]) -> None:
    """A wall across the camera, which looks along z and is turned about it; all pixels count, or one of four."""
    R, grid = np.rint(so3_exp(np.array([0.0, 0.0, quarters * np.pi / 2]))), Grid(1.0, 3.0, 0.05)
    depth_mm = np.full((VIEW.height, VIEW.width), np.nan, np.float32)
    depth_mm[which] = 40.0
    points = (VIEW.rays * depth_mm[..., None])[which].reshape(-1, 3)
    for shift_mm in np.arange(0.0, BLOCK, 0.5):
        t = np.array([shift_mm, shift_mm, 0.0])
        camera = TsdfCamera(R, t, VIEW.fx, VIEW.fy, VIEW.cx, VIEW.cy)
        found = np.unique(unpack(touched_blocks(1 / depth_mm, camera, grid)), axis=0)
        blocks = np.unique(np.floor((points - t) @ R / BLOCK).astype(int), axis=0)
        assert {*map(tuple, blocks)} <= {*map(tuple, found)}


def test_a_pose_may_be_as_far_away_as_keys_of_blocks_reach() -> None:
    voxel_mm, truncation_mm, max_depth_mm = 1.0, 5.0, 150.0
    farthest_mm = (KEY_OFFSET - 1) * BLOCK * voxel_mm - 4 * max_depth_mm - truncation_mm
    frame = plane_frame(AHEAD, 50.0)
    for side in (-1.0, 1.0):
        volume = TsdfVolume(LENIENT)
        volume.integrate(replace(frame, T_world_camera=se3(np.eye(3), np.array([side * farthest_mm, 0.0, 0.0]))))
        np.testing.assert_allclose(volume.extract_mesh().vertices[:, 2], 50.0, atol=0.01)
    with pytest.raises(ValueError, match="mm from the origin"):
        volume.integrate(replace(frame, T_world_camera=se3(np.eye(3), np.array([0.0, farthest_mm + 1.0, 0.0]))))


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


def test_colours_come_from_the_pixels() -> None:
    plane = plane_frame(AHEAD, 40.0)
    picture = np.zeros((VIEW.height, VIEW.width, 3), np.uint8)
    picture[:, :80], picture[:, 80:] = (200, 20, 40), (10, 90, 250)
    volume = TsdfVolume(lenient(colours="raw"))
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
    volume = TsdfVolume(lenient(min_component_share=0.2))
    volume.integrate(frame_of(VIEW, np.eye(4), depth))
    assert np.allclose(volume.extract_mesh().vertices[:, 2], 40.0, atol=0.01)
    volume.settings = lenient(min_component_share=0.0)
    assert (volume.extract_mesh().vertices[:, 2] > 50).any()
    volume.settings = lenient(min_component_share=1.0)
    assert len(volume.extract_mesh().faces) > 100


def test_pixels_that_must_not_count_do_not() -> None:
    wall = plane_frame(AHEAD, 40.0)
    normal = so3_exp(np.array([1.5, 0.0, 0.0]))[:, 2]
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
    cosine = VIEW.rays @ normal / np.linalg.norm(VIEW.rays, axis=-1)
    grazing = replace(plane_frame(normal, 5.0), valid=(cosine > 0.06) & (cosine < 0.09))
    for weighted in (True, False):
        volume = TsdfVolume(lenient(method="scopemap" if weighted else "unweighted"))
        volume.integrate(grazing)
        assert (volume.block_count == 0) == weighted


def test_a_highlight_that_stays_in_place_is_fused_in_the_colour_around_it() -> None:
    frame = frame_of(VIEW, np.eye(4), np.full((VIEW.height, VIEW.width), 40.0))
    valid, shown = frame.valid.copy(), frame.rgb.copy()
    row, col = VIEW.height // 2, VIEW.width // 2
    valid[row - 5 : row + 5, col - 5 : col + 5] = False
    shown[row - 5 : row + 5, col - 5 : col + 5] = 255
    valid[:, :30] = False
    x_mm, y_mm = (40 * VIEW.rays[[row - 3, row + 3], [col - 3, col + 3], axis] for axis in (0, 1))

    def fused(*, highlights: bool = True, **advanced: str) -> tuple[trimesh.Trimesh, np.ndarray]:
        """The mesh, and which vertices are under the highlight."""
        volume = TsdfVolume(lenient(**advanced))
        for _ in range(5):
            volume.integrate(replace(frame, valid=valid, rgb=shown, highlights=~valid if highlights else None))
        mesh = volume.extract_mesh()
        x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
        return mesh, (x > x_mm[0]) & (x < x_mm[1]) & (y > y_mm[0]) & (y < y_mm[1])

    mesh, under = fused()
    assert under.sum() >= 1
    assert np.abs(mesh.vertices[under, 2] - 40).max() < 0.1
    confidence, colours = mesh.vertex_attributes["confidence"], np.asarray(mesh.visual.vertex_colors, float)
    assert confidence[under].min() > 0.9 * np.median(confidence[~under])
    assert np.abs(colours[under] - np.median(colours, axis=0)).max() < 12
    # What is masked at the picture's border is no highlight, nor what is masked for another reason.
    assert mesh.vertices[:, 0].min() > 40 * VIEW.rays[row, 27, 0]
    assert not fused(method="unweighted")[1].any()
    assert not fused(highlights=False)[1].any()
