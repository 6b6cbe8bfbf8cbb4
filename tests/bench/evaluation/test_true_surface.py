"""True surfaces: C3VD's coverage file, a phantom's mesh, SCARED's single view; and every figure against them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.input.opening import open_sequence
from scopemap_bench.evaluation.surface import compare_surfaces
from scopemap_bench.evaluation.true_surface import (
    TrueSurface,
    TrueView,
    measure_surface,
    read_true_surface,
    seen_points,
)
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from tests.support.tiny_phantom import write_tiny

EYE = PinholeCamera(80.0, 80.0, 79.5, 63.5, 160, 128)


def bowl(side: int = 31) -> trimesh.Trimesh:
    u, v = np.meshgrid(np.arange(side) - side // 2, np.arange(side) - side // 2, indexing="ij")
    a = np.arange(side * side).reshape(side, side)
    faces = [[a[:-1, :-1], a[1:, :-1], a[:-1, 1:]], [a[1:, :-1], a[1:, 1:], a[:-1, 1:]]]
    height = 50 - 0.02 * (u**2 + v**2) + 0.8 * np.sin(0.7 * u)
    vertices = np.stack([u, v, height], -1).reshape(-1, 3)
    return trimesh.Trimesh(vertices, np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in faces]), process=False)


def write_coverage(path: Path, mesh: trimesh.Trimesh, seen: np.ndarray, corner: str = "{v}/{vt}") -> Path:
    """The form of C3VD's own writer: vertices, `vt 0.0 0.0`, `vt 1.0 1.0`, then the faces with vt 1 or 2."""
    lines = [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.vertices] + ["vt 0.0 0.0", "vt 1.0 1.0"]
    for face, is_seen in zip(mesh.faces + 1, seen, strict=True):
        lines.append("f " + " ".join(corner.format(v=v, vt=1 if is_seen else 2) for v in face))
    path.write_text("\n".join(lines) + "\n")
    return path


def views_of(folder: Path) -> list[TrueView]:
    truths = [truth for _, truth in open_sequence(folder)]
    return [(t.T_world_camera, t.depth_mm) for t in truths]  # type: ignore[union-attr, misc]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("tiny") / "phantom", frames=4)


@pytest.fixture(scope="module")
def breathing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("breathing") / "phantom"
    spec = PhantomSpec("colon", 3, 96, 80, seed=1, deform=True, breath_mm=4.0, breath_frames=2.0)
    write_phantom(spec, folder)
    return folder


@pytest.mark.parametrize("corner", ["{v}/{vt}", "{v}/{vt}/{v}"])
def test_c3vds_file_tells_which_faces_were_observed(tmp_path: Path, corner: str) -> None:
    mesh = bowl()
    seen = mesh.triangles_center[:, 0] < 3
    write_coverage(tmp_path / "coverage_mesh.obj", mesh, seen, corner)
    truth = read_true_surface(tmp_path)
    assert truth is not None
    assert isinstance(truth.surface, trimesh.Trimesh)
    np.testing.assert_array_equal(truth.seen, seen)
    np.testing.assert_array_equal(truth.surface.faces, mesh.faces)
    np.testing.assert_allclose(truth.surface.vertices, mesh.vertices, atol=1e-4)
    assert isinstance(truth.observed, trimesh.Trimesh)
    assert truth.observed.area == pytest.approx(mesh.area_faces[seen].sum(), rel=1e-4)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/3\n", "vt 1 \\(observed\\) or 2"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 4/1\n", "none of the 3 vertices"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "expected triangles"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1/1 2/1 4/1 3/1\n", "expected triangles"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "expected triangles"),
        ("v 0 0\nf 1/1 1/1 1/1\n", "expected lines"),
        ("v a b c\nf 1/1 1/1 1/1\n", "cannot read the true surface"),
        ("", "expected lines"),
    ],
)
def test_a_coverage_file_of_another_form_is_refused(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "coverage_mesh.obj").write_text(content)
    with pytest.raises(InputError, match=message):
        read_true_surface(tmp_path)


def test_a_phantoms_surface_was_seen_but_for_its_rim(tiny: Path) -> None:
    truth, sequence = read_true_surface(tiny), open_sequence(tiny)
    assert truth is not None
    assert isinstance(truth.surface, trimesh.Trimesh)
    assert truth.frames == ()
    assert truth.observed is None
    known = truth.seen_by(sequence.camera, dict(enumerate(views_of(tiny))))
    assert isinstance(known.observed, trimesh.Trimesh)
    assert 0.5 < known.observed.area / truth.surface.area < 0.98
    centres = truth.surface.triangles_center
    expected = np.any([seen_points(centres, sequence.camera, view) for view in views_of(tiny)], axis=0)
    np.testing.assert_array_equal(known.seen, expected)
    fewer = truth.seen_by(sequence.camera, {0: views_of(tiny)[0]})
    assert known.seen is not None
    assert fewer.seen is not None
    assert not (fewer.seen & ~known.seen).any()


def test_of_tissue_that_breathes_each_view_is_asked_about_its_own_shape(breathing: Path) -> None:
    truth, sequence, views = read_true_surface(breathing), open_sequence(breathing), views_of(breathing)
    assert truth is not None
    assert len(truth.frames) == 3
    # Frame 1 is at full breath: against the shape at rest less of it seems to be seen.
    moving = truth.seen_by(sequence.camera, {1: views[1]})
    still = replace(truth, frames=()).seen_by(sequence.camera, {1: views[1]})
    assert moving.seen is not None
    assert still.seen is not None
    assert moving.seen.mean() > still.seen.mean() + 0.02
    assert truth.seen_by(sequence.camera, dict(enumerate(views))).seen.mean() >= moving.seen.mean()  # type: ignore[union - attr]
    with pytest.raises(InputError, match="frame 7 is not among the 3 mesh files"):
        truth.seen_by(sequence.camera, {7: views[0]})


