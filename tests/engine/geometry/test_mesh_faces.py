"""Vertices that faces use, and connected parts, against NumPy's and SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scopemap.engine.geometry.mesh_faces import connected_parts, without_unused


@pytest.mark.parametrize("faces", [0, 1, 30, 300])
def test_faces_keep_their_vertices_under_new_numbers(faces: int) -> None:
    some = np.random.default_rng(faces).integers(0, 200, (faces, 3))
    used, kept = without_unused(some, 200)
    np.testing.assert_array_equal(used, np.unique(some))
    np.testing.assert_array_equal(used[kept], some)


@pytest.mark.parametrize("pairs", [0, 1, 60, 100, 200, 1000])
def test_connected_parts_are_numbered_as_scipy_numbers_them(pairs: int) -> None:
    links = np.random.default_rng(pairs).integers(0, 200, (pairs, 2))
    part, count = connected_parts(links, 200)
    matrix = coo_array((np.ones(pairs, bool), (links[:, 0], links[:, 1])), shape=(200, 200))
    expected_count, expected = connected_components(matrix, directed=False)
    assert count == expected_count
    np.testing.assert_array_equal(part, expected)
