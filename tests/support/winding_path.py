"""Paths at any times, of which one tells an offset of clocks and the other does not."""

from __future__ import annotations

import numpy as np

from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.input.trajectory.trajectory import Trajectory
from tests.support.sample_trajectories import as_trajectory

SCALE, TURN = 0.4, so3_exp(np.array([0.3, -0.5, 0.8]))


def winding(times_s: np.ndarray) -> Trajectory:
    """A hand-held path whose speed changes, at any times, s."""
    poses = []
    for t in times_s:
        at = [10 * np.sin(2.1 * t), 6 * np.cos(1.3 * t), 5 * t + 2 * np.sin(1.5 * t)]
        poses.append(se3(so3_exp(np.array([0.3 * np.sin(1.5 * t), 0.2 * np.cos(2 * t), 0.2 * t])), np.array(at)))
    return as_trajectory(np.stack(poses))


def seen(times_s: np.ndarray, noise_mm: float = 0.0) -> Trajectory:
    """The same in another world and size, with noise of the positions, mm of the truth."""
    poses = winding(times_s).T_world_camera.copy()
    poses[:, :3, 3] += np.random.default_rng(0).normal(0, noise_mm or 1e-12, (len(poses), 3))
    poses[:, :3, 3] = SCALE * poses[:, :3, 3] @ TURN.T + [5, -3, 2]
    poses[:, :3, :3] = TURN @ poses[:, :3, :3]
    return as_trajectory(poses)


def straight(times_s: np.ndarray, noise_mm: float = 0.0, seed: int = 1) -> Trajectory:
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, 2, 3] = 12 * times_s
    poses[:, :3, 3] += np.random.default_rng(seed).normal(0, noise_mm or 1e-12, (len(times_s), 3))
    return as_trajectory(poses)
