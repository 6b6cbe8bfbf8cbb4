"""A bundle adjustment of six keyframes with exact observations."""

from __future__ import annotations

import numpy as np

from scopemap.engine.geometry.se3 import inverse, se3_exp, transform
from scopemap.engine.mapping.bundle_problem import Observations, Points

FOCAL_PX = 150.0
KEYFRAMES, PER_KEYFRAME = 6, 80
LINE = np.column_stack([np.arange(KEYFRAMES - 1), np.arange(1, KEYFRAMES)])


def world(rng: np.random.Generator) -> tuple[np.ndarray, Points, Observations]:
    """True poses (camera from world), points with true depth, and their exact observations."""
    twists = [np.append(rng.normal(0, 0.02, 3), [1.5 * k, 0.6 * np.sin(k), 0.8 * k]) for k in range(KEYFRAMES)]
    T = np.stack([inverse(se3_exp(twist)) for twist in twists])
    T = T @ inverse(T[0])
    pixels = rng.uniform([-70, -54], [70, 54], (KEYFRAMES * PER_KEYFRAME, 2))
    rays = np.column_stack([pixels / FOCAL_PX, np.ones(len(pixels))])
    host = np.repeat(np.arange(KEYFRAMES), PER_KEYFRAME)
    depth_mm = rng.uniform(25, 60, len(host))
    seen = []
    for p, (h, ray, depth) in enumerate(zip(host, rays, depth_mm, strict=True)):
        for t in (h - 2, h - 1, h + 1, h + 2):
            if 0 <= t < KEYFRAMES:
                x = transform(T[t] @ inverse(T[h]), depth * ray)
                seen.append((p, t, *(FOCAL_PX * x[:2] / x[2])))
    table = np.array(seen)
    observations = Observations(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:])
    return T, Points(host, pixels, np.log(depth_mm), np.full(len(host), 0.1)), observations


def tracked(
    T: np.ndarray, rng: np.random.Generator, rotation_rad: float = 0.02, translation_mm: float = 0.8
) -> np.ndarray:
    """True poses with errors; the first is kept."""
    errors = [se3_exp(rng.normal(0, [rotation_rad] * 3 + [translation_mm] * 3)) for _ in T[1:]]
    return np.stack([T[0], *(error @ pose for error, pose in zip(errors, T[1:], strict=True))])
