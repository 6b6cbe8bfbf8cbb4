"""Generated camera paths that move like a hand. Poses are camera to world, mm, OpenCV axes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scopemap.geometry.se3 import se3, so3_exp

_SPEED_MM = 0.45
_TURN_DEG = 30.0
_CONTACT_TURN_DEG = 55.0
_CONTACT_MM = 4.0
_CONTACT_STEP_MM = 0.25
_SWAY_FRAMES = (90.0, 170.0)


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


def turned(poses: np.ndarray, first: int, last: int, back: bool = False) -> np.ndarray:
    """Return poses (N, 4, 4) that turn by 30 degrees about their y axis over frames `first` to `last`, and stay so."""
    before = first - 1
    share = np.clip((np.arange(len(poses)) - before) / (last - before), 0.0, 1.0)
    angle = np.radians(-_TURN_DEG if back else _TURN_DEG) * 0.5 * (1 - np.cos(np.pi * share))
    return np.array(
        [pose @ se3(so3_exp(np.array([0, a, 0])), np.zeros(3)) for pose, a in zip(poses, angle, strict=True)]
    )


def touching(poses: np.ndarray, first: int, last: int, space_mm: Callable[[np.ndarray], float]) -> np.ndarray:
    """Return poses (N, 4, 4) that turn to the wall, come as close as 4 mm half way from `first` to `last`, and go back.

    space_mm : free space, mm, around a point (3,); the camera stops where less than 4 mm are left.
    """
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
