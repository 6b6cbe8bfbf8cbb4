"""Faces of a mesh: the vertices that they use, and the parts that are connected."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph


def without_unused(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (U,) of the vertices that faces (F, 3) use, ascending, and the faces with places therein.

    count : of all vertices.
    """
    is_used = np.zeros(count, bool)
    is_used[faces] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces]


def connected_parts(pairs: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Return the number of the connected part that each of `count` places is in, (count,), and of the parts.

    pairs : (P, 2), places that are connected.
    """
    links = sparse.coo_array((np.ones(len(pairs), bool), pairs.T), shape=(count, count))
    parts, part = csgraph.connected_components(links, directed=False)
    return part, int(parts)
