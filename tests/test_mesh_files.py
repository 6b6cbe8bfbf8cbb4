"""Mesh files read back by trimesh: the same surface, in the unit and axes of the format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.fusion.mesh import save_mesh


@pytest.fixture
def ball() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    mesh.apply_translation([5.0, 10.0, 70.0])
    colours = np.full((len(mesh.vertices), 4), 255, np.uint8)
    colours[:, 0] = np.where(mesh.vertices[:, 1] > 10, 255, 128)
    colours[:, 1:3] = (128, 0)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)


def test_ply_holds_the_mesh_in_world_mm(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    file = tmp_path / "mesh.ply"
    assert save_mesh(ball, ply_file=file) == [file]
    assert b"format binary_little_endian" in file.read_bytes()[:80]
    read = trimesh.load(file, process=False)
    assert np.allclose(read.vertices, ball.vertices, atol=1e-4)
    assert (read.faces == ball.faces).all()
    assert (read.visual.vertex_colors == ball.visual.vertex_colors).all()


def test_glb_is_metres_y_up_with_linear_colours(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    file = tmp_path / "mesh.glb"
    assert save_mesh(ball, glb_file=file) == [file]
    (read,) = trimesh.load(file, process=False).geometry.values()
    expected = ball.vertices * [1e-3, -1e-3, -1e-3]
    assert np.allclose(read.vertices, expected, atol=1e-6)
    # A turn, no mirror: the surface is not inside out.
    assert read.volume == pytest.approx(ball.volume * 1e-9, rel=1e-3)
    upper = np.asarray(read.visual.vertex_attributes["color"])[expected[:, 1] > -0.009]
    # sRGB 128 is 0.2158 of full light.
    assert np.allclose(upper[:, :3], (55, 55, 0), atol=1)


def test_glb_is_matt_and_seen_from_both_sides(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    file = tmp_path / "mesh.glb"
    save_mesh(ball, glb_file=file)
    (read,) = trimesh.load(file, process=False).geometry.values()
    assert read.visual.material.doubleSided is True
    assert read.visual.material.metallicFactor == 0.0


def test_empty_mesh_gives_an_empty_ply_and_no_glb(tmp_path: Path) -> None:
    empty = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int), vertex_colors=np.zeros((0, 3), np.uint8))
    ply, glb = tmp_path / "mesh.ply", tmp_path / "mesh.glb"
    assert save_mesh(empty, ply, glb) == [ply]
    assert b"element vertex 0" in ply.read_bytes()
    assert not glb.exists()
