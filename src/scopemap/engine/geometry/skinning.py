"""Skinning: points that move with the nodes near them, each by the weighted mean of its nodes' displacements."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

_SKIN = 4  # by hand: nodes of a point
_LEAST_WEIGHT = 1e-3  # guard: a point as far as its farthest node still has weights


class Skin(NamedTuple):
    """Nodes of P points, (P, 4) int, and their weights (P, 4), whose sum is 1 unless nodes are held."""

    node: np.ndarray
    weight: np.ndarray

    def among(self, moving: np.ndarray) -> Skin:
        """Return the same with the moving nodes, (N,) bool, alone; the others are held."""
        place = np.maximum(np.cumsum(moving) - 1, 0)
        return Skin(place[self.node], self.weight * moving[self.node])

    def displaced(self, displacement: np.ndarray) -> np.ndarray:
        """Return the displacements (..., P, 3) of the points by those of the nodes, (..., N, 3)."""
        return np.einsum("pj,...pjc->...pc", self.weight, displacement[..., self.node, :])


def skin_of(nodes: np.ndarray, points: np.ndarray) -> Skin:
    """Return the four nearest of more than four nodes (N, 3) to each of points (P, 3); the fifth would weigh 0."""
    far, node = KDTree(nodes).query(points, k=_SKIN + 1)
    weight = np.maximum(1 - far[:, :-1] / far[:, -1:], _LEAST_WEIGHT) ** 2
    return Skin(node[:, :-1], weight / weight.sum(1, keepdims=True))