def test_views_that_belong_to_another_scene_are_noticed(tiny: Path) -> None:
    truth, sequence = read_true_surface(tiny), open_sequence(tiny)
    assert truth is not None
    metres = [(T, depth / 1000) for T, depth in views_of(tiny)]
    with pytest.raises(InputError, match="no view shows any"):
        truth.seen_by(sequence.camera, dict(enumerate(metres)))


def test_the_truth_itself_scores_full_marks() -> None:
    mesh = bowl()
    figures = measure_surface(mesh, TrueSurface(mesh, mesh.triangles_center[:, 0] < 3), icp=False)
    assert all(abs(value) < 1e-6 for key, value in figures.items() if key.endswith("_mm"))
    assert 0.5 < figures.pop("observed_share") < 0.7
    assert figures.pop("normal_consistency") > 0.98
    assert {value for key, value in figures.items() if not key.endswith("_mm")} == {1.0}
    assert math.isnan(measure_surface(mesh, TrueSurface(mesh), icp=False)["coverage_2mm"])


def test_icp_is_a_second_number_and_leaves_the_first_alone() -> None:
    truth = TrueSurface(bowl(), np.ones(len(bowl().faces), bool))
    moved = bowl().apply_transform(se3(so3_exp(np.array([0.03, -0.02, 0.01])), np.array([0.2, -0.3, 1.5])))
    figures, without = measure_surface(moved, truth), measure_surface(moved, truth, icp=False)
    assert compare_surfaces(moved, bowl(), observed=bowl()).items() <= without.items()
    assert {key: figures[key] for key in without} == without
    assert not any("icp" in key for key in without)
    assert figures["accuracy_mean_mm"] > 1
    assert figures["accuracy_icp_mean_mm"] < 0.05
    assert figures["icp_rms_after_mm"] < 0.05 < 1 < figures["icp_rms_before_mm"]


def scan() -> np.ndarray:
    """A wall at 50 mm, one point per pixel, known in the middle of the picture only."""
    points = (EYE.rays * 50).astype(np.float64)
    known = np.zeros((EYE.height, EYE.width), bool)
    known[32:96, 40:120] = True
    return np.where(known[..., None], points, np.nan)


def test_what_a_single_view_cannot_judge_is_left_out() -> None:
    points = scan()
    truth = TrueSurface(points[np.isfinite(points[..., 0])], T_view=np.eye(4))
    wall = trimesh.creation.box(extents=(130, 110, 1e-6)).apply_translation([0, 0, 50])
    behind = wall.copy().apply_translation([0, 0, 30])
    beside = trimesh.creation.icosphere(subdivisions=3, radius=5).apply_translation([60, 0, 40])
    figures = measure_surface(trimesh.util.concatenate([wall, behind, beside]), truth, camera=EYE, icp=False)
    assert figures["accuracy_p90_mm"] < 0.6
    assert figures["precision_1mm"] > 0.99
    assert (figures["coverage_2mm"], figures["observed_share"]) == (1, 1)
    assert math.isnan(figures["normal_consistency"])
    # Unrestricted, tissue that nobody scanned counts as wrong; and at another size the view is the same view.
    assert compare_surfaces(wall, truth.surface)["accuracy_mean_mm"] > 8
    small = measure_surface(wall, truth, camera=EYE.resized(80, 64), icp=False)
    assert small["accuracy_p90_mm"] < 1.0
    # An error in sight is not hidden: a lump before the wall is measured.
    lump = trimesh.creation.icosphere(subdivisions=3, radius=5).apply_translation([0, 0, 40])
    assert measure_surface(trimesh.util.concatenate([wall, lump]), truth, camera=EYE, icp=False)["precision_5mm"] < 1
    with pytest.raises(ValueError, match="needs the camera"):
        measure_surface(wall, truth)


def test_a_scared_keyframe_is_read_from_its_map_and_from_its_cloud(tmp_path: Path) -> None:
    points = scan().astype(np.float32)
    mapped, cloud = tmp_path / "map", tmp_path / "cloud"
    mapped.mkdir()
    cloud.mkdir()
    # OpenCV writes the channels in reverse, so that the file holds x, y, z.
    assert cv2.imwrite(str(mapped / "left_depth_map.tiff"), points[..., ::-1])
    lines = ["v " + " ".join(f"{value:.6f}" for value in point) for point in points.reshape(-1, 3)]
    (cloud / "point_cloud.obj").write_text("\n".join(lines) + "\n")
    expected = points[np.isfinite(points[..., 0])]
    for folder in (mapped, cloud):
        truth = read_true_surface(folder)
        assert truth is not None
        assert truth.observed is truth.surface
        np.testing.assert_array_equal(truth.T_view, np.eye(4))
        np.testing.assert_allclose(np.asarray(truth.surface), expected, atol=1e-5)
    (cloud / "point_cloud.obj").write_text("v nan nan nan\n" * 4)
    with pytest.raises(InputError, match="all missing"):
        read_true_surface(cloud)
    (mapped / "left_depth_map.tiff").write_bytes(b"")
    with pytest.raises(InputError, match=r"left_depth_map\.tiff"):
        read_true_surface(mapped)
