"""Deformation: tissue that breathes or is pushed, as a smooth displacement with bounded gradient.

The tissue at the point p of space is that of the rest point p - u(p), with u a sum of plane waves and of bumps.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

_FIXED_POINT_STEPS = 40
_PUSH_MM = 6.0
_POKE_MM, _POKED_SHARE = 8.0, 0.2
_PUSH_LENGTH_MM = 110.0


@dataclass(frozen=True)
class Displacement:
    """The displacement of one instant.

    waves : (M, 7) float64, wave vector (rad/mm), amplitude (mm), phase (rad). bumps : (B, 7) float64, centre (mm),
    amplitude (mm), and the q (1/mm^2) of a displacement of exp(-q distance^2) of it.
    """

    waves: np.ndarray
    bumps: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))

    @property
    def stretch(self) -> float:
        """Upper bound of the slope of p -> p - u(p)."""
        waves = np.linalg.norm(self.waves[:, :3], axis=1) * np.linalg.norm(self.waves[:, 3:6], axis=1)
        # A bump is steepest at the distance sqrt(1 / 2q).
        bumps = np.sqrt(2 * self.bumps[:, 6] / np.e) * np.linalg.norm(self.bumps[:, 3:6], axis=1)
        return 1.0 + float(waves.sum() + bumps.sum())

    def at(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement u (N, 3) in mm at points (N, 3) of space."""
        moved: np.ndarray = np.sin(points_mm @ self.waves[:, :3].T + self.waves[:, 6]) @ self.waves[:, 3:6]
        for bump in self.bumps:
            moved = moved + np.exp(-bump[6] * ((points_mm - bump[:3]) ** 2).sum(1))[:, None] * bump[3:6]
        return moved

    def move(self, rest_mm: np.ndarray) -> np.ndarray:
        """Return where rest points (N, 3) are now: the fixed point of p = q + u(p), to 1e-6 mm or better."""
        points = rest_mm
        for _ in range(_FIXED_POINT_STEPS if len(self.waves) or len(self.bumps) else 0):
            points = rest_mm + self.at(points)
        return points

    def scaled(self, strength: float) -> Displacement:
        """Return the displacement with all amplitudes times `strength`."""
        factors = [1, 1, 1, strength, strength, strength, 1]
        return Displacement(self.waves * factors, self.bumps * factors)

    def in_grid(self, origin_mm: np.ndarray, voxel_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the waves (M, 7) and the bumps (B, 7) for coordinates in voxels from `origin_mm`."""
        k, amplitude, phase = self.waves[:, :3], self.waves[:, 3:6], self.waves[:, 6:]
        waves = np.concatenate([k * voxel_mm, amplitude / voxel_mm, phase + (k @ origin_mm)[:, None]], axis=1)
        centre, poke, q = self.bumps[:, :3], self.bumps[:, 3:6], self.bumps[:, 6:]
        return waves, np.concatenate([(centre - origin_mm) / voxel_mm, poke / voxel_mm, q * voxel_mm**2], axis=1)


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
    """A displacement that is 0 until the frame `first`, in full from `last` on."""

    full: Displacement
    first: int
    last: int

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        share = np.clip((time - self.first) / max(self.last - self.first, 1), 0.0, 1.0)
        return self.full.scaled(0.5 - 0.5 * np.cos(np.pi * share))


@dataclass(frozen=True)
class TissueMotion:
    """All that moves the tissue."""

    parts: tuple[Breathing | Push, ...]

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        parts = [REST, *(part.at(time) for part in self.parts)]
        return Displacement(np.concatenate([p.waves for p in parts]), np.concatenate([p.bumps for p in parts]))


def push(first: int, last: int, T_world_camera: np.ndarray, distance_mm: float) -> Push:
    """Return a push of the tissue `distance_mm` ahead of a camera: up on the left of its view, down on the right."""
    right, down, ahead = T_world_camera[:3, :3].T
    along = 2 * np.pi / _PUSH_LENGTH_MM * right
    middle = T_world_camera[:3, 3] + distance_mm * ahead
    wave = np.concatenate([along, _PUSH_MM * (0.8 * down - 0.6 * ahead), [-along @ middle]])
    return Push(Displacement(wave[None]), first, last)


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
