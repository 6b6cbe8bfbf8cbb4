"""Open scenes: the abdomen full of organs, and a wall seen from near.

The numbers of a floor, `base`: 0 = 1; 1-4, 5-8, 9-12 amplitude, two wave numbers and phase of three waves; 13-14
direction of the trough, 15-17 its depth, width and offset; 18-20 height, width and offset of a step, 21 how its edge
winds; 22 radius of the dome above; 23 the share of the height that is a safe distance.
"""

from __future__ import annotations

import numpy as np

from training.scene import (
    LAPAROSCOPY,
    WALL,
    Scene,
    log_uniform,
    random_relief,
    random_rotation,
    random_warps,
    rotation_to,
)
from training.shapes import BOX, CONE, ELLIPSOID, RELIEF, SHEET, TORUS, joined, shape_row, waved

_UP = np.array([0.0, 0.0, 1.0])


def _floor(rng: np.random.Generator, size: float, strength: float) -> np.ndarray:
    """Numbers of a random floor for a scene of that width; slopes stay below about 1."""
    base = np.zeros(24)
    base[0] = 1.0
    slope = 0.0
    for n in (1, 5, 9):
        period, heading = size * log_uniform(rng, 0.3, 1.6), rng.uniform(0, 2 * np.pi)
        mine = strength * rng.uniform(0, 0.4)
        k = 2 * np.pi / period
        base[n : n + 4] = mine / k, k * np.cos(heading), k * np.sin(heading), rng.uniform(0, 6.3)
        slope += mine
    heading = rng.uniform(0, 2 * np.pi)
    base[13:15] = np.cos(heading), np.sin(heading)
    base[16] = size * rng.uniform(0.3, 1.0)
    base[15] = strength * base[16] * rng.uniform(-0.25, 1.0)
    base[17] = rng.normal(0, 0.2 * size)
    base[19], base[20], base[21] = 0.02 * size, rng.normal(0, 0.15 * size), size * rng.uniform(0.1, 0.5)
    base[22] = 3.2 * size
    base[23] = 1.0 / np.sqrt(1.0 + (0.6 * slope + abs(base[15]) / base[16]) ** 2)
    return base


def _on_floor(rng: np.random.Generator, size: float, height: float) -> np.ndarray:
    return np.array([*rng.normal(0, 0.42 * size, 2), height])


def _flat_axis(rng: np.random.Generator, rise: float = 0.25) -> np.ndarray:
    a = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(a), np.sin(a), rng.normal(0, rise)])


def laparoscopy(rng: np.random.Generator) -> Scene:
    """Return a floor about 100 wide with overlapping organs, loops, lobes, tents and standing flaps."""
    size = 100.0
    base = _floor(rng, size, 0.8)
    makers = [_organ, _lobe, _loop, _ring, _tent, _flap, _cord]
    liking = rng.dirichlet(np.full(len(makers), 0.8))
    rows: list[np.ndarray] = []
    for _ in range(int(rng.integers(3, 15))):
        part, blend = int(rng.integers(1, 7)), log_uniform(rng, 0.3, 5.0)
        rows += makers[int(rng.choice(len(makers), p=liking))](rng, part, blend)
    return Scene(
        kind=LAPAROSCOPY,
        base=base,
        shapes=np.array(rows),
        warps=random_warps(rng, 100.0, 0.7),
        relief=random_relief(rng, 40.0, 0.5),
        spots=np.array([[0.0, 0.0, 0.0, 0.35 * size]]),
        seed=int(rng.integers(1 << 20)),
    )


