"""Cavities: the bag (stomach, bladder, womb) and the sinus-like cavern with septa and turbinates."""

from __future__ import annotations

import numpy as np

from training.scene import BAG, SINUS, Scene, log_uniform, random_relief, random_rotation, random_warps, rotation_to
from training.shapes import BOX, CONE, ELLIPSOID, RELIEF, SHEET, joined, shape_row, waved


def _unit(rng: np.random.Generator) -> np.ndarray:
    d = rng.normal(size=3)
    return d / np.linalg.norm(d)


def _spots_in(rng: np.random.Generator, centres: np.ndarray, radius: float) -> np.ndarray:
    return np.column_stack([centres, np.full(len(centres), radius)])


def bag(rng: np.random.Generator) -> Scene:
    """Return an ellipsoidal cavity about 30 in half axis, perhaps with rugae, pouches and protruding lumps."""
    half = 30.0 * np.exp(rng.normal(0, 0.25, 3))
    half *= 30.0 / np.cbrt(half.prod())
    rows = [shape_row(ELLIPSOID, np.zeros(3), random_rotation(rng), tuple(half), solid=False)]
    for _ in range(int(rng.integers(0, 4))):
        size = tuple(rng.uniform(8, 22) * np.exp(rng.normal(0, 0.25, 3)))
        place = _unit(rng) * half.min() * rng.uniform(0.5, 1.1)
        rows.append(shape_row(ELLIPSOID, place, random_rotation(rng), size, solid=False))
    joined(rows, log_uniform(rng, 2.0, 15.0))
    for _ in range(rng.poisson(1.6)):
        rows.append(_lump(rng, half))
    relief = random_relief(rng, 40.0, 0.8)
    if rng.random() < 0.5:
        rugae = np.array([[log_uniform(rng, 1.0, 5.0), rng.uniform(10, 24), float(rng.integers(1 << 20)), 1.0]])
        relief = np.vstack([rugae, relief[1:]])
    return Scene(
        kind=BAG,
        base=np.array([2.0]),
        shapes=np.array(rows),
        warps=random_warps(rng, 60.0),
        relief=relief,
        spots=np.array([[0.0, 0.0, 0.0, 0.85 * half.min()], [0.0, 0.0, 0.0, 0.5 * half.min()]]),
        seed=int(rng.integers(1 << 20)),
    )


def _lump(rng: np.random.Generator, half: np.ndarray) -> np.ndarray:
    """A polyp, a fibroid, a stone: standing off the wall by some of its size."""
    outward, size = _unit(rng), log_uniform(rng, 2.0, 12.0)
    place = outward * half.min() * rng.uniform(0.85, 1.2)
    axes = tuple(size * np.exp(rng.normal(0, 0.3, 3)))
    row = shape_row(ELLIPSOID, place, rotation_to(-outward, rng), axes, part=int(rng.integers(0, 5)))
    row[3] = log_uniform(rng, 0.3, 6.0)
    row[RELIEF] = rng.uniform(0.2, 1.0)
    return row


def sinus(rng: np.random.Generator) -> Scene:
    """Return several spaces run together, with septa, turbinates and strands standing in them."""
    count = int(rng.integers(3, 9))
    centres, rows = np.zeros((count, 3)), []
    for n in range(count):
        if n:
            centres[n] = centres[rng.integers(n)] + _unit(rng) * rng.uniform(10, 24)
        size = rng.uniform(9, 18) * np.exp(rng.normal(0, 0.25, 3))
        kind = BOX if rng.random() < 0.35 else ELLIPSOID
        rounding = (0.7 * size.min(),) if kind == BOX else ()
        rows.append(shape_row(kind, centres[n], random_rotation(rng), (*size, *rounding), solid=False))
    joined(rows, log_uniform(rng, 0.8, 8.0))
    for _ in range(rng.poisson(1.3)):
        rows.append(_septum(rng, centres))
    for _ in range(rng.poisson(1.6)):
        rows.append(_turbinate(rng, centres))
    return Scene(
        kind=SINUS,
        base=np.array([2.0]),
        shapes=np.array(rows),
        warps=random_warps(rng, 40.0),
        relief=random_relief(rng, 20.0, 0.8),
        spots=_spots_in(rng, centres, 10.0),
        seed=int(rng.integers(1 << 20)),
    )


def _septum(rng: np.random.Generator, centres: np.ndarray) -> np.ndarray:
    place = centres[rng.integers(len(centres))] + _unit(rng) * rng.uniform(2, 12)
    size = (rng.uniform(8, 25), rng.uniform(5, 14), log_uniform(rng, 0.4, 1.6), rng.uniform(0, 6.3))
    row = shape_row(
        SHEET, place, random_rotation(rng), size, blend=log_uniform(rng, 0.5, 4.0), part=int(rng.integers(0, 3))
    )
    row[RELIEF] = 0.15
    return waved(row, rng.uniform(0, 1.5), rng.uniform(4, 9))


def _turbinate(rng: np.random.Generator, centres: np.ndarray) -> np.ndarray:
    place = centres[rng.integers(len(centres))] + _unit(rng) * rng.uniform(7, 16)
    radius = log_uniform(rng, 1.2, 5.0)
    size = (rng.uniform(5, 22), radius, radius * rng.uniform(0.3, 1.0))
    row = shape_row(
        CONE, place, random_rotation(rng), size, blend=log_uniform(rng, 0.4, 4.0), part=int(rng.integers(0, 5))
    )
    row[RELIEF] = rng.uniform(0.2, 0.8)
    return row
