"""Tubes: the colon with its crescent folds and blind end, and the branching airway.

The numbers of a tube, `base`: 0 = 0; 1 radius; 2-4 and 5-7 share, wave number, phase of its variation; 8 depth of the
triangle that the taeniae make; 9-11 and 12-14 amplitude, wave number, phase of the winding; 15-16 angle of the first
taenia and its rotation per length; 17-18 stations of the blind ends; 19 mean fold distance; 20 rounding of the ends;
21-24 height, period, tilt and obliquity of the wrinkles; 25 fillet of the folds; 26 reach of the folds from the wall,
27 the margin in it. `bends` rows: start, radius, angle, cosine and sine of the plane, of the
angle and of half the angle. `folds` rows: station, height,
half thickness, taper, direction (cosine, sine), cosine of the half width, tilt, lean.
"""

from __future__ import annotations

import numpy as np

from training.scene import AIRWAY, COLON, Scene, log_uniform, random_relief, random_warps, rotation_to
from training.shapes import CONE, ELLIPSOID, RELIEF, bend_back, joined, shape_row, waved

_RADIUS = 20.0


def colon(rng: np.random.Generator) -> Scene:
    """Return a winding tube about 20 in radius with folds, wrinkles and polyps, closed at both ends."""
    base = np.zeros(30)
    base[1] = _RADIUS * rng.uniform(0.75, 1.3)
    base[2:5] = rng.uniform(0, 0.22), 2 * np.pi / rng.uniform(60, 250), rng.uniform(0, 6.3)
    base[5:8] = rng.uniform(0, 0.12), 2 * np.pi / rng.uniform(25, 60), rng.uniform(0, 6.3)
    base[8] = rng.choice([rng.uniform(0, 0.1), rng.uniform(0.1, 0.4)])
    for n in (9, 12):
        period = rng.uniform(60, 220)
        base[n : n + 3] = rng.uniform(0, 0.6) * period / (2 * np.pi), 2 * np.pi / period, rng.uniform(0, 6.3)
    base[15], base[16] = rng.uniform(0, 6.3), rng.normal(0, 0.006)
    base[17], base[18] = -rng.uniform(60, 120), rng.uniform(90, 280)
    base[20] = rng.uniform(4, 24)
    if rng.random() < 0.5:
        base[21], base[22] = log_uniform(rng, 0.08, 0.6), log_uniform(rng, 3.0, 9.0)
        base[23:25] = rng.normal(0, 2, 2)
    bends = _random_bends(rng, 1.0 * base[1])
    folds = _random_folds(rng, base)
    shapes = [row for _ in range(rng.poisson(1.1)) for row in _polyp(rng, base, bends)]
    if rng.random() < 0.4:
        shapes += _end_lump(rng, base, bends)
    return Scene(
        kind=COLON,
        base=base,
        bends=bends,
        folds=folds,
        shapes=np.array(shapes).reshape(-1, 25),
        warps=random_warps(rng, 60.0, 0.7),
        relief=random_relief(rng, 24.0, 0.8),
        seed=int(rng.integers(1 << 20)),
    )


def _random_bends(rng: np.random.Generator, radius: float) -> np.ndarray:
    """One to three circular bends along the tube; the inner side keeps a radius of its own."""
    rows, start = [], rng.uniform(-20, 30)
    for _ in range(int(rng.integers(1, 4))):
        bend = radius * log_uniform(rng, 1.6, 7.0)
        angle = min(rng.uniform(0.2, 1.9), 200.0 / bend)
        plane = rng.uniform(0, 2 * np.pi)
        cuts = np.cos(angle), np.sin(angle), np.cos(0.5 * angle), np.sin(0.5 * angle)
        rows.append([start, bend, angle, np.cos(plane), np.sin(plane), *cuts])
        start += bend * angle + rng.uniform(5, 60)
    return np.array(rows)


def _random_folds(rng: np.random.Generator, base: np.ndarray) -> np.ndarray:
    """Fold after fold, irregular in distance, height, width and side."""
    spacing = log_uniform(rng, 9.0, 38.0)
    base[19] = spacing
    count = int((base[18] - base[17]) / spacing) + 1
    highest = min(log_uniform(rng, 1.5, 11.0), 0.5 * base[1])
    thick, taper = log_uniform(rng, 0.5, 2.0), rng.uniform(0.05, 0.5)
    ringed, crescent = rng.random() < 0.25, rng.uniform(-0.75, 0.45)
    base[25] = log_uniform(rng, 0.8, 9.0)
    rows = np.zeros((count, 9))
    missing, lean = rng.uniform(0, 0.3), rng.normal(0, 0.25)
    side = rng.uniform(0, 2 * np.pi)
    for n in range(count):
        side += 2 * np.pi / 3 * rng.integers(0, 3) + rng.normal(0, 0.35)
        width = rng.uniform(-4.0, -1.2) if ringed and rng.random() < 0.8 else crescent + rng.uniform(-0.25, 0.25)
        height = 0.0 if rng.random() < missing else highest * rng.uniform(0.35, 1.0)
        station = base[17] + (n + 0.5 + rng.uniform(-0.38, 0.38)) * spacing
        tilt = rng.normal(0, 0.12) * spacing
        rows[n] = (station, height, thick, taper, np.cos(side), np.sin(side), min(width, 0.7), tilt, lean)
    base[27] = 0.15 * highest + 0.5
    base[26] = highest + base[27] + 0.3 * base[25]
    return rows


