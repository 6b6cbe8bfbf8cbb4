"""Marching cubes against closed forms and scikit-image's: the same vertices, closed surfaces from any field."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes as reference

from scopemap.engine.fusion.mesh import marching_cubes

SIDE = 24


def _all_cells(field: np.ndarray) -> np.ndarray:
    return np.ones(np.array(field.shape) - 1, bool)


def _mesh(field: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(*marching_cubes(field, _all_cells(field)), process=False)


def _smooth(seed: int, shape: tuple[int, int, int] = (SIDE, SIDE + 3, SIDE - 5), width: float = 2.0) -> np.ndarray:
    return gaussian_filter(np.random.default_rng(seed).normal(size=shape), width)


def _distance(point: np.ndarray, others: np.ndarray) -> np.ndarray:
    return cKDTree(others).query(point)[0]


def test_smooth_fields_give_the_vertices_and_the_area_of_scikit_image() -> None:
    for seed in range(4):
        field = _smooth(seed)
        mesh, (vertices, faces, _, _) = _mesh(field), reference(field, 0.0, gradient_direction="descent")
        theirs = trimesh.Trimesh(vertices, faces, process=False)
        # Theirs joins parts through the inside of a few cells, and has a vertex in the middle of some.
        assert len(mesh.faces) == pytest.approx(len(faces), rel=2e-3)
        for some, others in ((mesh.vertices, vertices), (vertices, mesh.vertices)):
            assert np.mean(_distance(some, others) < 1e-4) > 0.998
        np.testing.assert_allclose(mesh.area, theirs.area, rtol=5e-3)
        np.testing.assert_allclose(mesh.volume, theirs.volume, atol=1e-3 * field.size)


def test_only_the_cells_that_are_asked_for_give_faces() -> None:
    field = _smooth(7)
    cells = _all_cells(field)
    cells[:6], cells[:, 9] = False, False
    vertices, faces = marching_cubes(field, cells)
    centres = np.floor(vertices[faces].mean(axis=1)).astype(int)
    assert cells[tuple(centres.T)].all()
    theirs, their_faces, _, _ = reference(field, 0.0, mask=np.pad(cells, ((1, 0),) * 3))
    assert len(faces) == pytest.approx(len(their_faces), rel=2e-3)
    assert np.mean(_distance(theirs[np.unique(their_faces)], vertices) < 1e-4) > 0.998


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.6, 1.2]), st.booleans())
def test_any_field_gives_a_closed_surface(seed: int, width: float, equal: bool) -> None:
    # With values that are equal but for their signs, every saddle is undecided.
    field = _smooth(seed, (9, 8, 10), width)
    field = np.pad(np.sign(field) if equal else field, 1, constant_values=1.0)
    mesh = _mesh(field)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
