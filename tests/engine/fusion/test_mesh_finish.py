"""What becomes of the fused mesh: small holes closed and nothing else, smoothed, simplified, and the run's options."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import Config, FusionSettings
from scopemap.engine.fusion.finish import (
    border_edges,
    finished,
    simplified,
    smoothed,
    with_even_border,
    with_normals_alone,
    without_small_holes,
)
from scopemap.engine.fusion.mesh_files import ply_bytes
from tests.support.front_door import call
from tests.support.tiny_phantom import write_tiny


def _plate(size: int = 40) -> trimesh.Trimesh:
    """A square of size^2 vertices, 1 mm apart, red on its left half, with full confidence."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    faces = [[corner, corner + 1, corner + size], [corner + 1, corner + size + 1, corner + size]]
    colours = np.where((x < size / 2).reshape(-1, 1), np.uint8([200, 20, 20]), np.uint8([20, 20, 200]))
    return trimesh.Trimesh(
        np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float),
        np.concatenate([np.stack(half, 1) for half in faces]),
        vertex_colors=colours,
        vertex_attributes={"confidence": np.ones(size * size, np.float32)},
        process=False,
    )


def _cut(mesh: trimesh.Trimesh, *discs: tuple[float, float, float]) -> trimesh.Trimesh:
    """Cut discs (x, y, radius) out of a plate."""
    centres = mesh.triangles_center
    inside = [np.hypot(centres[:, 0] - x, centres[:, 1] - y) < radius for x, y, radius in discs]
    mesh.update_faces(~np.any(inside, axis=0))
    return mesh


def _borders(mesh: trimesh.Trimesh) -> int:
    """Number of closed borders."""
    edges = mesh.edges_sorted[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    return len(trimesh.graph.connected_components(edges))


def test_small_holes_are_closed_and_large_ones_stay() -> None:
    torn = _cut(_plate(), (6.0, 20.0, 1.5), (33.0, 20.0, 1.5), (20.0, 20.0, 7.0))
    closed = without_small_holes(torn, 20.0)
    assert (_borders(torn), _borders(closed)) == (4, 2)
    assert closed.is_winding_consistent
    assert closed.area == pytest.approx(39**2 - np.pi * 7**2, rel=0.02)
    np.testing.assert_array_equal(closed.vertices[: len(torn.vertices)], torn.vertices)
    new = slice(len(torn.vertices), None)
    np.testing.assert_allclose(closed.vertices[new, :2], [[6, 20], [33, 20]], atol=0.3)
    assert np.asarray(closed.visual.vertex_colors)[new, :3].tolist() == [[200, 20, 20], [20, 20, 200]]
    confidence = closed.vertex_attributes["confidence"]
    assert confidence.dtype == np.float32
    assert confidence[new].tolist() == [0, 0]
    assert (confidence[: len(torn.vertices)] == 1).all()


def test_holes_that_touch_are_both_closed() -> None:
    plate = _plate()
    corners = np.asarray(plate.vertices)[plate.faces]
    low, high = corners.min(axis=1)[:, :2], corners.max(axis=1)[:, :2]
    holes = [((low >= at) & (high <= np.array(at) + 2)).all(axis=1) for at in ((10, 10), (12, 12))]
    plate.update_faces(~(holes[0] | holes[1]))
    closed = without_small_holes(plate, 20.0)
    assert _borders(closed) == 1
    assert closed.area == pytest.approx(39**2)


def test_islands_and_the_ends_of_a_tube_are_no_holes() -> None:
    island = _plate(6)
    assert without_small_holes(island, 100.0) is island
    tube = trimesh.creation.cylinder(2.0, 30.0, sections=16)
    tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)
    tube.remove_unreferenced_vertices()
    assert _borders(tube) == 2
    assert without_small_holes(tube, 100.0) is tube
    assert without_small_holes(trimesh.Trimesh(), 20.0).is_empty


def test_a_ball_with_pricks_is_whole_again() -> None:
    ball = trimesh.creation.icosphere(4, 10.0)
    volume = ball.volume
    ball.update_faces(np.arange(len(ball.faces)) % 97 != 0)
    settings = FusionSettings(voxel_mm=1.0)
    assert not ball.is_watertight
    assert finished(ball, settings).is_watertight
    assert finished(ball, settings).volume == pytest.approx(volume, rel=1e-3)
    assert finished(ball, settings.model_copy(update={"holes": "none"})) is ball