def wall_point(base: np.ndarray, bends: np.ndarray, at: tuple[float, float, float]) -> np.ndarray:
    """Return the scene point (3,) at station u, angle, and share of the radius from the centre line."""
    u, angle, share = at
    r = share * base[1] * (1 - 0.5 * base[8])
    dv = base[9] * np.sin(base[10] * u + base[11])
    dw = base[12] * np.sin(base[13] * u + base[14])
    return np.array(bend_back(bends, u, dv + r * np.cos(angle), dw + r * np.sin(angle)))


def _polyp(rng: np.random.Generator, base: np.ndarray, bends: np.ndarray) -> list[np.ndarray]:
    u, angle = rng.uniform(base[17] + 20, base[18]), rng.uniform(0, 2 * np.pi)
    inward = wall_point(base, bends, (u, angle, 0.5)) - wall_point(base, bends, (u, angle, 1.0))
    root = wall_point(base, bends, (u, angle, rng.uniform(0.92, 1.08)))
    rotation, radius, part = rotation_to(inward, rng), log_uniform(rng, 1.0, 6.0), int(rng.integers(0, 4))
    inward = rotation[0]
    if rng.random() < 0.3:
        length = radius * rng.uniform(1.0, 2.5)
        stalk = shape_row(CONE, root, rotation, (length, 0.6 * radius, 0.35 * radius), blend=2.0, part=part)
        head = (radius, *(radius * rng.uniform(0.8, 1.2, 2)))
        return joined([stalk, shape_row(ELLIPSOID, root + inward * length, rotation, head, part=part)], 0.8)
    head = (radius * rng.uniform(0.4, 1.3), *(radius * rng.uniform(0.7, 1.3, 2)))
    lump = shape_row(ELLIPSOID, root, rotation, head, blend=log_uniform(rng, 0.4, 4.0), part=part)
    return [lump]


def _end_lump(rng: np.random.Generator, base: np.ndarray, bends: np.ndarray) -> list[np.ndarray]:
    """At the blind end: the lips of the valve and folds that meet, as in a caecum."""
    rows = []
    for _ in range(int(rng.integers(1, 4))):
        place = wall_point(base, bends, (base[18] - rng.uniform(-2, 14), rng.uniform(0, 6.3), rng.uniform(0, 0.9)))
        radius = log_uniform(rng, 2.0, 8.0)
        length, thin = radius * rng.uniform(0.8, 2.2), radius * rng.uniform(0.3, 0.9)
        rotation = rotation_to(rng.normal(size=3), rng)
        rows.append(shape_row(ELLIPSOID, place, rotation, (length, radius, thin), blend=log_uniform(rng, 1.0, 8.0)))
    return rows


def airway(rng: np.random.Generator) -> Scene:
    """Return a trunk about 12 in radius that forks once to three times, with rings of cartilage."""
    trunk, ring = rng.uniform(9, 14), rng.choice([0.0, log_uniform(rng, 0.15, 1.1)])
    period, blend = rng.uniform(4, 9), log_uniform(rng, 1.0, 6.0)
    rows: list[np.ndarray] = []
    spots: list[np.ndarray] = []

    def tube(start: np.ndarray, axis: np.ndarray, radius: float, depth: int) -> None:
        length = radius * (rng.uniform(5, 9) if depth == 0 else rng.uniform(2.5, 5.5))
        ahead = 1.1 * radius * (depth < 3)
        thin = radius * rng.uniform(0.8, 1.05)
        row = shape_row(CONE, start, rotation_to(axis, rng), (length, radius, thin), solid=False, part=depth % 2)
        rows.append(waved(row, ring * radius / trunk, period * radius / trunk) if ring else row)
        for s in (0.15, 0.4, 0.65, 0.9):
            spots.append(np.array([*(start + s * length * axis), 0.6 * radius]))
        if depth < 3 and (depth == 0 or rng.random() < 0.75):
            for sign in (-1, 1) if rng.random() < 0.8 else (-1, 0.2, 1):
                tube(
                    start + axis * (length - 0.2 * ahead),
                    _fork(rng, axis, sign),
                    thin * rng.uniform(0.55, 0.9),
                    depth + 1,
                )

    tube(np.zeros(3), np.array([1.0, 0.0, 0.0]), trunk, 0)
    lumps = [_airway_lump(rng, spots) for _ in range(rng.poisson(0.4))]
    return Scene(
        kind=AIRWAY,
        base=np.array([2.0]),
        shapes=np.array(joined(rows, blend) + lumps),
        warps=random_warps(rng, 60.0, 0.7),
        relief=random_relief(rng, 12.0, 0.6),
        spots=np.array(spots),
        seed=int(rng.integers(1 << 20)),
    )


def _fork(rng: np.random.Generator, axis: np.ndarray, sign: float) -> np.ndarray:
    """Direction of a branch: to one side of the axis by 15 to 50 degrees, in nearly the same plane as its sister."""
    side = np.cross(axis, [0.1, 0.3, 0.95])
    turned = axis + sign * np.tan(rng.uniform(0.27, 0.9)) * side / np.linalg.norm(side) + rng.normal(0, 0.12, 3)
    return turned / np.linalg.norm(turned)


def _airway_lump(rng: np.random.Generator, spots: list[np.ndarray]) -> np.ndarray:
    spot = spots[int(rng.integers(len(spots)))]
    away = rng.normal(size=3)
    away /= np.linalg.norm(away)
    row = shape_row(
        ELLIPSOID,
        spot[:3] + away * 1.6 * spot[3],
        rotation_to(away, rng),
        tuple(spot[3] * rng.uniform(0.2, 0.8, 3)),
        part=3,
    )
    row[RELIEF] = rng.uniform(0.3, 1.0)
    return row
