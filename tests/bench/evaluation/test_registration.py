"""ICP: known motions come back, outliers and missing halves do not pull, free directions stay still."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, se3, so3_exp, transform
from scopemap_bench.evaluation.surface import refine, surface_points


def landscape(side: int = 45, step_mm: float = 1.0) -> trimesh.Trimesh:
    """Hills without a symmetry: every motion of it shows."""
    u, v = np.meshgrid(np.arange(side) * step_mm, np.arange(side) * step_mm, indexing="ij")
    height = 4 * np.sin(0.21 * u) * np.cos(0.16 * v) + 2 * np.sin(0.31 * v + 0.05 * u) + 0.05 * u
    a = np.arange(side * side).reshape(side, side)
    lower = np.stack([a[:-1, :-1], a[1:, :-1], a[:-1, 1:]], -1).reshape(-1, 3)
    upper = np.stack([a[1:, :-1], a[1:, 1:], a[:-1, 1:]], -1).reshape(-1, 3)
    return trimesh.Trimesh(np.stack([u, v, height], -1).reshape(-1, 3), np.concatenate([lower, upper]), process=False)


def small_motion(rng: np.random.Generator, angle_rad: float = 0.06, way_mm: float = 1.5) -> np.ndarray:
    return se3(so3_exp(rng.uniform(-angle_rad, angle_rad, 3)), rng.uniform(-way_mm, way_mm, 3))


def left_over(found_R: np.ndarray, found_t: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """How far the found motion takes the landscape's middle beside where it should be, mm, and its turn, rad."""
    middle = np.array([22.0, 22.0, 0.0])
    offset = found_R @ middle + found_t - transform(wanted, middle)
    return float(np.linalg.norm(offset)), float(rotation_angle_rad(found_R @ wanted[:3, :3].T))


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_known_motion_is_undone(seed: int) -> None:
    truth = landscape()
    T = small_motion(np.random.default_rng(seed))
    result = refine(truth.copy().apply_transform(T), truth)
    assert result[0].scale == 1
    off_mm, turned_rad = left_over(result[0].R, result[0].t, inverse(T))
    assert off_mm < 0.05
    assert turned_rad < 2e-3
    assert result[2] < 0.02 < result[1]


def test_it_finds_what_another_icp_finds_on_bare_points() -> None:
    # Where each point has its twin both must find the same motion; the referee is point to point.
    points = surface_points(landscape())[:4000]
    T = small_motion(np.random.default_rng(5), angle_rad=0.005, way_mm=0.1)
    ours = refine(transform(T, points), points)
    theirs, _, _ = trimesh.registration.icp(
        transform(T, points), points, max_iterations=200, threshold=1e-12, scale=False, reflection=False
    )
    off_mm, turned_rad = left_over(ours[0].R, ours[0].t, theirs)
    assert off_mm < 0.01
    assert turned_rad < 1e-3


def test_outliers_and_a_missing_half_do_not_pull() -> None:
    rng, truth = np.random.default_rng(2), landscape()
    T = small_motion(rng)
    half = surface_points(part_left_of(truth, 24.0))[:4000]
    floating = rng.uniform([0, 0, 12], [45, 45, 40], size=(600, 3))
    predicted = transform(T, np.concatenate([half + rng.normal(scale=0.1, size=half.shape), floating]))
    trimmed = refine(predicted, truth)
    off_mm, turned_rad = left_over(trimmed[0].R, trimmed[0].t, inverse(T))
    assert off_mm < 0.2
    assert turned_rad < 0.01


def part_left_of(mesh: trimesh.Trimesh, x_mm: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.triangles_center[:, 0] < x_mm], process=False)


def test_a_plane_is_lifted_and_tilted_but_not_slid() -> None:
    plate = trimesh.creation.box(extents=(60, 60, 1e-6))
    small = trimesh.creation.box(extents=(20, 20, 1e-6))
    T = se3(so3_exp(np.array([0.03, -0.02, 0.0])), np.array([3.0, -2.0, 1.5]))
    result = refine(small.apply_transform(T), plate)
    centre = result[0].transform_points(T[:3, 3])
    np.testing.assert_allclose(centre, [3.0, -2.0, 0.0], atol=0.05)
    assert np.linalg.norm(result[0].R @ T[:3, 2] - [0, 0, 1]) < 1e-4
    assert result[1] > 1
    assert result[2] < 1e-3


def test_a_perfect_prediction_stays() -> None:
    truth = landscape()
    # Other samples of the same surface: what their spacing suggests would only take it away from the truth.
    still = refine(trimesh.sample.sample_surface(truth, 8_000, seed=7)[0], truth)
    assert still[2] <= still[1] < 1e-9
    np.testing.assert_array_equal(still[0].R, np.eye(3))
    np.testing.assert_array_equal(still[0].t, np.zeros(3))


def test_what_cannot_be_fitted_is_refused() -> None:
    truth = landscape()
    with pytest.raises(AlignmentError, match=r"9 and \d+ points, at least 10"):
        refine(truth.vertices[:9], truth)
    with pytest.raises(ValueError, match="no area"):
        refine(trimesh.Trimesh(), truth)
