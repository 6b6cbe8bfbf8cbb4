"""Correspondences of two consecutive images (ORB matches, flow), and the displacement of matched points in space.

They are found in the images alone, so that the depth of every method is measured on the same points and pixels. The
paper's depth-consistency experiment (arXiv 2508.11282) names ORB, consecutive frames and displacements; our form is e =
||P_t X_t - P_{t+1} X_{t+1}|| over inlier matches, lifted with depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.evaluation.poses import ErrorSummary
from scopemap.geometry.se3 import transform
from scopemap.geometry.warp import pull

FEATURES = 1000
RATIO = 0.8
# OpenCV's default of 20 finds 7 corners in a smooth colon; 7 is ORB-SLAM's lower threshold, and the best 1000 stay.
_FAST_THRESHOLD = 7
# The five-point solver needs 5; with fewer than 8 no match is left to confirm a model.
_FEWEST_MATCHES = 8
_EPIPOLAR_PX = 1.0
_RANSAC_CONFIDENCE = 0.999
_RNG_SEED = 0
# exp(-50 |difference|) > 1e-2, with colours in 0..1.
_COLOUR_DISTANCE = 255 * np.log(1e2) / 50
_FLOW_LIMIT_PX = 250.0

OrbFeatures = tuple[np.ndarray, np.ndarray]
"""ORB features of one image: pixels (N, 2) float64, px, and descriptors (N, 32) uint8."""


@dataclass(frozen=True)
class Matches:
    """The same M points in two frames: `previous_px` and `current_px`, (M, 2) float64, px."""

    previous_px: np.ndarray
    current_px: np.ndarray


@dataclass(frozen=True)
class FrameCorrespondences:
    """Correspondences of a frame and the one before it; the same for every method.

    matches : ORB matches.
    to_previous : (H, W, 2) px, pixel p of this frame is seen at p + to_previous(p) in the previous one; None: no flow.
    consistent : (H, W) bool, where that flow is trusted; same_colour : where moreover both images have the same colour.
    """

    matches: Matches
    to_previous: np.ndarray | None = None
    consistent: np.ndarray | None = None
    same_colour: np.ndarray | None = None


class FrameMatcher:
    """Matches each image with the one before it; keeps only that one."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._previous: tuple[np.ndarray, OrbFeatures] | None = None

    def match(
        self,
        rgb: np.ndarray,
        valid: np.ndarray,
        to_previous: np.ndarray | None = None,
        consistent: np.ndarray | None = None,
    ) -> FrameCorrespondences | None:
        """Return the correspondences with the image of the call before, None at the first.

        `rgb` is (H, W, 3) uint8, `valid` (H, W) bool, `to_previous` (H, W, 2) px. Without `consistent` (H, W) all flow
        counts.
        """
        size = (self._camera.height, self._camera.width)
        check_shape("rgb", rgb, (*size, 3))
        check_shape("valid", valid, size)
        previous, self._previous = self._previous, (rgb, orb_features(rgb, valid))
        if previous is None:
            return None
        matches = match_features(previous[1], self._previous[1], self._camera)
        if to_previous is None:
            return FrameCorrespondences(matches)
        trusted = np.ones(size, dtype=bool) if consistent is None else consistent
        same_colour = trusted & have_same_colour(previous[0], rgb, to_previous)
        return FrameCorrespondences(matches, to_previous, trusted, same_colour)


def orb_features(rgb: np.ndarray, valid: np.ndarray | None = None) -> OrbFeatures:
    """Return the 1000 strongest ORB features of an image (H, W, 3) uint8 on the `valid` pixels (H, W), None: on all."""
    mask = None if valid is None else valid.astype(np.uint8)
    detector = cv2.ORB.create(nfeatures=FEATURES, fastThreshold=_FAST_THRESHOLD)
    keypoints, descriptors = detector.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), mask)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64), descriptors


