"""Surfaces: closed forms on planes and spheres, exactness against brute force, the stated bound, flat figures."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap_bench.evaluation.surface import (
    compare_surfaces,
    distance_to_mesh,
    distances_mm,
    normal_consistency,
    thinned,
)


def brute_force(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    distances = []
    for point in points:
        closest = trimesh.triangles.closest_point(mesh.triangles, np.tile(point, (len(mesh.faces), 1)))
        distances.append(np.linalg.norm(closest - point, axis=1).min())
    return np.array(distances)


def wavy_sheet(side: int, step_mm: float) -> trimesh.Trimesh:
    u, v = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = np.stack([u * step_mm, v * step_mm, 3 * np.sin(0.2 * u * step_mm) * np.cos(0.15 * v * step_mm)], -1)
    a = (u * side + v)[:-1, :-1].ravel()
    faces = np.concatenate([np.stack([a, a + side, a + 1], 1), np.stack([a + side, a + side + 1, a + 1], 1)])
    return trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), step_mm=st.sampled_from([0.7, 1.5, 6.0]))
def test_the_distance_is_exact(seed: int, step_mm: float) -> None:
    mesh = wavy_sheet(20, step_mm)
    rng = np.random.default_rng(seed)
    points = mesh.vertices[rng.integers(len(mesh.vertices), size=60)] + rng.normal(scale=1.5, size=(60, 3))
    np.testing.assert_allclose(distance_to_mesh(points, mesh), brute_force(points, mesh), atol=1e-9)


def test_a_crowd_of_nearer_centroids_hides_no_triangle() -> None:
    # 200 specks 10 mm from the origin, and the tip of one larger triangle at 9.5 mm whose centroid lies behind them.
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(200, 3))
    centres = 10 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    specks = centres[:, None] + rng.normal(scale=1e-3, size=(200, 3, 3))
    tip = np.array([[[9.5, 0, 0], [11.2, 0.5, 0], [11.2, -0.5, 0]]])
    crowd = trimesh.Trimesh(np.concatenate([specks, tip]).reshape(-1, 3), np.arange(603).reshape(-1, 3), process=False)
    origin = np.zeros((1, 3))
    assert distance_to_mesh(origin, crowd)[0] == pytest.approx(9.5)


def test_large_and_few_triangles() -> None:
    single = trimesh.Trimesh([[0, 0, 0], [100, 0, 0], [0, 100, 0]], [[0, 1, 2]])
    points = np.array([[20, 20, 7.0], [-3, -4, 0], [100, 100, 0], [50, 50, 0]])
    expected = [7, 5, np.sqrt(2) * 50, 0]
    np.testing.assert_allclose(distance_to_mesh(points, single), expected, atol=1e-9)
    tiny = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    np.testing.assert_allclose(distance_to_mesh(points, tiny), brute_force(points, tiny), atol=1e-9)
    assert distance_to_mesh(np.empty((0, 3)), tiny).shape == (0,)


def test_concentric_spheres_and_points_against_a_mesh() -> None:
    inner, outer = (trimesh.creation.icosphere(subdivisions=4, radius=radius) for radius in (20.0, 22.0))
    assert compare_surfaces(inner, outer)["chamfer_mm"] == pytest.approx(2.0, abs=0.03)
    on_outer, others = (trimesh.sample.sample_surface(outer, 20_000, seed=seed)[0] for seed in (3, 4))
    assert compare_surfaces(on_outer, inner)["accuracy_mean_mm"] == pytest.approx(2.0, abs=0.04)
    # From point to point a spacing of half a millimetre shows up as error; to the mesh it does not.
    assert 0.05 < compare_surfaces(on_outer, others)["accuracy_mean_mm"] < 0.3
    assert compare_surfaces(on_outer, outer)["accuracy_mean_mm"] == pytest.approx(0, abs=1e-9)


def part(mesh: trimesh.Trimesh, chosen: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[chosen], process=False)


def test_what_nobody_saw_is_not_asked_for() -> None:
    whole = wavy_sheet(41, 1.0)
    seen = whole.triangles_center[:, 0] < 20
    half = part(whole, seen)
    blind, informed = compare_surfaces(half, whole), compare_surfaces(half, whole, observed=half)
    assert blind["completeness_mean_mm"] > 3
    assert math.isnan(blind["coverage_2mm"])
    assert math.isnan(blind["observed_share"])
    assert informed["completeness_mean_mm"] == pytest.approx(0, abs=1e-9)
    assert informed["coverage_2mm"] == 1
    assert informed["observed_share"] == pytest.approx(half.area / whole.area)
    # Beyond the seen part a prediction may still be right: accuracy is measured on the whole.
    assert compare_surfaces(whole, whole, observed=half)["accuracy_mean_mm"] == pytest.approx(0, abs=1e-9)


def test_figures_are_flat_and_named_by_threshold() -> None:
    upper, lower = trimesh.creation.box(extents=(12, 12, 1e-6)), trimesh.creation.box(extents=(12, 12, 1e-6))
    upper.apply_translation([0, 0, 1.5])
    figures = compare_surfaces(upper, lower, observed=lower)
    distances = {
        f"{side}_{key}_mm" for side in ("accuracy", "completeness") for key in ("mean", "median", "rms", "p90")
    }
    scores = {f"{key}_{limit}" for key in ("precision", "recall", "f") for limit in ("1mm", "2mm", "5mm")}
    assert set(figures) == distances | scores | {"chamfer_mm", "coverage_2mm", "observed_share"}
    assert all(type(value) is float for value in figures.values())
    assert json.loads(json.dumps(figures)) == figures
    assert all(figures[key] == pytest.approx(1.5, abs=1e-5) for key in (*distances, "chamfer_mm"))
    assert (figures["f_1mm"], figures["f_2mm"], figures["coverage_2mm"]) == (0, 1, 1)


def test_nothing_predicted_covers_nothing() -> None:
    truth = wavy_sheet(21, 1.0)
    left = part(truth, truth.triangles_center[:, 0] < 10)
    figures = compare_surfaces(trimesh.Trimesh(), truth, observed=left)
    assert set(figures) == set(compare_surfaces(truth, truth))
    assert figures["observed_share"] == pytest.approx(left.area / truth.area)
    zero = {key for key, value in figures.items() if value == 0}
    assert zero == {"coverage_2mm"} | {f"{name}_{limit}mm" for name in ("recall", "f") for limit in (1, 2, 5)}
    assert sum(math.isnan(value) for value in figures.values()) == len(figures) - len(zero) - 1
    assert math.isnan(compare_surfaces(np.empty((0, 3)), truth)["coverage_2mm"])


def test_normals_of_tilted_planes_agree_by_the_cosine() -> None:
    flat = trimesh.creation.box(extents=(12, 12, 1e-6))
    tilted = flat.copy().apply_transform(se3(so3_exp(np.array([0.5, 0, 0])), np.zeros(3)))
    assert normal_consistency(flat, tilted) == pytest.approx(np.cos(0.5), abs=1e-3)
    flipped = flat.copy()
    flipped.invert()
    assert normal_consistency(flat, flipped) == pytest.approx(1, abs=1e-3)


def test_dense_points_are_thinned_and_distances_stay() -> None:
    rng = np.random.default_rng(2)
    truth = np.column_stack([rng.uniform(-10, 10, (200_000, 2)), np.zeros(200_000)])
    fewer = thinned(truth)
    assert len(truth) / 25 < len(fewer) < len(truth) / 15
    others = np.column_stack([rng.uniform(-9, 9, (2_000, 2)), rng.uniform(-1, 1, 2_000)])
    found, wanted = (distances_mm(others, surface) for surface in (fewer, truth))
    assert np.abs(found - wanted).mean() < 0.03
    mesh = wavy_sheet(10, 1.0)
    assert thinned(mesh) is mesh
