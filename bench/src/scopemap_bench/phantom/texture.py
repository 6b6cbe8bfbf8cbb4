"""Appearance of tissue: mottled albedo, vessels, and the fluid film that breaks up highlights.

All are functions of the rest point, so that they move with the tissue, and fade where a pixel is too coarse for them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scopemap_bench.phantom.cavity import Tint
from scopemap_bench.phantom.volume import noise_at

_MOTTLES = ((22.0, 0.22), (8.0, 0.16), (3.0, 0.14), (1.2, 0.14))
_VESSEL_COLOUR = np.array([0.80, 0.42, 0.50], np.float32)
# Lattice spacing mm, width mm, depth of colour.
_VESSELS = ((17.0, 0.45, 0.75), (8.0, 0.22, 0.55))
_RIPPLE_MM = 1.9
_PUDDLE_MM = 14.0


@dataclass(frozen=True)
class Appearance:
    """Appearance of a scene's tissue.

    base : colour of all tissue, linear RGB (3,), or the colours in space.
    texture, gloss : strength of mottling and vessels, and of highlights; 0 = none. seed : of the pattern.
    """

    base: np.ndarray | Tint
    texture: float
    gloss: float
    seed: int

    def albedo(self, rest_mm: np.ndarray, footprint_mm: np.ndarray) -> np.ndarray:
        """Return linear RGB (H, W, 3) float32, 0..1, at rest points (H, W, 3) seen by pixels that wide (H, W)."""
        footprint = np.nan_to_num(footprint_mm, nan=1.0)
        colour = self.base.at(rest_mm) if isinstance(self.base, Tint) else self.base.astype(np.float32)
        if self.texture > 0:
            colour = colour * self._mottling(rest_mm, footprint) * self._vessels(rest_mm, footprint)
        return np.minimum(np.broadcast_to(colour, rest_mm.shape), 1.0)

    def ripple(self, rest_mm: np.ndarray, footprint_mm: np.ndarray) -> np.ndarray:
        """Return the tilt (H, W, 3) float32, about -1..1, of the fluid film; zero without gloss."""
        if self.gloss == 0:
            return np.zeros(rest_mm.shape, np.float32)
        axes = [noise_at(rest_mm, _RIPPLE_MM, self.seed + 41 + n) for n in range(3)]
        return np.stack(axes, -1) * _visible(_RIPPLE_MM, np.nan_to_num(footprint_mm, nan=1.0))[..., None]

    def film(self, rest_mm: np.ndarray) -> np.ndarray:
        """Return the strength (H, W) float32, >= 0, of specular reflection: larger in wet places, never 0."""
        wetness = 0.5 + 1.6 * noise_at(rest_mm, _PUDDLE_MM, self.seed + 45)
        return (self.gloss * np.clip(wetness, 0.05, 1.0)).astype(np.float32)

    def _mottling(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        brightness = sum(
            strength * _visible(period, footprint) * noise_at(points, period, self.seed + 31 + n)
            for n, (period, strength) in enumerate(_MOTTLES)
        )
        redness = noise_at(points, 12.0, self.seed + 36)
        tone = np.array([0.02, -0.22, -0.18], np.float32)
        return np.exp(self.texture * (brightness[..., None] + redness[..., None] * tone)).astype(np.float32)

    def _vessels(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Vessels run along the zero crossings of smooth noise; a second noise selects where."""
        stain = np.zeros(footprint.shape, np.float32)
        for n, (period, width, depth) in enumerate(_VESSELS):
            bent = points + 0.9 * noise_at(points, period / 3, self.seed + 51 + n)[..., None]
            away_mm = np.abs(noise_at(bent, period, self.seed + 53 + n)) * period / 1.6
            wide = np.hypot(width, 0.7 * footprint)
            there = np.clip(2.2 * noise_at(points, 1.7 * period, self.seed + 55 + n) + 0.25, 0, 1)
            stain += depth * there * (width / wide) * np.exp(-((away_mm / wide) ** 2))
        return _VESSEL_COLOUR ** (self.texture * stain[..., None])


def _visible(period_mm: float, footprint_mm: np.ndarray) -> np.ndarray:
    """Share (0..1) of a pattern's contrast that pixels of this width resolve."""
    return np.clip(period_mm / (2.0 * footprint_mm) - 0.5, 0.0, 1.0).astype(np.float32)
