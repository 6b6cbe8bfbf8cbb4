"""Deformation: breathing tissue, as a smooth periodic displacement with bounded gradient.

The tissue at the point p of space is that of the rest point p - u(p), with u a sum of plane waves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_FIXED_POINT_STEPS = 40


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
        strength = 0.5 - 0.5 * np.cos(2 * np.pi * time / self.period_frames)
        return Displacement(self.waves * [1, 1, 1, strength, strength, strength, 1])


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
