"""ORB point-to-point displacement: do the points that two frames share lie at one place in space?

The paper's depth-consistency experiment (arXiv 2508.11282, "Depth consistency"), which names ORB, consecutive frames
and displacements, and nothing else. Our form: ORB features, mutual matches that pass the ratio test, inliers of a
RANSAC essential matrix; both ends are lifted with depth, and e = ||P_t X_t - P_{t+1} X_{t+1}||. Without poses,
||X_t - X_{t+1}|| measures the camera's motion, too. Matching sees images only: do it once, for all methods.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.geometry.se3 import transform

FEATURES = 1000
RATIO = 0.8
# OpenCV's default of 20 finds 7 corners in a smooth colon; 7 is ORB-SLAM's lower threshold, and the best 1000 stay.
_FAST_THRESHOLD = 7
# The five-point solver needs 5; with fewer than 8 nothing would be left to vote.
_FEWEST_MATCHES = 8
_EPIPOLAR_PX = 1.0
_RANSAC_CONFIDENCE = 0.999
_RNG_SEED = 0


@dataclass(frozen=True)
class OrbFeatures:
    """ORB features of one image: `pixels` (N, 2) float64, px; `descriptors` (N, 32) uint8."""

    pixels: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Matches:
    """The same M points in two frames: `previous_px` and `current_px`, (M, 2) float64, px."""

    previous_px: np.ndarray
    current_px: np.ndarray


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
    def of(cls, displacements_mm: Sequence[np.ndarray], relative: Sequence[np.ndarray]) -> DisplacementSummary:
        """Summarise displacements, one array (M,) per pair of frames (mm, and over depth), empty where unmatched."""
        all_mm, all_relative = (
            np.concatenate([*rows, np.empty(0)]).astype(float) for rows in (displacements_mm, relative)
        )
        counts = tuple(len(row) for row in displacements_mm)
        return cls(
            pairs=sum(count > 0 for count in counts),
            matches=len(all_mm),
            mean_mm=_or_nan(np.mean, all_mm),
            median_mm=_or_nan(np.median, all_mm),
            std_mm=_or_nan(np.std, all_mm),
            relative_mean=_or_nan(np.mean, all_relative),
            relative_median=_or_nan(np.median, all_relative),
            pair_mean_mm=tuple(_or_nan(np.mean, row) for row in displacements_mm),
            pair_median_mm=tuple(_or_nan(np.median, row) for row in displacements_mm),
            pair_matches=counts,
        )


def orb_features(rgb: np.ndarray, valid: np.ndarray | None = None) -> OrbFeatures:
    """Return the 1000 strongest ORB features of an image (H, W, 3) uint8, on pixels where `valid` (H, W) bool is True.

    OpenCV's defaults but for the corner threshold, which is 7 grey levels: smooth tissue has no corner above 20.
    """
    check_shape("rgb", rgb, (None, None, 3))
    mask = None if valid is None else valid.astype(np.uint8)
    detector = cv2.ORB.create(nfeatures=FEATURES, fastThreshold=_FAST_THRESHOLD)
    keypoints, descriptors = detector.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), mask)
    if descriptors is None:
        return OrbFeatures(np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8))
    return OrbFeatures(np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64), descriptors)


def match_features(previous: OrbFeatures, current: OrbFeatures, camera: PinholeCamera) -> Matches:
    """Return the matches between two frames that agree with one rigid motion; none where fewer than 8 could be had.

    Each must be the other's nearest by Hamming distance, nearer than 0.8 times the second nearest in both directions,
    and an inlier (1 px) of the essential matrix that RANSAC finds. Sets OpenCV's random seed: the same images give the
    same matches.
    """
    if min(len(previous.pixels), len(current.pixels)) < _FEWEST_MATCHES:
        return Matches(np.empty((0, 2)), np.empty((0, 2)))
    to_current, clear = _nearest(previous.descriptors, current.descriptors)
    to_previous, clear_back = _nearest(current.descriptors, previous.descriptors)
    rows = np.arange(len(to_current))
    mutual = np.flatnonzero(clear & clear_back[to_current] & (to_previous[to_current] == rows))
    previous_px, current_px = previous.pixels[mutual], current.pixels[to_current[mutual]]
    inliers = _epipolar_inliers(previous_px, current_px, camera)
    return Matches(previous_px[inliers], current_px[inliers])


def _nearest(descriptors: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest of `among` for each descriptor (N,), and whether it passes the ratio test (N,)."""
    distances, rows = cv2.batchDistance(descriptors, among, dtype=cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    return rows[:, 0], distances[:, 0] < RATIO * distances[:, 1]


def _epipolar_inliers(previous_px: np.ndarray, current_px: np.ndarray, camera: PinholeCamera) -> np.ndarray:
    inliers = None
    if len(previous_px) >= _FEWEST_MATCHES:
        cv2.setRNGSeed(_RNG_SEED)
        _, inliers = cv2.findEssentialMat(
            previous_px,
            current_px,
            camera.matrix,
            method=cv2.RANSAC,
            prob=_RANSAC_CONFIDENCE,
            threshold=_EPIPOLAR_PX,
        )
    return np.zeros(len(previous_px), dtype=bool) if inliers is None else inliers.ravel() > 0


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
        a mean of neighbours would lie between two surfaces, on neither.
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
