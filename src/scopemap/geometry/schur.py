"""Quadratic model of bundle adjustment: points are eliminated, camera unknowns are solved for (Schur complement).

Every point has one unknown and touches the camera unknowns of its block alone. Triggs et al., "Bundle Adjustment - A
Modern Synthesis", 2000, section 6.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

_RIDGE = 1e-9  # of the diagonal


class PointBlock(NamedTuple):
    """Normal equations of n points that touch the same m camera unknowns.

    columns : (m,) numbers of these. A : (m, m) their second derivative. scores : (n, m) the first, point by point.
    points : numbers of the points. h, g : (n,) second and first derivative of the points. E : (n, m) of both.
    """

    columns: np.ndarray
    A: np.ndarray
    scores: np.ndarray
    points: slice
    h: np.ndarray
    g: np.ndarray
    E: np.ndarray


class CameraBlock(NamedTuple):
    """Normal equations of camera unknowns alone: numbers (m,), second derivative (m, m), first derivative (m,)."""

    columns: np.ndarray
    A: np.ndarray
    b: np.ndarray


@dataclass(frozen=True)
class SchurModel:
    """Model of a cost of camera unknowns and points, in this order; see `least_squares.Model`.

    cost : at the state. build : returns the blocks, called once and only where a step is asked for. free : (F,) numbers
    of the camera unknowns that may change. cameras, points : how many unknowns there are of either.
    """

    cost: float
    build: Callable[[], tuple[list[PointBlock], list[CameraBlock]]]
    free: np.ndarray
    cameras: int
    points: int

    @cached_property
    def blocks(self) -> tuple[list[PointBlock], list[CameraBlock]]:
        """The normal equations, block by block."""
        return self.build()

    @cached_property
    def gradient(self) -> np.ndarray:
        """First derivative (cameras + points,); 0 of what is fixed."""
        own, points = np.zeros(self.cameras), np.zeros(self.points)
        for block in self.blocks[0]:
            own[block.columns] += block.scores.sum(0)
            points[block.points] = block.g
        for prior in self.blocks[1]:
            own[prior.columns] += prior.b
        free = np.zeros(self.cameras)
        free[self.free] = own[self.free]
        return np.concatenate([free, points])

    def gauss_newton_step(self) -> np.ndarray:
        """Return the step (cameras + points,) to the minimum."""
        matrix, rhs = self.reduced()
        free, step = self.free, np.zeros(self.cameras + self.points)
        step[free] = splu(matrix[free][:, free].tocsc()).solve(rhs[free])
        for block in self.blocks[0]:
            points = slice(self.cameras + block.points.start, self.cameras + block.points.stop)
            step[points] = -(block.g + block.E @ step[block.columns]) / block.h
        return step

    def reduced(self) -> tuple[sparse.csc_matrix, np.ndarray]:
        """Return the matrix of the camera unknowns without the points, and the right-hand side (cameras,)."""
        rhs = np.zeros(self.cameras)
        parts = [(prior.columns, prior.A) for prior in self.blocks[1]]
        for prior in self.blocks[1]:
            rhs[prior.columns] -= prior.b
        for block in self.blocks[0]:
            shrunk = block.E / block.h[:, None]
            parts.append((block.columns, block.A - block.E.T @ shrunk))
            rhs[block.columns] -= block.scores.sum(0) - shrunk.T @ block.g
        rows = np.concatenate([np.repeat(columns, len(columns)) for columns, _ in parts])
        columns = np.concatenate([np.tile(columns, len(columns)) for columns, _ in parts])
        values = np.concatenate([A.ravel() for _, A in parts])
        matrix = sparse.coo_matrix((values, (rows, columns)), shape=(self.cameras,) * 2).tocsc()
        return matrix + sparse.diags(_RIDGE * matrix.diagonal()), rhs

    def curvature(self, step: np.ndarray) -> float:
        """Return step^T H step."""
        own, points = step[: self.cameras], step[self.cameras :]
        total = sum(float(own[prior.columns] @ prior.A @ own[prior.columns]) for prior in self.blocks[1])
        for block in self.blocks[0]:
            cameras, some = own[block.columns], points[block.points]
            total += float(cameras @ block.A @ cameras + 2 * some @ (block.E @ cameras) + some @ (block.h * some))
        return total
