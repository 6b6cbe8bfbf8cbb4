"""Evens the brightness of a texture's charts: one smooth gain for each, so that their seams vanish.

The gains are unknowns at the vertices of charts, as in Waechter, Moehrle and Goesele (ECCV 2014, section 4.2, after
Lempitsky and Ivanov 2007): along seams both sides shall show one colour, inside charts the gains shall be smooth. Here
they are gains, not offsets: the lamp's fall-off is a factor. They also pull each chart to the colours of the surface,
which are the tissue's own, without the lamp, in one exposure (`fusion/albedo.py`). So charts that share no seam fit
each other, and what no view shows, which has the surface's colours alone, fits the charts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu

# Weights beside 1, that of the difference between the gains at two ends of an edge, squared.
_SEAM = 10.0  # by hand
# By hand: the gains follow the surface's colours over some 1 / sqrt(0.03) = 6 edges.
_SURFACE = 0.03
_LEAST_LEVEL = 4.0  # by hand: darker levels are noise
_MOST_LOG_GAIN = float(np.log(4.0))  # by hand: beyond it noise would show


class ChartVertices(NamedTuple):
    """The vertices of all charts: a vertex of the mesh is there once for each chart that it belongs to.

    of_corner : (F, 3) int, the vertex of a triangle's corner. vertex : (N,) int, the mesh's vertex. chart : (N,) int,
    -1: in no chart, since no view shows it.
    """

    of_corner: np.ndarray
    vertex: np.ndarray
    chart: np.ndarray


def chart_vertices(faces: np.ndarray, chart: np.ndarray) -> ChartVertices:
    """Return the vertices of charts. faces : (F, 3). chart : (F,) int, that of each triangle, -1: none."""
    vertices = int(faces.max()) + 1 if faces.size else 0
    key = (chart.astype(np.int64) + 1)[:, None] * vertices + faces
    known, of_corner = np.unique(key, return_inverse=True)
    number, vertex = np.divmod(known, max(vertices, 1))
    return ChartVertices(of_corner.reshape(faces.shape), vertex, number - 1)


def level_gains(places: ChartVertices, shown: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Return the gain of each chart's vertex, (N, 3) float32; 1 for those in no chart.

    shown : (N, 3), levels 0..255 of the picture at the vertices, averaged over about an edge. surface : (N, 3), levels
    of the surface there. The normal equations are solved directly, so the same input gives the same bytes.
    """
    gains = np.ones((len(places.chart), 3), np.float32)
    free = places.chart >= 0
    if not free.any():
        return gains
    has, wanted = (np.log(np.maximum(levels, _LEAST_LEVEL)) for levels in (shown, surface))
    has = np.where(free[:, None], has, wanted)  # what is in no chart is shown as it is
    corners = places.of_corner
    pairs = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    keys = np.unique(pairs[free[pairs[:, 0]]] @ [len(free), 1])
    edges = np.stack(np.divmod(keys, len(free)), axis=1)
    seams = _seams(places)
    one, other = np.concatenate([edges, seams]).T
    weight = np.concatenate([np.ones(len(edges)), np.full(len(seams), _SEAM)])
    # The gain of `one` less that of `other`.
    step = np.concatenate([np.zeros((len(edges), 3)), has[seams[:, 1]] - has[seams[:, 0]]])
    rows = np.arange(len(one))
    difference = sparse.csr_array(
        (np.tile([1.0, -1.0], (len(rows), 1)).T.ravel(), (np.tile(rows, 2), np.concatenate([one, other]))),
        shape=(len(rows), len(free)),
    )[:, free]
    weighted = difference.T * weight
    system = weighted @ difference + _SURFACE * sparse.eye_array(int(free.sum()))
    right = weighted @ step + _SURFACE * (wanted - has)[free]
    solved = splu(sparse.csc_matrix(system)).solve(right)
    gains[free] = np.exp(np.clip(solved, -_MOST_LOG_GAIN, _MOST_LOG_GAIN))
    return gains


def _seams(places: ChartVertices) -> np.ndarray:
    """Return the pairs (S, 2) of chart vertices that are one vertex of the mesh; those in no chart at most once."""
    order = np.lexsort((places.chart, places.vertex))
    first, second = order[:-1], order[1:]
    same = places.vertex[first] == places.vertex[second]
    found: np.ndarray = np.stack([first[same], second[same]], axis=1)
    return found