def _organ(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    axes = log_uniform(rng, 8, 32) * np.exp(rng.normal(0, 0.35, 3))
    rotation = rotation_to(_flat_axis(rng), rng)
    return [
        shape_row(ELLIPSOID, _on_floor(rng, 100, rng.uniform(-4, 12)), rotation, tuple(axes), part=part, blend=blend)
    ]


def _lobe(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    """A lobe of the liver: broad, with a thin edge that hangs over what is below."""
    long, thick = rng.uniform(25, 60), log_uniform(rng, 2.5, 10)
    axis = np.array([*rng.normal(0, 0.35, 2), 1.0])
    rotation = np.roll(rotation_to(axis, rng), -1, axis=0)
    place = _on_floor(rng, 110, rng.uniform(3, 26))
    row = shape_row(ELLIPSOID, place, rotation, (long, long * rng.uniform(0.4, 0.9), thick), part=part, blend=blend)
    row[RELIEF] = rng.uniform(0.2, 0.7)
    return [row]


def _chain(points: np.ndarray, radii: np.ndarray, part: int) -> list[np.ndarray]:
    rows = []
    for start, end, r0, r1 in zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True):
        length = max(float(np.linalg.norm(end - start)), 1e-3)
        rows.append(shape_row(CONE, start, rotation_to(end - start), (length, r0, r1), part=part))
    return rows


def _loop(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    """A loop of bowel: a chain of swollen pieces winding over the floor."""
    radius, heading = log_uniform(rng, 4, 13), rng.uniform(0, 2 * np.pi)
    point, points, curving = _on_floor(rng, 90, radius * rng.uniform(0, 1.2)), [], rng.normal(0, 0.4)
    for _ in range(int(rng.integers(4, 8))):
        points.append(point.copy())
        heading += curving + rng.normal(0, 0.35)
        point += radius * 1.8 * np.array([np.cos(heading), np.sin(heading), rng.normal(0, 0.12)])
    radii = radius * rng.uniform(0.8, 1.15, len(points))
    rows = joined(_chain(np.array(points), radii, part), 0.25 * radius)
    rows[0][3] = blend
    return rows


def _ring(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    big = rng.uniform(10, 28)
    small, rotation = (
        big * rng.uniform(0.25, 0.6),
        np.roll(rotation_to(np.array([*rng.normal(0, 0.6, 2), 1.0])), -1, axis=0),
    )
    return [shape_row(TORUS, _on_floor(rng, 90, rng.uniform(-3, 9)), rotation, (big, small), part=part, blend=blend)]


def _tent(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    """Tissue pulled up to a peak: a cone that merges widely with the floor."""
    width, height = rng.uniform(5, 14), rng.uniform(15, 45)
    axis = np.array([*rng.normal(0, 0.3, 2), 1.0])
    row = shape_row(
        CONE, _on_floor(rng, 70, -5.0), rotation_to(axis), (height, width, log_uniform(rng, 0.5, 2.0)), part=part
    )
    row[3], row[RELIEF] = max(blend, rng.uniform(3, 14)), 0.5
    return [row]


def _flap(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    """A thin sheet standing up from the floor: mesentery, a cut edge, a fold of peritoneum."""
    long, high = rng.uniform(12, 40), rng.uniform(8, 26)
    along = _flat_axis(rng, 0.15)
    along /= np.linalg.norm(along)
    up = _UP + rng.normal(0, 0.45, 3)
    up -= along * (up @ along)
    up /= np.linalg.norm(up)
    rotation = np.stack([along, up, np.cross(along, up)])
    size = (long, high, log_uniform(rng, 0.5, 2.0), rng.uniform(0, 6.3))
    row = shape_row(SHEET, _on_floor(rng, 70, rng.uniform(-4, 8)), rotation, size, part=part, blend=blend)
    row[RELIEF] = 0.12
    return [waved(row, rng.uniform(0, 5), rng.uniform(7, 16))]


def _cord(rng: np.random.Generator, part: int, blend: float) -> list[np.ndarray]:
    """A strand, a ligament, a long gall bladder: a free capsule over the floor."""
    start = _on_floor(rng, 90, rng.uniform(0, 30))
    end = start + _flat_axis(rng, 0.5) * rng.uniform(20, 60)
    r0, r1 = log_uniform(rng, 1, 9), log_uniform(rng, 1, 9)
    middle = 0.5 * (start + end) + rng.normal(0, 5, 3)
    radii = np.array([r0, rng.uniform(0.8, 1.2) * 0.5 * (r0 + r1), r1])
    rows = joined(_chain(np.array([start, middle, end]), radii, part), 0.5 * min(r0, r1))
    rows[0][3] = blend
    return rows


def wall(rng: np.random.Generator) -> Scene:
    """Return a wall about 60 wide: flat, curved or stepped, with folds and lumps lying on it."""
    size = 60.0
    base = _floor(rng, size, log_uniform(rng, 0.1, 0.9))
    base[1] *= rng.choice([0.3, 1.0])
    if rng.random() < 0.35:
        base[18], base[19] = rng.normal(0, 8), size * log_uniform(rng, 0.01, 0.1)
        base[23] *= 0.6
    rows: list[np.ndarray] = []
    for _ in range(rng.poisson(2.2)):
        rows += _fold(rng) if rng.random() < 0.65 else _bump(rng)
    return Scene(
        kind=WALL,
        base=base,
        shapes=np.array(rows).reshape(-1, 25),
        warps=random_warps(rng, size, 0.8),
        relief=random_relief(rng, 24.0, 0.8),
        spots=np.array([[0.0, 0.0, 0.0, 0.25 * size]]),
        seed=int(rng.integers(1 << 20)),
    )


def _fold(rng: np.random.Generator) -> list[np.ndarray]:
    """A fold: a wavy sheet that stands in the wall, its crest out of it."""
    along = _flat_axis(rng, 0.05)
    along /= np.linalg.norm(along)
    up = _UP + rng.normal(0, 0.4, 3)
    up -= along * (up @ along)
    up /= np.linalg.norm(up)
    rotation = np.stack([along, up, np.cross(along, up)])
    size = (rng.uniform(15, 60), log_uniform(rng, 2, 11), log_uniform(rng, 0.5, 2.5), rng.uniform(0, 6.3))
    row = shape_row(SHEET, _on_floor(rng, 50, 0.0), rotation, size, blend=log_uniform(rng, 1.0, 9.0))
    row[RELIEF] = 0.3
    return [waved(row, rng.uniform(0, 4), rng.uniform(5, 15))]


def _bump(rng: np.random.Generator) -> list[np.ndarray]:
    radius, part = log_uniform(rng, 1.5, 9), int(rng.integers(0, 4))
    axes = tuple(radius * np.exp(rng.normal(0, 0.3, 3)))
    kind, sizes = (BOX, (*axes, 0.9 * min(axes))) if rng.random() < 0.15 else (ELLIPSOID, axes)
    place = _on_floor(rng, 50, rng.uniform(-0.5, 0.6) * radius)
    return [shape_row(kind, place, random_rotation(rng), sizes, part=part, blend=log_uniform(rng, 0.3, 4.0))]
