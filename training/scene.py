"""A random scene: what stands where, as rows of numbers that the numba functions of `shapes` and `marching` read.

Lengths are in scene units (a colon is about 20 wide); millimetres come last, when the view is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from training.shapes import COLUMNS

COLON, BAG, AIRWAY, SINUS, LAPAROSCOPY, WALL = 1, 2, 3, 4, 5, 6
KINDS = {COLON: "colon", BAG: "bag", AIRWAY: "airway", SINUS: "sinus", LAPAROSCOPY: "laparoscopy", WALL: "wall"}
_BASE = 31
_BOUND = 30
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _rows(columns: int) -> Callable[[], np.ndarray]:
    return lambda: np.zeros((0, columns))


@dataclass(frozen=True)
class Scene:
    """One scene, before any camera. All lengths in scene units.

    kind : one of `KINDS`.
    base : (31,) numbers of the tube or floor; base[0] says which (0 tube, 1 floor, 2 neither).
    bends, folds : (n, 9), (n, 9), of the tube; see `scene_tubes`.
    shapes : (n, COLUMNS) spaces to carve out and solids to put in, in this order.
    warps : (n, 5) amplitude, wave number, three phases of the sines that bend everything a little.
    relief : (n, 4) amplitude, period, seed, mode of the bumps.
    tools : (n, COLUMNS) instruments: neither bent nor bumpy.
    spots : (n, 4) free places for a camera (x, y, z) and how far it may stray.
    seed : of the noise that textures stick to.
    """

    kind: int
    base: np.ndarray
    seed: int
    bends: np.ndarray = field(default_factory=_rows(9))
    folds: np.ndarray = field(default_factory=_rows(9))
    shapes: np.ndarray = field(default_factory=_rows(COLUMNS))
    warps: np.ndarray = field(default_factory=_rows(5))
    relief: np.ndarray = field(default_factory=_rows(4))
    tools: np.ndarray = field(default_factory=_rows(COLUMNS))
    spots: np.ndarray = field(default_factory=_rows(4))

    def arrays(self) -> Arrays:
        """Return the arrays as the numba functions take them, with the bound of the bumps filled in."""
        base = np.zeros(_BASE)
        base[: len(self.base)] = self.base
        base[_BOUND] = np.abs(self.relief[:, 0]).sum() + 1e-3
        rows = (self.bends, self.folds, self.shapes, self.warps, self.relief, self.tools)
        return (base, *(np.ascontiguousarray(r, dtype=np.float64) for r in rows))  # type: ignore[return-value]

    def with_tools(self, tools: np.ndarray) -> Scene:
        """Return this scene with instruments (n, COLUMNS)."""
        return replace(self, tools=tools)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number between low and high (> 0), as often in each octave."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Return a uniformly random rotation (3, 3)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def rotation_to(axis: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
    """Return a rotation (3, 3) whose first row is along `axis` (3,); rolled at random with `rng`."""
    x = axis / np.linalg.norm(axis)
    other = np.array([0.0, 0.0, 1.0]) if abs(x[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = np.cross(other, x)
    y /= np.linalg.norm(y)
    z = np.cross(x, y)
    a = 0.0 if rng is None else rng.uniform(0, 2 * np.pi)
    return np.stack([x, np.cos(a) * y + np.sin(a) * z, np.cos(a) * z - np.sin(a) * y])


def random_warps(rng: np.random.Generator, size: float, strength: float = 1.0) -> np.ndarray:
    """Return 1-3 gentle bends (n, 5) of a scene of that size; slopes stay below about 0.35 each."""
    rows = []
    for _ in range(int(rng.integers(1, 4))):
        period = size * log_uniform(rng, 0.3, 2.5)
        slope = strength * rng.uniform(0.02, 0.35)
        rows.append([slope * period / (2 * np.pi), 2 * np.pi / period, *rng.uniform(0, 2 * np.pi, 3)])
    return np.array(rows)


def random_relief(rng: np.random.Generator, size: float, strength: float = 1.0) -> np.ndarray:
    """Return 2-4 octaves of bumps (n, 4): the finer, the lower."""
    rows = []
    period = size * log_uniform(rng, 0.25, 1.2)
    overall = strength * log_uniform(rng, 0.25, 1.6)
    for _ in range(int(rng.integers(2, 5))):
        height = overall * period * log_uniform(rng, 0.012, 0.12)
        mode = float(rng.choice([0, 0, 0, 1, 2]))
        rows.append([height * (0.6 if mode else 1.0), period, float(rng.integers(1 << 20)), mode])
        period *= rng.uniform(0.3, 0.6)
    return np.array(rows)
