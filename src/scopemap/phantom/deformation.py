"""Deformation: tissue that breathes or is pushed, as a smooth displacement with bounded gradient.

The tissue at the point p of space is that of the rest point p - u(p), with u a sum of plane waves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_FIXED_POINT_STEPS = 40
_PUSH_MM = 6.0
_PUSH_LENGTH_MM = 110.0


@dataclass(frozen=True)
class Displacement:
    """The displacement of one instant: `waves` (M, 7) float64, wave vector (rad/mm), amplitude (mm), phase (rad)."""

    waves: np.ndarray

    @property
    def stretch(self) -> float:
        """Upper bound of the slope of p -> p - u(p)."""
        return 1.0 + float(
            (np.linalg.norm(self.waves[:, :3], axis=1) * np.linalg.norm(self.waves[:, 3:6], axis=1)).sum()
        )

    def at(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement u (N, 3) in mm at points (N, 3) of space."""
        return np.sin(points_mm @ self.waves[:, :3].T + self.waves[:, 6]) @ self.waves[:, 3:6]

    def move(self, rest_mm: np.ndarray) -> np.ndarray:
        """Return where rest points (N, 3) are now: the fixed point of p = q + u(p), to 1e-6 mm or better."""
        points = rest_mm
        for _ in range(_FIXED_POINT_STEPS if len(self.waves) else 0):
            points = rest_mm + self.at(points)
        return points

    def in_grid(self, origin_mm: np.ndarray, voxel_mm: float) -> np.ndarray:
        """Return the waves (M, 7) for coordinates in voxels from `origin_mm`."""
        k, amplitude, phase = self.waves[:, :3], self.waves[:, 3:6], self.waves[:, 6:]
        return np.concatenate([k * voxel_mm, amplitude / voxel_mm, phase + (k @ origin_mm)[:, None]], axis=1)


REST = Displacement(np.zeros((0, 7)))


@dataclass(frozen=True)
class Breathing:
    """Waves (M, 7) as in `Displacement`, at full breath; frame 0 and every `period_frames` frames are at rest."""

    waves: np.ndarray
    period_frames: float

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        return _scaled(self.waves, 0.5 - 0.5 * np.cos(2 * np.pi * time / self.period_frames))


@dataclass(frozen=True)
class Push:
    """Waves (M, 7) as in `Displacement`, from rest at the frame `first` to their full amplitude at `last`."""

    waves: np.ndarray
    first: int
    last: int

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        share = np.clip((time - self.first) / max(self.last - self.first, 1), 0.0, 1.0)
        return _scaled(self.waves, 0.5 - 0.5 * np.cos(np.pi * share))


@dataclass(frozen=True)
class TissueMotion:
    """All that moves the tissue."""

    parts: tuple[Breathing | Push, ...]

    def at(self, time: float) -> Displacement:
        """Return the displacement at a time, in frames."""
        return Displacement(np.concatenate([REST.waves, *(part.at(time).waves for part in self.parts)]))


def _scaled(waves: np.ndarray, strength: float) -> Displacement:
    return Displacement(waves * [1, 1, 1, strength, strength, strength, 1])


def push(first: int, last: int, T_world_camera: np.ndarray, distance_mm: float) -> Push:
    """Return a push of the tissue `distance_mm` ahead of a camera: up on the left of its view, down on the right."""
    right, down, ahead = T_world_camera[:3, :3].T
    along = 2 * np.pi / _PUSH_LENGTH_MM * right
    middle = T_world_camera[:3, 3] + distance_mm * ahead
    wave = np.concatenate([along, _PUSH_MM * (0.8 * down - 0.6 * ahead), [-along @ middle]])
    return Push(wave[None], first, last)


def breathing(amplitude_mm: float, period_frames: float, seed: int) -> Breathing:
    """Return breathing of about `amplitude_mm` with wavelengths of 80 to 160 mm; `amplitude_mm` 0 is tissue at rest."""
    if amplitude_mm == 0:
        return Breathing(REST.waves, period_frames)
    rng = np.random.default_rng((seed, 7))
    n = 3
    directions, amplitudes = rng.normal(size=(2, n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    amplitudes *= amplitude_mm / np.sqrt(n) / np.linalg.norm(amplitudes, axis=1, keepdims=True)
    wavelengths_mm = rng.uniform(80.0, 160.0, size=(n, 1))
    phases = rng.uniform(0, 2 * np.pi, size=(n, 1))
    return Breathing(np.hstack([2 * np.pi / wavelengths_mm * directions, amplitudes, phases]), period_frames)
