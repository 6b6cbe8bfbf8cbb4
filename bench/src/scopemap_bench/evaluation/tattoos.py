"""Points of dye that a clip of STIR knows in its first and its last frame, against where a result says that they went.

Accuracy is that of its challenge (arXiv 2503.24306): which points belong together is not known, so that the error of a
point is its distance to the nearest true one; the share of points within 4, 8, 16, 32 and 64 px, and the mean of these
shares. The challenge measures mm, too, by points that it matches in both views; that is not done here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.result.depth_maps import DepthReader
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reread_frames import open_truth

THRESHOLDS_PX = (4, 8, 16, 32, 64)


def accuracy(found_px: np.ndarray, true_px: np.ndarray) -> dict[str, float]:
    """Return the figures of found points (N, 2), NaN = not found, against the true ones (M, 2)."""
    known = np.isfinite(found_px).all(1)
    distances = np.full(len(found_px), np.inf)
    if known.any() and len(true_px):
        distances[known] = KDTree(true_px).query(found_px[known])[0]
    shares = {f"within_{limit}_px": float(np.mean(distances <= limit)) for limit in THRESHOLDS_PX}
    return shares | {"accuracy": float(np.mean(list(shares.values()))), "median_px": float(np.median(distances))}


def followed(run: Path, clip: Path, start_px: np.ndarray) -> np.ndarray:
    """Return where points (N, 2) px of the first frame are in the last, by a run's depth and poses.

    NaN where a frame is lost, or the depth is not known.
    """
    sequence, path = open_truth(run, clip), read_trajectory(run)
    rays = sequence.rectifier.source.unproject(start_px)
    depth_mm = DepthReader(run).read(int(path.indices[0]))
    column, row = np.rint(sequence.camera.project(rays)).astype(int).T
    points = np.full(rays.shape, np.nan)
    if depth_mm is not None:
        inside = (row >= 0) & (row < depth_mm.shape[0]) & (column >= 0) & (column < depth_mm.shape[1])
        points[inside] = depth_mm[row[inside], column[inside], None] * rays[inside]
    points = transform(path.T_world_camera[0], points)
    return sequence.rectifier.source.project(transform(inverse(path.T_world_camera[-1]), points))
