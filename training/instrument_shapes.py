"""Random instruments as implicit shapes in the axes of the camera that sees them; 1 = the tissue's median distance.

Each kind is a few cones, boxes, balls and sheets: exact jaws do not matter, that there are many kinds of them does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from training.scene import log_uniform, random_rotation, rotation_to
from training.shapes import BOX, CONE, ELLIPSOID, PART, SHEET, shape_row, waved
from training.viewpoint import probe_rays

SHAFT, TIP, ACCENT, SOFT = 0, 1, 2, 3
_MOST_ROWS = 250
_LEAST_DISTANCE = 0.1


@dataclass
class Parts:
    """The rows of instruments, numbered from 1 in their column `PART`, and what each is made of.

    rows : (COLUMNS,) each. materials : (instrument, `SHAFT`, `TIP`, `ACCENT` or `SOFT`) of each row.
    """

    rows: list[np.ndarray] = field(default_factory=list)
    materials: list[tuple[int, int]] = field(default_factory=list)
    instrument: int = 0

    def add(self, row: np.ndarray, material: int) -> None:
        """Put a row in."""
        if len(self.rows) < _MOST_ROWS:
            row[PART] = len(self.rows) + 1
            self.rows.append(row)
            self.materials.append((self.instrument, material))

    def chain(self, points: np.ndarray, radii: np.ndarray, material: int) -> None:
        """Put cones along points (n, 3) in, of radii (n,) there."""
        for start, end, r0, r1 in zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True):
            length = max(float(np.linalg.norm(end - start)), 1e-4)
            self.add(shape_row(CONE, start, rotation_to(end - start), (length, r0, r1)), material)

    def ball(self, centre: np.ndarray, rotation: np.ndarray, axes: tuple[float, float, float], material: int) -> None:
        """Put an ellipsoid in."""
        self.add(shape_row(ELLIPSOID, centre, rotation, axes), material)

    def box(self, centre: np.ndarray, rotation: np.ndarray, sides: tuple[float, float, float], material: int) -> None:
        """Put a box of half sides in, its edges rounded by a third of the shortest."""
        self.add(shape_row(BOX, centre, rotation, (*sides, 0.35 * min(sides))), material)


@dataclass(frozen=True)
class Pose:
    """Where an instrument is: from `start` (3,), outside the picture, to `tip` (3,); `radius` of its shaft."""

    start: np.ndarray
    tip: np.ndarray
    radius: float

    @property
    def axis(self) -> np.ndarray:
        """Its direction, of length 1."""
        away = self.tip - self.start
        return away / np.linalg.norm(away)


def random_instruments(camera: np.ndarray, rng: np.random.Generator) -> Parts:
    """Return one to three instruments in the picture of a camera (7,), as in `Buffers.camera`."""
    parts = Parts()
    names = list(_KINDS)
    liking = np.array([share for share, _ in _KINDS.values()])
    for _ in range(int(rng.choice([1, 2, 3], p=[0.55, 0.33, 0.12]))):
        made = _KINDS[names[int(rng.choice(len(names), p=liking / liking.sum()))]][1]
        made(parts, camera, rng)
        parts.instrument += 1
    return parts


def _pose(camera: np.ndarray, rng: np.random.Generator, *, flexible: bool = False) -> Pose:
    """A pose from beyond the border of the picture; a flexible one comes from beside the lens."""
    rays = probe_rays(camera)
    rows, columns = rays.shape[:2]
    for _ in range(50):
        ray = rays[rng.integers(rows), rng.integers(columns)]
        tip = rng.uniform(0.4, 1.1) * ray
        angle = rng.uniform(0, 2 * np.pi)
        edge = np.array([np.cos(angle), np.sin(angle)])
        right, low = rays[rows // 2, -1], rays[-1, columns // 2]
        edge *= 1.4 / max(abs(edge[0] * right[2] / right[0]), abs(edge[1] * low[2] / low[1]))
        border = np.array([*edge, 1.0])
        near = log_uniform(rng, 0.14, 0.4) if flexible else log_uniform(rng, 0.25, 1.0)
        start = near * border / np.linalg.norm(border)
        thick = log_uniform(rng, 0.012, 0.07) if flexible else log_uniform(rng, 0.018, 0.14)
        radius = thick * float(np.linalg.norm(tip))
        start = start + 0.5 * (start - tip)
        axis, length = tip - start, float(np.linalg.norm(tip - start))
        nearest = np.linalg.norm(start + np.clip(-start @ axis / length**2, 0, 1) * axis)
        if nearest > 1.2 * radius + _LEAST_DISTANCE and length > 3 * radius:
            break
    return Pose(start, tip, radius)


def _shaft(parts: Parts, pose: Pose, rng: np.random.Generator) -> None:
    """A straight shaft, some with a collar or a step in their width."""
    radius = pose.radius
    parts.chain(np.array([pose.start, pose.tip]), np.array([radius, radius]), SHAFT)
    length = float(np.linalg.norm(pose.tip - pose.start))
    if rng.random() < 0.4:
        at = pose.tip - pose.axis * rng.uniform(0, 0.3) * length
        wide, long = radius * rng.uniform(1.03, 1.25), radius * rng.uniform(0.2, 3.0)
        parts.chain(np.array([at, at + pose.axis * long]), np.array([wide, wide]), ACCENT)


def _wrist(parts: Parts, pose: Pose, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """What joins jaws to the shaft: a taper, then perhaps a joint that bends. Returns where it ends and whither."""
    radius, axis, at = pose.radius, pose.axis, pose.tip
    after = at + axis * radius * rng.uniform(0.3, 1.6)
    parts.chain(np.array([at, after]), radius * np.array([rng.uniform(0.8, 1.0), rng.uniform(0.4, 0.8)]), TIP)
    for _ in range(int(rng.choice([0, 1, 2], p=[0.45, 0.35, 0.2]))):
        frame = rotation_to(axis, rng)
        bend = np.deg2rad(rng.uniform(0, 55))
        axis = np.cos(bend) * frame[0] + np.sin(bend) * frame[1]
        long, wide = radius * rng.uniform(0.6, 2.5), radius * rng.uniform(0.35, 0.75)
        if rng.random() < 0.5:
            frame = rotation_to(axis, rng)
            parts.box(after + 0.5 * long * axis, frame, (0.5 * long, wide, wide * rng.uniform(0.4, 1.0)), TIP)
        else:
            parts.chain(np.array([after, after + long * axis]), np.array([wide, 0.9 * wide]), TIP)
        if rng.random() < 0.6:
            bolt = wide * rng.uniform(0.3, 0.6)
            parts.ball(after + wide * frame[1] * 0.9, frame, (bolt, bolt, bolt), ACCENT if rng.random() < 0.4 else TIP)
        after = after + long * axis
    return after, axis


def _jaw(parts: Parts, root: np.ndarray, ways: tuple[np.ndarray, np.ndarray], size: float, style: int) -> None:
    """One jaw: 0 a curved and tapering rod, 1 a loop (fenestrated), 2 a flat blade, 3 a ribbed rod.

    ways : unit vectors (3,) ahead and aside, into which it curves.
    """
    ahead, aside = ways
    s = np.linspace(0, 1, 6)[:, None]
    points = root + size * (s * ahead + 0.25 * s * s * aside)
    if style == 1:
        across = np.cross(ahead, aside)
        turn = np.linspace(0, 2 * np.pi, 11)[:, None]
        round_ = root + size * ((0.5 - 0.5 * np.cos(turn)) * ahead + 0.17 * np.sin(turn) * across)
        parts.chain(round_, np.full(11, 0.05 * size), TIP)
    elif style == 2:
        frame = np.stack([ahead, aside, np.cross(ahead, aside)])
        parts.box(root + 0.5 * size * ahead, frame, (0.5 * size, 0.11 * size, 0.035 * size), TIP)
        parts.chain(points[3:], np.linspace(0.07, 0.02, 3) * size, TIP)
    else:
        first = len(parts.rows)
        parts.chain(points, np.linspace(0.14, 0.05, 6) * size, TIP)
        if style == 3:
            for row in parts.rows[first:]:
                waved(row, 0.02 * size, 0.08 * size)


def _forceps(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    pose = _pose(camera, rng)
    _shaft(parts, pose, rng)
    root, axis = _wrist(parts, pose, rng)
    frame = rotation_to(axis, rng)
    spread, size = np.deg2rad(rng.uniform(0, 50)), pose.radius * rng.uniform(2.0, 7.0)
    style, curl = int(rng.integers(4)), rng.choice([-1.0, 0.0, 1.0])
    for sign in (-1.0, 1.0):
        ahead = np.cos(spread) * frame[0] + sign * np.sin(spread) * frame[1]
        aside = (np.cos(spread) * frame[1] - sign * np.sin(spread) * frame[0]) * (curl or -sign)
        _jaw(parts, root + sign * 0.2 * pose.radius * frame[1], (ahead, aside), size, style)


def _hook(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """A shaft with a thin bent wire, a spatula or a ball: what cuts by current."""
    pose = _pose(camera, rng)
    _shaft(parts, pose, rng)
    frame, radius = rotation_to(pose.axis, rng), pose.radius
    bend, long = np.deg2rad(rng.uniform(0, 110)), radius * rng.uniform(1.0, 5.0)
    taper = pose.tip + pose.axis * radius * rng.uniform(0.2, 1.5)
    parts.chain(np.array([pose.tip, taper]), radius * np.array([1.0, rng.uniform(0.3, 0.7)]), ACCENT)
    corner = taper + long * frame[0]
    end = corner + radius * rng.uniform(0.5, 2.5) * (np.cos(bend) * frame[0] + np.sin(bend) * frame[1])
    wire = radius * rng.uniform(0.1, 0.3)
    parts.chain(np.array([taper, corner, end]), np.full(3, wire), TIP)
    if rng.random() < 0.3:
        parts.ball(end, frame, (2 * wire, 2 * wire, 2 * wire), TIP)


def _stapler(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    pose = _pose(camera, rng)
    _shaft(parts, pose, rng)
    frame, radius = rotation_to(pose.axis, rng), pose.radius
    long, gap = radius * rng.uniform(4, 10), np.deg2rad(rng.uniform(0, 18))
    for sign, material in ((-1.0, TIP), (1.0, ACCENT if rng.random() < 0.6 else TIP)):
        ahead = np.cos(gap) * frame[0] + sign * np.sin(gap) * frame[1]
        across = np.cross(frame[2], ahead)
        turned = np.stack([ahead, across, frame[2]])
        middle = pose.tip + 0.5 * long * ahead + sign * 0.35 * radius * across
        parts.box(middle, turned, (0.5 * long, 0.33 * radius, radius * rng.uniform(0.6, 0.95)), material)


def _tube(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """Suction, irrigation, a probe, a drain or a trocar: a rod, open or round at its end."""
    pose = _pose(camera, rng, flexible=rng.random() < 0.4)
    radius = pose.radius * rng.choice([1.0, rng.uniform(1.0, 2.2)])
    pose = Pose(pose.start, pose.tip, float(radius))
    if rng.random() < 0.35:
        _bent(parts, pose, rng)
    else:
        _shaft(parts, pose, rng)
    if rng.random() < 0.6:
        frame = rotation_to(pose.axis)
        disc = (0.5 * radius, 0.75 * radius, 0.75 * radius)
        parts.ball(pose.tip + 0.56 * radius * pose.axis, frame, disc, ACCENT)


def _bent(parts: Parts, pose: Pose, rng: np.random.Generator) -> None:
    """A flexible shaft: an arc from start to tip."""
    frame, away = rotation_to(pose.axis, rng), float(np.linalg.norm(pose.tip - pose.start))
    s = np.linspace(0, 1, 8)[:, None]
    sag = away * rng.uniform(-0.2, 0.2)
    points = pose.start + s * (pose.tip - pose.start) + 4 * sag * s * (1 - s) * frame[1]
    parts.chain(points, np.full(8, pose.radius), SHAFT)


def _snare(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """A tube with a wire loop, as for polyps."""
    pose = _pose(camera, rng, flexible=True)
    _bent(parts, pose, rng)
    frame, long = rotation_to(pose.axis, rng), pose.radius * rng.uniform(5, 22)
    wide, turn = rng.uniform(0.15, 0.5), np.linspace(0, 2 * np.pi, 17)[:, None]
    loop = pose.tip + long * ((0.5 - 0.5 * np.cos(turn)) * frame[0] + wide * np.sin(turn) * frame[1])
    parts.chain(loop, np.full(17, pose.radius * rng.uniform(0.1, 0.3)), TIP)


def _cups(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """Biopsy forceps: a tube with two cups."""
    pose = _pose(camera, rng, flexible=True)
    _bent(parts, pose, rng)
    radius, frame = pose.radius, rotation_to(pose.axis, rng)
    joint = pose.tip + radius * rng.uniform(0.5, 2.0) * frame[0]
    parts.chain(np.array([pose.tip, joint]), radius * np.array([0.9, 0.7]), TIP)
    spread, long = np.deg2rad(rng.uniform(0, 60)), radius * rng.uniform(1.0, 2.2)
    for sign in (-1.0, 1.0):
        ahead = np.cos(spread) * frame[0] + sign * np.sin(spread) * frame[1]
        turned = np.stack([ahead, np.cross(frame[2], ahead), frame[2]])
        parts.ball(joint + long * ahead, turned, (long, 0.35 * long, 0.7 * radius), TIP)


def _place(camera: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Somewhere in the picture, near the tissue."""
    rays = probe_rays(camera)
    ray: np.ndarray = rays[rng.integers(2, rays.shape[0] - 2), rng.integers(2, rays.shape[1] - 2)]
    return ray * rng.uniform(0.6, 1.0)


