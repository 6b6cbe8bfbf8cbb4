"""Faces of a mesh: the vertices that they use, and the parts that are connected."""

from __future__ import annotations

import numpy as np

from scopemap.engine.geometry.kernels import Int64_2d, kernel


def without_unused(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (U,) of the vertices that faces (F, 3) use, ascending, and the faces with places therein.

    count : of all vertices.
    """
    is_used = np.zeros(count, bool)
    is_used[faces] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces]


@kernel
def connected_parts(pairs: Int64_2d, count: int) -> tuple[np.ndarray, int]:
    """Return the number of the connected part that each of `count` places is in, (count,) int64, and of the parts.

    pairs : (P, 2), places that are connected. Parts are numbered in the order of their first places.
    """
    # Of each place one of the same part that is not behind it; of the part's first one itself (union-find).
    before = np.arange(count)
    for n in range(len(pairs)):
        one, other = pairs[n, 0], pairs[n, 1]
        while before[one] != one:
            before[one] = before[before[one]]
            one = before[one]
        while before[other] != other:
            before[other] = before[before[other]]
            other = before[other]
        before[max(one, other)] = min(one, other)
    part, parts = np.empty(count, np.int64), 0
    for place in range(count):
        if before[place] == place:
            part[place] = parts
            parts += 1
        else:
            part[place] = part[before[place]]
    return part, parts
