"""Mesh files read back by trimesh: the same surface, in the unit and axes of the format."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.engine.fusion.mesh_files import save_mesh, save_meshes_in_time
from scopemap.engine.fusion.open_glb import OpenGlb


@pytest.fixture
def ball() -> trimesh.Trimesh:
    """A ball with every grey level, and a confidence."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=20.0)
    mesh.apply_translation([5.0, 10.0, 70.0])
    mesh.visual.vertex_colors = np.repeat(np.arange(len(mesh.vertices), dtype=np.uint8)[:, None], 3, axis=1)
    mesh.vertex_attributes["confidence"] = np.linspace(0, 1, len(mesh.vertices), dtype=np.float32)
    return mesh


def test_ply_holds_the_mesh_in_world_mm_with_normals_and_confidence(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    file = tmp_path / "mesh.ply"
    save_mesh(ball, ply_file=file)
    assert b"format binary_little_endian" in file.read_bytes()[:80]
    read = trimesh.load(file, process=False)
    assert np.allclose(read.vertices, ball.vertices, atol=1e-4)
    assert (read.faces == ball.faces).all()
    assert (read.visual.vertex_colors == ball.visual.vertex_colors).all()
    assert "vertex_normals" in read._cache
    np.testing.assert_allclose(read.vertex_normals, (ball.vertices - [5.0, 10.0, 70.0]) / 20.0, atol=0.01)
    # trimesh keeps properties that it has no use for here.
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    assert (data["confidence"] == ball.vertex_attributes["confidence"]).all()


def test_glb_is_metres_y_up_with_linear_colours_of_16_bits(tmp_path: Path, ball: trimesh.Trimesh) -> None:
    file = tmp_path / "mesh.glb"
    save_mesh(ball, glb_file=file)
    (read,) = trimesh.load(file, process=False).geometry.values()
    assert np.allclose(read.vertices, ball.vertices * [1e-3, -1e-3, -1e-3], atol=1e-6)
    # A turn, no mirror: the surface is not inside out.
    assert read.volume == pytest.approx(ball.volume * 1e-9, rel=1e-3)
    assert "vertex_normals" in read._cache
    outwards = (ball.vertices - [5.0, 10.0, 70.0]) / 20.0
    np.testing.assert_allclose(read.vertex_normals, outwards * [1, -1, -1], atol=0.01)
    content = file.read_bytes()
    (length,) = struct.unpack("<I", content[12:16])
    tree, buffer = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = tree["meshes"][0]["primitives"]
    accessor = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    # 5123: 16 bits without sign; normalized: 65535 is full light.
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    start = tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0)
    linear = np.frombuffer(buffer, np.uint16, 4 * accessor["count"], start).reshape(-1, 4) / 65535
    assert (linear[:, 3] == 1).all()
    # sRGB 128 is 0.2158 of full light, and dark shades survive.
    assert linear[128, 0] == pytest.approx(0.2158, abs=1e-4)
    back = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert (np.round(255 * back[:, 0]) == np.arange(len(back)) % 256).all()


def _values(glb: OpenGlb, accessor: int) -> np.ndarray:
    about = glb.tree["accessors"][accessor]
    view = glb.tree["bufferViews"][about["bufferView"]]
    binary = glb.content[-glb.tree["buffers"][0]["byteLength"] :]
    return np.frombuffer(binary, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(about["count"], -1)


def test_surfaces_that_follow_each_other_show_from_the_start_of_the_first(
    tmp_path: Path, ball: trimesh.Trimesh
) -> None:
    file = tmp_path / "mesh_over_time.glb"
    empty = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    save_meshes_in_time([empty, ball, ball], [0.0, 3.0, 5.0], file)
    glb = OpenGlb(file.read_bytes())
    (animation,) = glb.tree["animations"]
    for number, sampler in enumerate(animation["samplers"]):
        np.testing.assert_allclose(_values(glb, sampler["input"]).ravel(), [0.0, 2.0])
        np.testing.assert_array_equal(_values(glb, sampler["output"]), np.eye(2)[number][:, None].repeat(3, 1))


def test_values_that_are_added_after_a_picture_begin_at_a_multiple_of_4_bytes(
    tmp_path: Path, ball: trimesh.Trimesh
) -> None:
    file = tmp_path / "mesh.glb"
    save_mesh(ball, glb_file=file)
    glb = OpenGlb(file.read_bytes())
    glb.add_texture(b"jpg")  # glTF 2.0, section 3.6.2.4
    added = glb.accessor(np.array([1.0, 2.5]), "SCALAR")
    assert glb.tree["bufferViews"][-1]["byteOffset"] % 4 == 0
    np.testing.assert_array_equal(_values(glb, added).ravel(), [1.0, 2.5])


def test_empty_mesh_gives_an_empty_ply_and_no_glb(tmp_path: Path) -> None:
    empty = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), int), vertex_colors=np.zeros((0, 3), np.uint8))
    ply, glb = tmp_path / "mesh.ply", tmp_path / "mesh.glb"
    save_mesh(empty, ply, glb)
    assert b"element vertex 0" in ply.read_bytes()
    assert not glb.exists()
