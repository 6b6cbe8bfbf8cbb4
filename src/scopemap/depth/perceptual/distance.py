"""The contract of perceptual distances between two images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class PerceptualResult:
    """How different two images look.

    Attributes
    ----------
    map : (H, W) float32 >= 0, the distance around each pixel; 0 = alike.
    score : the distance of the whole images, the mean of `map`.
    """

    map: np.ndarray
    score: float


class PerceptualDistance(Protocol):
    """Distance between two images as people see them."""

    name: str

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        """Compare two (H, W, 3) uint8 images of one size; the order does not matter."""
        ...

    def provenance(self) -> dict[str, str]:
        """Return what the result depends on, as text: names, versions, hashes."""
        ...