def _clips(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """One to four clips: two legs and what joins them."""
    place, size = _place(camera, rng), log_uniform(rng, 0.02, 0.09)
    for _ in range(int(rng.integers(1, 5))):
        frame, at = random_rotation(rng), place + rng.normal(0, 2.2 * size, 3)
        thick, gap = size * rng.uniform(0.06, 0.2), size * rng.uniform(0.05, 0.5)
        legs = np.array([[1, -gap / size, 0], [0, -0.2, 0], [0, 0.2, 0], [1, gap / size, 0]]) * size
        parts.chain(at + legs @ frame, np.full(4, thick), TIP)


def _needle(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """A curved needle with its thread; half of them are held by forceps."""
    place, bow, frame = _place(camera, rng), log_uniform(rng, 0.05, 0.2), random_rotation(rng)
    turn = np.linspace(0, np.deg2rad(rng.uniform(110, 210)), 10)[:, None]
    points = place + bow * (np.cos(turn) * frame[0] + np.sin(turn) * frame[1])
    thick = bow * rng.uniform(0.03, 0.1)
    parts.chain(points, thick * np.linspace(1.0, 0.3, 10), TIP)
    _strand(parts, points[0], 0.5 * thick, rng)
    if rng.random() < 0.5:
        _forceps(parts, camera, rng)


def _thread(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 3))):
        _strand(parts, _place(camera, rng), log_uniform(rng, 0.002, 0.009), rng)