def match_features(previous: OrbFeatures, current: OrbFeatures, camera: PinholeCamera) -> Matches:
    """Return the matches between two frames that agree with one rigid motion; none from fewer than 8 features.

    Mutual nearest neighbours that pass Lowe's ratio test of 0.8 both ways, and inliers (1 px) of the essential matrix.
    Sets OpenCV's random seed: the same images give the same matches.
    """
    if min(len(previous[0]), len(current[0])) < _FEWEST_MATCHES:
        return Matches(np.empty((0, 2)), np.empty((0, 2)))
    to_current, distinct = _nearest(previous[1], current[1])
    to_previous, distinct_back = _nearest(current[1], previous[1])
    rows = np.arange(len(to_current))
    mutual = np.flatnonzero(distinct & distinct_back[to_current] & (to_previous[to_current] == rows))
    previous_px, current_px = previous[0][mutual], current[0][to_current[mutual]]
    inliers = None
    if len(mutual) >= _FEWEST_MATCHES:
        cv2.setRNGSeed(_RNG_SEED)
        _, inliers = cv2.findEssentialMat(
            previous_px, current_px, camera.matrix, cv2.RANSAC, _RANSAC_CONFIDENCE, _EPIPOLAR_PX
        )
    kept = np.zeros(len(mutual), dtype=bool) if inliers is None else inliers.ravel() > 0
    return Matches(previous_px[kept], current_px[kept])


def _nearest(descriptors: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest of `among` for each descriptor (N,), and whether it passes the ratio test (N,)."""
    distances, rows = cv2.batchDistance(descriptors, among, dtype=cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    return rows[:, 0], distances[:, 0] < RATIO * distances[:, 1]


def have_same_colour(rgb_previous: np.ndarray, rgb_current: np.ndarray, to_previous: np.ndarray) -> np.ndarray:
    """Return where OPW counts a pixel, (H, W) bool: same colour, exp(-50 |I - I_warped|) > 0.01, and flow < 250 px.

    `to_previous` is (H, W, 2) px. Khan et al., WACV 2023; their code limits the flow only where it is positive.
    """
    difference = rgb_current.astype(np.float32) - pull(rgb_previous, to_previous)
    same_colour = np.einsum("hwc,hwc->hw", difference, difference) < _COLOUR_DISTANCE**2
    return same_colour & (np.abs(to_previous) < _FLOW_LIMIT_PX).all(axis=-1)


def lifted_matches(
    matches: Matches,
    depth_previous_mm: np.ndarray,
    depth_current_mm: np.ndarray,
    camera: PinholeCamera,
    poses: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both ends of the matches in space, (M, 3) float64 mm each, and the mean depth (M,) of the two ends, mm.

    M counts the matches with depth (H, W), NaN = unknown, at both ends. The nearest pixel counts: at a fold's edge an
    interpolated depth would be on neither surface. `poses` are T_world_camera (4, 4) of the previous and of the current
    frame; without them points stay in their cameras.
    """
    z_previous = _nearest_depth(depth_previous_mm, matches.previous_px)
    z_current = _nearest_depth(depth_current_mm, matches.current_px)
    previous = z_previous[:, None] * camera.unproject(matches.previous_px)
    current = z_current[:, None] * camera.unproject(matches.current_px)
    if poses is not None:
        previous, current = transform(poses[0], previous), transform(poses[1], current)
    known = np.isfinite(previous).all(axis=1) & np.isfinite(current).all(axis=1)
    return previous[known], current[known], ((z_previous + z_current) / 2)[known]


def _nearest_depth(depth_mm: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return depth (M,) float64 of the pixels nearest to positions (M, 2), NaN outside the image."""
    height, width = depth_mm.shape
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.where(inside, depth_mm[v.clip(0, height - 1), u.clip(0, width - 1)], np.nan).astype(np.float64)


def displacement_figures(pairs: Sequence[np.ndarray]) -> dict[str, Any]:
    """Return the figures of a sequence's displacements in mm and over depth, (2, M) per pair, M = 0 where unmatched.

    pairs, matches : pairs of frames with a lifted match, and their matches.
    mean_mm, median_mm, std_mm, relative_mean, relative_median : over all matches; NaN where there are none.
    pair_mean_mm, pair_median_mm, pair_matches : of every pair in order.
    """
    mm, relative = (ErrorSummary.of(row) for row in np.concatenate([*pairs, np.empty((2, 0))], axis=1).astype(float))
    each_mm = [ErrorSummary.of(pair[0]) for pair in pairs]
    return {
        "pairs": sum(pair.shape[1] > 0 for pair in pairs),
        "matches": sum(pair.shape[1] for pair in pairs),
        "mean_mm": mm.mean,
        "median_mm": mm.median,
        "std_mm": mm.std,
        "relative_mean": relative.mean,
        "relative_median": relative.median,
        "pair_mean_mm": tuple(one.mean for one in each_mm),
        "pair_median_mm": tuple(one.median for one in each_mm),
        "pair_matches": tuple(pair.shape[1] for pair in pairs),
    }
