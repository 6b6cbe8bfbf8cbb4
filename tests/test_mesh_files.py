"""Mesh files read back by trimesh: the same surface, in the unit and axes of the format."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.fusion.mesh_files import save_mesh


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
    assert np.allclose(upper[:, :3] / 65535, (0.2158, 0.2158, 0), atol=1e-3)


def _glb_tree(file: Path) -> tuple[dict, bytes]:
    content = file.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def test_dark_shades_survive_the_glb(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    levels = np.arange(256)[np.arange(len(ball.vertices)) % 256].astype(np.uint8)
    ball.visual.vertex_colors = np.repeat(levels[:, None], 3, axis=1)
    save_mesh(ball, glb_file=tmp_path / "mesh.glb")
    tree, buffer = _glb_tree(tmp_path / "mesh.glb")
    (primitive,) = tree["meshes"][0]["primitives"]
    assert sorted(primitive["attributes"]) == ["COLOR_0", "NORMAL", "POSITION"]
    accessor = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    # 5123: 16 bits without sign; normalized: 65535 is full light.
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    start = tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
    linear = np.frombuffer(buffer, np.uint16, 4 * accessor["count"], start).reshape(-1, 4) / 65535
    assert (linear[:, 3] == 1).all()
    back = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert (np.round(255 * back[:, 0]) == levels).all()


def test_both_files_have_normals_that_point_outwards(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    ply, glb = tmp_path / "mesh.ply", tmp_path / "mesh.glb"
    save_mesh(ball, ply, glb)
    assert b"property float nx" in ply.read_bytes()[:600]
    outwards = (ball.vertices - [5.0, 10.0, 70.0]) / 20.0
    read = trimesh.load(ply, process=False)
    assert "vertex_normals" in read._cache
    np.testing.assert_allclose(read.vertex_normals, outwards, atol=0.01)
    (read,) = trimesh.load(glb, process=False).geometry.values()
    assert "vertex_normals" in read._cache
    np.testing.assert_allclose(read.vertex_normals, outwards * [1, -1, -1], atol=0.01)


def test_ply_holds_the_confidence(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    confidence = np.linspace(0, 1, len(ball.vertices), dtype=np.float32)
    ball.vertex_attributes["confidence"] = confidence
    save_mesh(ball, tmp_path / "mesh.ply", tmp_path / "mesh.glb")
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    # trimesh keeps properties that it has no use for here.
    assert (read.metadata["_ply_raw"]["vertex"]["data"]["confidence"] == confidence).all()


def test_empty_mesh_gives_an_empty_ply_and_no_glb(tmp_path: Path) -> None:
    empty = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int), vertex_colors=np.zeros((0, 3), np.uint8))
    ply, glb = tmp_path / "mesh.ply", tmp_path / "mesh.glb"
    assert save_mesh(empty, ply, glb) == [ply]
    assert b"element vertex 0" in ply.read_bytes()
    assert not glb.exists()
