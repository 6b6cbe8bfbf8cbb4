"""A camera that turns and moves inside a mottled ball: quick to draw, with a focal length that is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.geometry.se3 import so3_exp

SIZE = (200, 160)
RADIUS_MM = 40.0


def focal_of(fov_deg: float, width: int = SIZE[0]) -> float:
    return float(width / 2 / np.tan(np.radians(fov_deg) / 2))


def write_clip(folder: Path, fov_deg: float, frames: int, turn_deg: float = 12.0, way_mm: float = 8.0) -> Path:
    """Images of a camera that sways by `turn_deg` and `way_mm` to either side within about 80 frames."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(60, 3)) * np.geomspace(0.1, 0.9, 60)[:, None]
    phases, colours = rng.uniform(0, 2 * np.pi, 60), rng.uniform(0.3, 1.0, (60, 3))
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    focal = focal_of(fov_deg)
    rays = np.stack([(u - (SIZE[0] - 1) / 2) / focal, (v - (SIZE[1] - 1) / 2) / focal, np.ones(u.shape)], -1)
    for index in range(frames):
        phase = 2 * np.pi * index / 80
        R = so3_exp(np.radians(turn_deg) * np.array([np.sin(phase), np.cos(phase) - 1, 0.3 * np.sin(2 * phase)]))
        place = way_mm * np.array([np.sin(1.3 * phase), 1 - np.cos(phase), 0.5 * np.sin(phase)])
        image = _drawn(rays @ R.T, place, waves, phases, colours)
        image = np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index:04d}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    return folder


def _drawn(
    rays: np.ndarray, place: np.ndarray, waves: np.ndarray, phases: np.ndarray, colours: np.ndarray
) -> np.ndarray:
    square, along = (rays**2).sum(-1), rays @ place
    far = (-along + np.sqrt(along**2 - square * (place @ place - RADIUS_MM**2))) / square
    point = place + far[..., None] * rays
    level = np.cos(point @ waves.T + phases) @ colours / np.sqrt(len(waves))
    return np.clip(120 + 45 * level * [1.0, 0.7, 0.6], 30, 230).astype(np.uint8)
