"""ORB point-to-point displacement: the distance in space between the two ends of each match, lifted with depth.

The paper's depth-consistency experiment (arXiv 2508.11282, "Depth consistency") names ORB, consecutive frames and
displacements, and nothing else. Our form: inlier matches of `correspondences`, both ends lifted with their frame's
depth, e = ||P_t X_t - P_{t+1} X_{t+1}||. Without poses, ||X_t - X_{t+1}|| includes the camera's motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.evaluation.correspondences import Matches
from scopemap.geometry.se3 import transform


@dataclass(frozen=True)
class Displacements:
    """Matched points of one pair of frames, lifted; M counts those with depth at both ends.

    Attributes
    ----------
    previous_mm, current_mm : (M, 3) float64, in the world if poses were given, else each in its own camera.
    depth_mm : (M,) mean depth of the two ends.
    """

    previous_mm: np.ndarray
    current_mm: np.ndarray
    depth_mm: np.ndarray

    @property
    def displacement_mm(self) -> np.ndarray:
        """Distance (M,) between the two ends."""
        return np.asarray(np.linalg.norm(self.previous_mm - self.current_mm, axis=1))

    @property
    def relative(self) -> np.ndarray:
        """Distance (M,) over the point's depth."""
        return self.displacement_mm / self.depth_mm


@dataclass(frozen=True)
class DisplacementSummary:
    """Displacements of a sequence; NaN where there are none.

    Attributes
    ----------
    pairs, matches : pairs of frames with a lifted match, and their matches.
    mean_mm, median_mm, std_mm : over all matches of the sequence; std divides by N.
    relative_mean, relative_median : the same of displacement over depth.
    pair_mean_mm, pair_median_mm, pair_matches : of every pair in order, NaN and 0 where nothing was matched.
    """

    pairs: int
    matches: int
    mean_mm: float
    median_mm: float
    std_mm: float
    relative_mean: float
    relative_median: float
    pair_mean_mm: tuple[float, ...]
    pair_median_mm: tuple[float, ...]
    pair_matches: tuple[int, ...]

    @classmethod
    def of(cls, pairs: Sequence[np.ndarray]) -> DisplacementSummary:
        """Summarise pairs of frames: of each, displacements in mm and over depth, (2, M), M = 0 where unmatched."""
        all_mm, all_relative = np.concatenate([*pairs, np.empty((2, 0))], axis=1).astype(float)
        return cls(
            pairs=sum(pair.shape[1] > 0 for pair in pairs),
            matches=len(all_mm),
            mean_mm=_or_nan(np.mean, all_mm),
            median_mm=_or_nan(np.median, all_mm),
            std_mm=_or_nan(np.std, all_mm),
            relative_mean=_or_nan(np.mean, all_relative),
            relative_median=_or_nan(np.median, all_relative),
            pair_mean_mm=tuple(_or_nan(np.mean, pair[0]) for pair in pairs),
            pair_median_mm=tuple(_or_nan(np.median, pair[0]) for pair in pairs),
            pair_matches=tuple(pair.shape[1] for pair in pairs),
        )


def displacements(
    matches: Matches,
    depth_previous_mm: np.ndarray,
    depth_current_mm: np.ndarray,
    camera: PinholeCamera,
    poses: tuple[np.ndarray, np.ndarray] | None = None,
) -> Displacements:
    """Lift both ends of each match with its frame's depth; matches without depth at both ends are left out.

    Parameters
    ----------
    matches : between the two frames.
    depth_previous_mm, depth_current_mm : (H, W), NaN = unknown. The pixel nearest to the match counts: at a fold's edge
        an interpolated depth would be on neither surface.
    camera : of both frames.
    poses : T_world_camera, (4, 4), of the previous and of the current frame. None: points stay in their cameras.
    """
    check_shape("depth_previous_mm", depth_previous_mm, (camera.height, camera.width))
    check_shape("depth_current_mm", depth_current_mm, (camera.height, camera.width))
    z_previous = _nearest_depth(depth_previous_mm, matches.previous_px)
    z_current = _nearest_depth(depth_current_mm, matches.current_px)
    previous = z_previous[:, None] * camera.unproject(matches.previous_px)
    current = z_current[:, None] * camera.unproject(matches.current_px)
    if poses is not None:
        previous, current = transform(poses[0], previous), transform(poses[1], current)
    known = np.isfinite(previous).all(axis=1) & np.isfinite(current).all(axis=1)
    return Displacements(previous[known], current[known], ((z_previous + z_current) / 2)[known])


def _nearest_depth(depth_mm: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return depth (M,) float64 of the pixels nearest to positions (M, 2), NaN outside the image."""
    height, width = depth_mm.shape
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.where(inside, depth_mm[v.clip(0, height - 1), u.clip(0, width - 1)], np.nan).astype(np.float64)


def _or_nan(statistic: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float:
    return float(statistic(values)) if len(values) else float("nan")
