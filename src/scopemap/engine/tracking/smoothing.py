"""WEMA: the weighted mean of the last poses, on the group.

Equation 13 of arXiv 2508.11282: x_reg = s (alpha x_i + beta x_{i-1} + gamma x_{i-2}) + (1 - s) x_i, s = 1 -
exp(-i omega). Poses do not add: the mean is taken in the tangent space at the newest pose. The earlier poses are the
estimated ones, and the tracker does not use the smoothed ones. The mean lags behind a moving camera (BENCHMARK.md).
"""

from __future__ import annotations

import numpy as np

from scopemap.engine.config import SmoothingSettings
from scopemap.engine.geometry.se3 import mean_near

WEIGHTS = (0.6, 0.3, 0.1)  # plausible, not searched; the paper gives none: alpha, beta and gamma
OMEGA = 0.1  # plausible, not searched; the paper gives none: frames count from 0


class Wema:
    """Weighted exponential moving average of three poses (equation 13); no effect where `settings.method` is "none"."""

    def __init__(self, settings: SmoothingSettings) -> None:
        self.settings, self._count = settings, 0
        self._past = list[np.ndarray]()

    def __call__(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the smoothed pose; the first two, also after `reset`, have too short a past and stay as they are."""
        settings, past = self.settings, self._past
        smoothed = T_world_camera
        if len(past) == 2 and settings.method != "none":
            s = 1.0 - np.exp(-self._count * OMEGA) if settings.dynamic else 1.0
            weights = [s * weight for weight in WEIGHTS]
            # What is left, 1 - s, is the newest pose's too: it is the base of the tangent space.
            smoothed = mean_near(T_world_camera, [T_world_camera, past[1], past[0]], weights)
        self._past = [*past, T_world_camera][-2:]
        self._count += 1
        return smoothed

    def reset(self) -> None:
        """Let the next pose start without a past; s goes on growing."""
        self._past = []