def _strand(parts: Parts, start: np.ndarray, radius: float, rng: np.random.Generator) -> None:
    """A thread that winds at about one distance."""
    step, way = rng.uniform(0.03, 0.09), random_rotation(rng)[0] * [1, 1, 0.3]
    points, turning = [start], rng.normal(0, 0.4)
    for _ in range(int(rng.integers(6, 16))):
        turning += rng.normal(0, 0.3)
        c, s = np.cos(turning), np.sin(turning)
        way = np.array([c * way[0] - s * way[1], s * way[0] + c * way[1], way[2] + rng.normal(0, 0.1)])
        points.append(points[-1] + step * way / np.linalg.norm(way))
    parts.chain(np.array(points), np.full(len(points), radius), SOFT)


def _gauze(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """A swab: a waved cloth, or one that is rolled up."""
    place, size = _place(camera, rng), log_uniform(rng, 0.07, 0.35)
    rotation = random_rotation(rng)
    if rng.random() < 0.4:
        parts.ball(place, rotation, (size, size * rng.uniform(0.25, 0.6), size * rng.uniform(0.25, 0.6)), SOFT)
        return
    sides = (size, size * rng.uniform(0.5, 1.0), 0.05 * size, rng.uniform(0, 6.3))
    row = shape_row(SHEET, place, rotation, sides)
    parts.add(waved(row, size * rng.uniform(0.05, 0.25), size * rng.uniform(0.3, 0.8)), SOFT)


def _retractor(parts: Parts, camera: np.ndarray, rng: np.random.Generator) -> None:
    """A fan of rods."""
    pose = _pose(camera, rng)
    _shaft(parts, pose, rng)
    frame, rods = rotation_to(pose.axis, rng), int(rng.integers(2, 6))
    long, opening = pose.radius * rng.uniform(3, 9), np.deg2rad(rng.uniform(10, 60))
    for angle in np.linspace(-opening, opening, rods):
        end = pose.tip + long * (np.cos(angle) * frame[0] + np.sin(angle) * frame[1])
        parts.chain(np.array([pose.tip, end]), pose.radius * np.array([0.4, 0.3]), TIP)


_KINDS: dict[str, tuple[float, Callable[[Parts, np.ndarray, np.random.Generator], None]]] = {
    "forceps": (0.34, _forceps),
    "hook": (0.12, _hook),
    "tube": (0.14, _tube),
    "stapler": (0.07, _stapler),
    "snare": (0.07, _snare),
    "cups": (0.08, _cups),
    "clips": (0.05, _clips),
    "needle": (0.04, _needle),
    "thread": (0.02, _thread),
    "gauze": (0.04, _gauze),
    "retractor": (0.03, _retractor),
}
