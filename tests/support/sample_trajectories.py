"""A trajectory and its noisy estimate in closed form (60 frames at 30 per s, mm), and folders that hold such things."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.geometry.se3 import se3, se3_exp, so3_exp
from scopemap.input.trajectory.trajectory import Trajectory, write_tum


def write_run(folder: Path, trajectory: Trajectory) -> Path:
    """Write the files of a run's folder that tell of its poses."""
    folder.mkdir(exist_ok=True)
    write_tum(folder / "trajectory.tum", trajectory)
    rows = zip(trajectory.indices, trajectory.times_s, trajectory.status, strict=True)
    lines = [f"{index},{time_s:.6f},{status},0.9" for index, time_s, status in rows]
    (folder / "frames.csv").write_text("\n".join(["index,time_s,status,inliers", *lines]) + "\n")
    return folder


def write_c3vd(folder: Path, poses: np.ndarray, digits: int = 12) -> Path:
    """Write `pose.txt` as C3VD stores it: transposed, comma-separated."""
    folder.mkdir(exist_ok=True)
    (folder / "pose.txt").write_text("".join(",".join(f"{x:.{digits}g}" for x in T.T.ravel()) + "\n" for T in poses))
    return folder


def as_trajectory(poses: np.ndarray, lost: tuple[int, ...] = ()) -> Trajectory:
    """Return poses (N, 4, 4) as frames 0..N-1, those in `lost` lost."""
    indices = np.arange(len(poses))
    status = np.array(["initial"] + ["ok"] * (len(poses) - 1))
    status[list(lost)] = "lost"
    return Trajectory(indices, indices / 30, poses, status)


def vector_a() -> tuple[np.ndarray, np.ndarray]:
    """Return estimated and reference poses, (60, 4, 4) each."""
    A = so3_exp(np.array([0.3, -0.5, 0.8]))
    estimated, reference = [], []
    for i in range(60):
        q = np.array([10 * np.sin(0.11 * i), 6 * np.cos(0.07 * i), 0.25 * i + 2 * np.sin(0.05 * i)])
        Rq = so3_exp(np.array([0.30 * np.sin(0.05 * i), 0.20 * np.cos(0.09 * i), 0.01 * i]))
        noise = np.array([0.30 * np.sin(1.7 * i), 0.20 * np.cos(2.3 * i), 0.25 * np.sin(0.9 * i + 1)])
        turn = so3_exp(np.array([0.02 * np.sin(1.1 * i), 0.015 * np.cos(0.8 * i), 0.01 * np.sin(2.0 * i)]))
        estimated.append(se3(A @ Rq @ turn, 0.4 * A @ (q + noise) + [5, -3, 2]))
        reference.append(se3(Rq, q))
    return np.stack(estimated), np.stack(reference)


def last_digit(*values: float) -> object:
    """Figures given to six decimals, to the last of them."""
    return pytest.approx(values, abs=5.1e-7)


def random_pair(seed: int, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Return two paths (count, 4, 4) that have nothing to do with each other."""
    rng = np.random.default_rng(seed)

    def walk() -> np.ndarray:
        T, poses = np.eye(4), []
        for _ in range(count):
            T = T @ se3_exp(np.concatenate([rng.normal(scale=0.2, size=3), rng.normal(scale=2, size=3)]))
            poses.append(T)
        return np.stack(poses)

    return walk(), walk()


def evo_pair(estimated: np.ndarray, reference: np.ndarray, mode: str, first: int | None = None) -> tuple:
    """Return reference and aligned estimate as evo has them."""
    from evo.core.trajectory import PosePath3D

    theirs, truth = (PosePath3D(poses_se3=list(copy.deepcopy(poses))) for poses in (estimated, reference))
    if mode == "origin":
        theirs.align_origin(truth)
    elif mode != "none":
        kinds = {"correct_scale": mode == "sim3", "correct_only_scale": mode == "scale"}
        theirs.align(truth, **kinds, n=-1 if first is None else first)
    return truth, theirs