def test_a_border_loses_teeth_strips_and_specks_and_becomes_smooth() -> None:
    plate = _plate(60)
    x, y = plate.triangles_center[:, :2].T
    comb = (y > 50) & (x // 3 % 2 == 1)
    plate.update_faces((y < 50) | comb)
    speck = trimesh.Trimesh(
        np.add(_plate(3).vertices, [80.0, 0, 0]), _plate(3).faces, vertex_colors=[[9, 9, 9]] * 9, process=False
    )
    speck.vertex_attributes["confidence"] = np.ones(9, np.float32)
    ragged = trimesh.util.concatenate([plate, speck])
    even = with_even_border(ragged)
    assert len(even.split(only_watertight=False)) == 1
    assert even.area == pytest.approx(59 * 50, rel=0.03)
    assert even.vertices[:, 1].max() < 53
    middle = (even.vertices[:, 0] > 5) & (even.vertices[:, 0] < 54)
    line = np.unique(border_edges(even))
    top = line[middle[line] & (even.vertices[line, 1] > 25)]
    assert even.vertices[top, 1].std() < 0.6
    assert even.vertex_attributes["confidence"].shape == (len(even.vertices),)
    left = even.vertices[:, 0] < 25
    assert (np.asarray(even.visual.vertex_colors)[left, 0] == 200).all()


def test_a_thin_surface_and_one_without_border_stay() -> None:
    strip = _plate()
    strip.update_faces(np.abs(strip.triangles_center[:, 0] - 11.5) < 1.5)
    assert with_even_border(strip) is strip
    ball = trimesh.creation.icosphere(3, 10.0)
    np.testing.assert_array_equal(with_even_border(ball).vertices, ball.vertices)
    assert with_even_border(trimesh.Trimesh()).is_empty


def test_an_open_tube_becomes_a_watertight_lumen() -> None:
    tube = trimesh.creation.cylinder(10.0, 40.0, sections=64).subdivide_to_size(1.0)
    tube.update_faces(np.abs(tube.triangles_center[:, 2]) < 19.0)
    tube.remove_unreferenced_vertices()
    tube.invert()
    tube.vertex_attributes["confidence"] = np.ones(len(tube.vertices), np.float32)
    whole = finished(tube, FusionSettings(voxel_mm=1.0, holes="watertight"))
    assert whole.is_watertight
    assert -whole.volume > np.pi * 10**2 * 36
    seen = whole.vertex_attributes["confidence"] == 1
    wall = np.abs(whole.vertices[:, 2]) < 17
    assert seen[wall].all()
    assert np.abs(np.hypot(*whole.vertices[wall, :2].T) - 10).max() < 0.5
    middle = np.hypot(*whole.vertices[:, :2].T) < 5
    assert middle.any()
    assert not seen[middle].any()
    assert (np.asarray(whole.visual.vertex_colors)[middle, :3] == 128).all()


def test_a_simplified_mesh_keeps_its_shape_colours_and_confidence() -> None:
    plate = _cut(_plate(60), (30.0, 30.0, 10.0))
    plate.vertices[:, 2] = 5 * np.sin(plate.vertices[:, 0] / 10)
    plate.vertex_attributes["confidence"] = np.where(plate.vertices[:, 1] < 30, 1, 0.25).astype(np.float32)
    few = simplified(plate, 800)
    assert 600 < len(few.faces) <= 800
    assert _borders(few) == 2
    np.testing.assert_allclose(few.vertices[:, 2], 5 * np.sin(few.vertices[:, 0] / 10), atol=0.2)
    inner = (np.abs(few.vertices[:, :2] - 29.5) > 1.5).all(axis=1)
    x, y = few.vertices[inner, :2].T
    np.testing.assert_array_equal(np.asarray(few.visual.vertex_colors)[inner, 0], np.where(x < 30, 200, 20))
    np.testing.assert_array_equal(few.vertex_attributes["confidence"][inner], np.where(y < 30, 1, 0.25))
    assert simplified(plate, 10**6) is plate


def test_smoothing_takes_noise_and_leaves_volume_and_border() -> None:
    ball = trimesh.creation.icosphere(5, 20.0)
    volume = ball.volume
    ball.vertices += np.random.default_rng(1).normal(0, 0.1, ball.vertices.shape)
    smooth = smoothed(ball, 10)
    noise, left = (np.linalg.norm(mesh.vertices, axis=1).std() for mesh in (ball, smooth))
    assert left < 0.4 * noise
    assert smooth.volume == pytest.approx(volume, rel=0.01)
    plate = _plate(20)
    plate.vertices[:, 2] = np.random.default_rng(2).normal(0, 0.2, 400)
    flat = smoothed(plate, 10)
    border = ((plate.vertices[:, :2] == 0) | (plate.vertices[:, :2] == 19)).any(axis=1)
    np.testing.assert_array_equal(flat.vertices[border], plate.vertices[border])
    assert flat.vertices[~border, 2].std() < 0.6 * plate.vertices[~border, 2].std()
    assert "confidence" in flat.vertex_attributes


@pytest.mark.slow
def test_the_options_of_a_run(tmp_path: Path) -> None:
    phantom = write_tiny(tmp_path / "phantom", frames=4)
    given = ("--depth", f"files:{phantom}", "--mesh-faces", "900", "--mesh-smooth", "2", "--colours", "raw", "--quiet")
    assert call("run", phantom, "--out", tmp_path / "run", *given) == 0
    fusion = Config.load(file=tmp_path / "run" / "config.toml").fusion
    assert (fusion.mesh_faces, fusion.mesh_smooth, fusion.colours, fusion.holes) == (900, 2, "raw", "small")
    assert 500 < len(trimesh.load(tmp_path / "run" / "mesh.ply", process=False).faces) <= 900


@pytest.mark.slow
def test_a_run_whose_frames_have_no_surface_ends_with_an_empty_mesh(tmp_path: Path) -> None:
    phantom = write_tiny(tmp_path / "phantom", frames=4)
    config = Config.load(
        settings={"depth.backend": f"files:{phantom}", "fusion.voxel_mm": 1.0, "fusion.max_depth_mm": 0.999}
    )
    result = reconstruct(open_sequence(phantom), config, out=tmp_path / "run")
    assert result.frames.tracked.all()
    assert (len(result.mesh.faces), (tmp_path / "run" / "mesh.glb").exists()) == (0, False)


def test_a_result_keeps_the_normals_of_its_mesh_and_none_of_their_computation() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.vertex_attributes["confidence"] = np.ones(len(mesh.vertices), np.float32)
    content = ply_bytes(mesh, ["mm"])
    lean = with_normals_alone(mesh)
    assert ply_bytes(lean, ["mm"]) == content
    assert {"face_normals", "face_angles"} <= set(mesh._cache.cache) - set(lean._cache.cache)
