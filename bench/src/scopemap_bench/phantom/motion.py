"""How the camera and the tissue move.

Generated paths are hand-like; poses are camera to world, mm, OpenCV axes. Tissue moves by a smooth displacement: at the
point p of space is that of the rest point p - u(p), with u a sum of plane waves and of bumps, unless a slit parts it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scopemap.engine.geometry.se3 import mean_near, se3, so3_exp
from scopemap_bench.phantom.slit import UNCUT, cut_until, opened, slit
from scopemap_bench.phantom.slit import in_grid as slits_in_grid
from scopemap_bench.phantom.slit import stretch as stretch_of

_SPEED_MM, _TURN_DEG = 0.45, 30.0
_CONTACT_TURN_DEG, _CONTACT_MM, _CONTACT_STEP_MM = 55.0, 4.0, 0.25
_SWAY_FRAMES = (90.0, 170.0)
_FIXED_POINT_STEPS = 40
_PUSH_MM, _PUSH_LENGTH_MM = 6.0, 110.0
_POKE_MM, _POKED_SHARE = 8.0, 0.2
_RISE_SHARE, _SWINGS, _DAMPING = 1 / 3, 2.0, 6.0
_RING_MM, _RING_WIDTH_MM, _RING_LENGTH_MM, _RING_FRAMES = 2.5, 90.0, 70.0, 60.0
_PULL_MM, _PULL_WIDTH_MM = 8.0, 12.0
_WIDE_LENGTH_MM = 500.0  # of the waves whose slope widens a lumen
# A pull and a cut are in proportion to the distance where it is smaller than this.
_FULL_FROM_MM = 50.0
# Another examination's path beside the first one's.
_ASIDE_MM, _ASIDE_SWAY_MM = 2.5, (2.5, 2.5, 2.0)
_ASIDE_DEG, _ASIDE_SWAY_DEG = np.array([5.0, 5.0, 20.0]), (5.0, 5.0, 8.0)
# Shares of a grasp's time at which the instrument takes hold, has pulled, and lets go.
_HOLDS, _PULLED, _LETS_GO = 0.25, 0.5, 0.75


def lumen_path(frames: int, loop: bool, seed: int, straight: bool = False) -> np.ndarray:
    """Return a hand-like path along a winding or straight tube, (frames, 4, 4): forward, or forward and back."""
    rng = np.random.default_rng((seed, 1))
    length = _SPEED_MM * max(frames - 1, 1) * (0.5 if loop else 1.0)
    progress = 0.5 * (1 - np.cos(_phase(frames))) if loop else np.linspace(0, 1, frames)
    stations = np.linspace(0, length, max(int(length * 2), 2))
    yaw, pitch = (np.radians(0 if straight else 28) * _wander(stations, rng, (120.0, 220.0)) for _ in range(2))
    heading = np.stack([np.sin(yaw), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], -1)
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    guide = np.cumsum(heading * (stations[1] - stations[0]), axis=0)
    guide -= guide[0]
    here = progress * length
    positions = np.stack([np.interp(here, stations, column) for column in guide.T], -1)
    positions += _sway(frames, loop, rng, (2.0, 2.0, 1.2))
    angles = np.stack([np.interp(here, stations, -pitch), np.interp(here, stations, yaw), 0 * here], -1)
    return _poses(positions, 0.8 * angles + np.radians(_sway(frames, loop, rng, (3.0, 3.0, 4.0))), loop)


def sweep_path(frames: int, loop: bool, seed: int) -> np.ndarray:
    """Return a hand-like path that sweeps sideways over a scene ahead of it, (frames, 4, 4)."""
    rng = np.random.default_rng((seed, 1))
    reach_mm = min(18.0, _SPEED_MM * max(frames - 1, 1) / (2 * np.pi))
    positions = _sway(frames, loop, rng, (reach_mm, reach_mm, 0.4 * reach_mm), frames_per_cycle=(220.0, 320.0))
    positions += _sway(frames, loop, rng, (1.0, 1.0, 1.0))
    look = np.stack([positions[:, 1] / 90.0, -positions[:, 0] / 90.0, np.zeros(frames)], -1)
    return _poses(positions, look + np.radians(_sway(frames, loop, rng, (3.0, 3.0, 4.0))), loop)


def straight_path(frames: int, along_mm: np.ndarray, seed: int) -> np.ndarray:
    """Return a hand-like path along a line, by `along_mm` (3,) in all, slow at both ends, (frames, 4, 4)."""
    rng = np.random.default_rng((seed, 1))
    share = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, frames))
    positions = share[:, None] * along_mm + _sway(frames, False, rng, (1.5, 1.5, 1.0))
    return _poses(positions, np.radians(_sway(frames, False, rng, (2.0, 2.0, 2.0))), False)


def turned(poses: np.ndarray, first: int, last: int, back: bool = False) -> np.ndarray:
    """Return poses (N, 4, 4) that turn by 30 degrees about their y axis over frames `first` to `last`, and stay so."""
    before = first - 1
    share = np.clip((np.arange(len(poses)) - before) / (last - before), 0.0, 1.0)
    angle = np.radians(-_TURN_DEG if back else _TURN_DEG) * 0.5 * (1 - np.cos(np.pi * share))
    return np.array(
        [pose @ se3(so3_exp(np.array([0, a, 0])), np.zeros(3)) for pose, a in zip(poses, angle, strict=True)]
    )


def touching(poses: np.ndarray, first: int, last: int, space_mm: Callable[[np.ndarray], float]) -> np.ndarray:
    """Return poses (N, 4, 4) that turn to the wall, come as close as 4 mm half way, and go back."""
    poses = poses.copy()
    middle = min((first + last) // 2, len(poses) - 1)
    aside = so3_exp(np.array([0, np.radians(_CONTACT_TURN_DEG), 0]))
    towards = poses[middle, :3, :3] @ aside[:, 2]
    reach = 0.0
    while space_mm(poses[middle, :3, 3] + (reach + _CONTACT_STEP_MM) * towards) > _CONTACT_MM:
        reach += _CONTACT_STEP_MM
    for index in range(first, min(last + 1, len(poses))):
        share = 0.5 - 0.5 * np.cos(2 * np.pi * (index - first + 1) / (last - first + 2))
        turn = so3_exp(np.array([0, share * np.radians(_CONTACT_TURN_DEG), 0]))
        poses[index, :3, 3] += share * reach * towards
        poses[index, :3, :3] = poses[index, :3, :3] @ turn
    return poses


def examined_again(poses: np.ndarray, number: int, seed: int) -> np.ndarray:
    """Return another path (N, 4, 4) along poses (N, 4, 4): up to 5 mm beside it, turned, and at another pace."""
    rng = np.random.default_rng((seed, 9, number))
    share = np.linspace(0, 1, len(poses))
    pace = np.interp(share, np.linspace(0, 1, 6), np.concatenate([[0.0], np.sort(rng.uniform(0, 1, 4)), [1.0]]))
    time = 0.5 * (share + pace) * (len(poses) - 1)
    before = np.minimum(time.astype(int), len(poses) - 2)
    along = np.array([mean_near(poses[k], [poses[k + 1]], [t - k]) for k, t in zip(before, time, strict=True)])
    aside_mm = rng.uniform(-_ASIDE_MM, _ASIDE_MM, 3) + _sway(len(poses), False, rng, _ASIDE_SWAY_MM)
    turn_deg = rng.uniform(-_ASIDE_DEG, _ASIDE_DEG, 3) + _sway(len(poses), False, rng, _ASIDE_SWAY_DEG)
    aside = [se3(so3_exp(w), t) for w, t in zip(np.radians(turn_deg), aside_mm, strict=True)]
    return np.asarray(along @ np.array(aside))


def _phase(frames: int) -> np.ndarray:
    """Angle 0 to 2 pi over a loop, whose last frame is its first."""
    return np.linspace(0, 2 * np.pi, frames)


def _wander(x: np.ndarray, rng: np.random.Generator, periods: tuple[float, float]) -> np.ndarray:
    """Sum of three waves of random period and phase, about -1..1, 0 at the start."""
    period, phase = rng.uniform(*periods, 3) / [1.0, 1.6, 2.6], rng.uniform(0, 2 * np.pi, 3)
    waves = np.sin(2 * np.pi * x[:, None] / period + phase) @ [0.55, 0.3, 0.15]
    return waves - waves[0]


def _sway(
    frames: int,
    loop: bool,
    rng: np.random.Generator,
    amplitudes: tuple[float, float, float],
    frames_per_cycle: tuple[float, float] = _SWAY_FRAMES,
) -> np.ndarray:
    """Low-frequency wandering (frames, 3); in a loop with whole numbers of cycles, so that it ends where it starts."""
    columns = []
    for amplitude in amplitudes:
        if loop:
            amplitude *= min(1.0, frames / frames_per_cycle[0])
            turns = np.maximum(np.round(frames / rng.uniform(*frames_per_cycle, 3) * [1.0, 1.6, 2.6]), 1)
            phase = rng.uniform(0, 2 * np.pi, 3)
            wave = np.sin(_phase(frames)[:, None] * turns + phase) @ [0.55, 0.3, 0.15]
            columns.append(amplitude * (wave - wave[0]))
        else:
            columns.append(amplitude * _wander(np.arange(frames), rng, frames_per_cycle))
    return np.stack(columns, -1)


def _poses(positions: np.ndarray, rotation_vectors: np.ndarray, loop: bool) -> np.ndarray:
    poses = np.array([se3(so3_exp(w), t) for w, t in zip(rotation_vectors, positions, strict=True)])
    return np.concatenate([poses[:-1], poses[:1]]) if loop else poses


@dataclass(frozen=True)
class Displacement:
    """The displacement of one instant.

    waves : (M, 7) float64, wave vector (rad/mm), amplitude (mm), phase (rad). bumps : (B, 7) float64, centre (mm),
    amplitude (mm), and the q (1/mm^2) of a displacement of exp(-q distance^2) of it. slits : (S, 20), as `UNCUT` has
    it, S at most 1, of the tissue before waves and bumps displace it.
    """

    waves: np.ndarray
    bumps: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    slits: np.ndarray = field(default_factory=UNCUT.copy)

    @property
    def stretch(self) -> float:
        """Upper bound of the slope from points to rest points."""
        waves = np.linalg.norm(self.waves[:, :3], axis=1) * np.linalg.norm(self.waves[:, 3:6], axis=1)
        # A bump is steepest at the distance sqrt(1 / 2q).
        bumps = np.sqrt(2 * self.bumps[:, 6] / np.e) * np.linalg.norm(self.bumps[:, 3:6], axis=1)
        return (1.0 + float(waves.sum() + bumps.sum())) * stretch_of(self.slits)

    def at(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement u (N, 3) in mm at points (N, 3) of space, without what slits do."""
        moved: np.ndarray = np.sin(points_mm @ self.waves[:, :3].T + self.waves[:, 6]) @ self.waves[:, 3:6]
        for bump in self.bumps:
            moved = moved + np.exp(-bump[6] * ((points_mm - bump[:3]) ** 2).sum(1))[:, None] * bump[3:6]
        return moved

    def move(self, rest_mm: np.ndarray) -> np.ndarray:
        """Return where rest points (N, 3) are now: the fixed point of p = q + u(p), to 1e-6 mm or better."""
        for cut in self.slits:
            rest_mm = opened(cut, np.ascontiguousarray(rest_mm, np.float64))
        points = rest_mm
        for _ in range(_FIXED_POINT_STEPS if len(self.waves) or len(self.bumps) else 0):
            points = rest_mm + self.at(points)
        return points

    def scaled(self, strength: float) -> Displacement:
        """Return the displacement with all amplitudes times `strength`."""
        factors = [1, 1, 1, strength, strength, strength, 1]
        return Displacement(self.waves * factors, self.bumps * factors)

    def in_grid(self, origin_mm: np.ndarray, voxel_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return waves (M, 7), bumps (B, 7) and slits (S, 20) for coordinates in voxels from `origin_mm`."""
        k, amplitude, phase = self.waves[:, :3], self.waves[:, 3:6], self.waves[:, 6:]
        waves = np.concatenate([k * voxel_mm, amplitude / voxel_mm, phase + (k @ origin_mm)[:, None]], axis=1)
        centre, poke, q = self.bumps[:, :3], self.bumps[:, 3:6], self.bumps[:, 6:]
        bumps = np.concatenate([(centre - origin_mm) / voxel_mm, poke / voxel_mm, q * voxel_mm**2], axis=1)
        return waves, bumps, slits_in_grid(self.slits, origin_mm, voxel_mm)


REST = Displacement(np.zeros((0, 7)))


@dataclass(frozen=True)
class Breathing:
    """A displacement at full breath; frame 0 and every `period_frames` frames are at rest."""

    full: Displacement
    period_frames: float

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        return self.full.scaled(0.5 - 0.5 * np.cos(2 * np.pi * time / self.period_frames))


@dataclass(frozen=True)
class Push:
    """A displacement that is 0 until the frame `first`, in full from `last` on.

    springs : it is in full after a third of that time, is let go, and swings back past its place to rest.
    """

    full: Displacement
    first: int
    last: int
    springs: bool = False

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        share = (time - self.first) / max(self.last - self.first, 1)
        if not self.springs:
            return self.full.scaled(_eased(share))
        let_go = (share - _RISE_SHARE) / (1 - _RISE_SHARE)
        return self.full.scaled(_eased(share / _RISE_SHARE) if let_go < 0 else _swing(let_go))


@dataclass(frozen=True)
class Contractions:
    """Rings of narrower and wider lumen that travel along an axis, from frame `first` to `last`: peristalsis.

    waves : (4, 7), those of `Displacement` at full strength. turn : (4,), which way the phase of each goes.
    """

    waves: np.ndarray
    turn: np.ndarray
    first: int
    last: int

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames; it grows for a fifth of the time, and fades for one."""
        share = (time - self.first) / max(self.last - self.first, 1)
        moved = self.waves.copy()
        moved[:, 6] += 2 * np.pi * (time - self.first) / _RING_FRAMES * self.turn
        return Displacement(moved).scaled(_eased(5 * min(share, 1 - share)))


@dataclass(frozen=True)
class Grasp:
    """Tissue at a rest point (3,) that an instrument holds, pulls by `pull_mm` (3,), and lets go, as `Push` springs.

    Its bump moves with the point, so that the tissue held stays at the tip of the instrument.
    """

    point_mm: np.ndarray
    pull_mm: np.ndarray
    width_mm: float
    first: int
    last: int

    @property
    def let_go(self) -> float:
        """Time, in frames, at which the instrument opens."""
        return self.first + _LETS_GO * max(self.last - self.first, 1)

    def holds(self, time: float) -> bool:
        """Return whether the instrument is closed at a time, in frames."""
        return self.first + _HOLDS * max(self.last - self.first, 1) <= time < self.let_go

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        share = (time - self.first) / max(self.last - self.first, 1)
        let_go = (share - _LETS_GO) / (1 - _LETS_GO)
        pulled = (_eased((share - _HOLDS) / (_PULLED - _HOLDS)) if let_go < 0 else _swing(let_go)) * self.pull_mm
        bump = np.concatenate([self.point_mm + pulled, pulled, [0.5 / self.width_mm**2]])
        return Displacement(REST.waves, bump[None])


@dataclass(frozen=True)
class Cut:
    """A slit (1, 20) that is cut from frame `first` to `last`, and gapes from then on."""

    slits: np.ndarray
    first: int
    last: int

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        share = np.clip((time - self.first) / max(self.last - self.first, 1), 0.0, 1.0)
        return Displacement(REST.waves, slits=cut_until(self.slits, float(share)))


def _eased(share: float) -> float:
    """Return 0 for shares of time below 0, 1 above 1, half a cosine between."""
    return float(0.5 - 0.5 * np.cos(np.pi * np.clip(share, 0.0, 1.0)))


def _swing(share: float) -> float:
    """Return what is left of a displacement of 1, let go at rest, at a share >= 0 of time: a damped oscillation."""
    angle = 2 * np.pi * _SWINGS * share
    return float(np.exp(-_DAMPING * share) * (np.cos(angle) + _DAMPING / (2 * np.pi * _SWINGS) * np.sin(angle)))


Part = Breathing | Push | Contractions | Grasp | Cut


@dataclass(frozen=True)
class TissueMotion:
    """All that moves the tissue; `always`: what does at any time."""

    parts: tuple[Part, ...]
    always: Displacement = REST

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        parts = [self.always, *(part.at(time) for part in self.parts)]
        return Displacement(
            *(np.concatenate([getattr(p, kind) for p in parts]) for kind in ("waves", "bumps", "slits"))
        )


def insufflated(share: float, T_world_camera: np.ndarray) -> Displacement:
    """Return tissue that is wider by a share, across the line of sight of a camera."""
    sides = 2 * np.pi / _WIDE_LENGTH_MM * T_world_camera[:3, :2].T
    waves = [np.concatenate([k, share * k / (k @ k), [-k @ T_world_camera[:3, 3]]]) for k in sides]
    return Displacement(np.array(waves))


def push(first: int, last: int, T_world_camera: np.ndarray, distance_mm: float, springs: bool = False) -> Push:
    """Return a push of the tissue `distance_mm` ahead of a camera: up on the left of its view, down on the right."""
    right, down, ahead = T_world_camera[:3, :3].T
    along = 2 * np.pi / _PUSH_LENGTH_MM * right
    middle = T_world_camera[:3, 3] + distance_mm * ahead
    wave = np.concatenate([along, _PUSH_MM * (0.8 * down - 0.6 * ahead), [-along @ middle]])
    return Push(Displacement(wave[None]), first, last, springs)


def contractions(first: int, last: int, T_world_camera: np.ndarray) -> Contractions:
    """Return contractions about the line of sight of a camera, which travel away from it."""
    right, down, ahead = T_world_camera[:3, :3].T
    along = 2 * np.pi / _RING_LENGTH_MM * ahead
    # Each pair adds up to -sin(across) cos(along - turn): to the axis where the cosine is positive.
    waves = []
    for side in (right, down):
        across = 2 * np.pi / _RING_WIDTH_MM * side
        waves += [[across + along, -0.5 * _RING_MM * side], [across - along, -0.5 * _RING_MM * side]]
    rows = [np.concatenate([*wave, [-wave[0] @ T_world_camera[:3, 3]]]) for wave in waves]
    return Contractions(np.array(rows), np.array([-1.0, 1.0, -1.0, 1.0]), first, last)


def grasp(first: int, last: int, point_mm: np.ndarray, direction: np.ndarray, distance_mm: float) -> Grasp:
    """Return a grasp of the tissue at a point (3,), seen from so far, pulled along a unit vector (3,)."""
    size = min(1.0, distance_mm / _FULL_FROM_MM)
    return Grasp(point_mm, size * _PULL_MM * direction, size * _PULL_WIDTH_MM, first, last)


def cut(first: int, last: int, point_mm: np.ndarray, across: np.ndarray, normal: np.ndarray, distance_mm: float) -> Cut:
    """Return a cut of the tissue at a point (3,), seen from so far, which opens along a unit vector (3,)."""
    return Cut(slit(point_mm, across, normal, min(1.0, distance_mm / _FULL_FROM_MM)), first, last)


def poke(first: int, last: int, point_mm: np.ndarray, direction: np.ndarray, distance_mm: float) -> Push:
    """Return a push of the tissue around a point (3,), seen from so far, along a unit vector (3,); the rest stays."""
    radius_mm = max(_POKED_SHARE * distance_mm, 2 * _POKE_MM)
    bump = np.concatenate([point_mm, _POKE_MM * direction, [0.5 / radius_mm**2]])
    return Push(Displacement(REST.waves, bump[None]), first, last)


def breathing(amplitude_mm: float, period_frames: float, seed: int) -> Breathing:
    """Return breathing of about `amplitude_mm` with wavelengths of 80 to 160 mm; `amplitude_mm` 0 is tissue at rest."""
    if amplitude_mm == 0:
        return Breathing(REST, period_frames)
    rng = np.random.default_rng((seed, 7))
    n = 3
    directions, amplitudes = rng.normal(size=(2, n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    amplitudes *= amplitude_mm / np.sqrt(n) / np.linalg.norm(amplitudes, axis=1, keepdims=True)
    wavelengths_mm = rng.uniform(80.0, 160.0, size=(n, 1))
    phases = rng.uniform(0, 2 * np.pi, size=(n, 1))
    waves = np.hstack([2 * np.pi / wavelengths_mm * directions, amplitudes, phases])
    return Breathing(Displacement(waves), period_frames)
