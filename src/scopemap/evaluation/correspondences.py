"""Correspondences of two consecutive images: ORB matches, flow, and where the flow's ends have the same colour.

They are found in the images alone, so that the depth of every method is measured on the same points and pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
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
class FrameCorrespondences:
    """Correspondences of a frame and the one before it; the same for every method.

    Attributes
    ----------
    matches : ORB matches.
    to_previous : (H, W, 2) px, pixel p of this frame is seen at p + to_previous(p) in the previous one; None: no flow.
    consistent : (H, W) bool, where that flow is trusted; None without flow.
    same_colour : (H, W) bool, where moreover both images have the same colour, as OPW requires; None without flow.
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

        Parameters
        ----------
        rgb : (H, W, 3) uint8; valid : (H, W) bool, True where it shows usable tissue.
        to_previous : (H, W, 2) px flow to the previous image, if known; the same source for all methods.
        consistent : (H, W) bool, where the flow passed its forward-backward check; None: not checked, all count.
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
        check_shape("to_previous", to_previous, (*size, 2))
        trusted = np.ones(size, dtype=bool) if consistent is None else consistent
        check_shape("consistent", trusted, size)
        same_colour = trusted & have_same_colour(previous[0], rgb, to_previous)
        return FrameCorrespondences(matches, to_previous, trusted, same_colour)


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
    """Return the matches between two frames that agree with one rigid motion; none from fewer than 8 features.

    Each must be the other's nearest by Hamming distance, nearer than 0.8 times the second nearest in both directions,
    and an inlier (1 px) of the essential matrix that RANSAC finds. Sets OpenCV's random seed: the same images give the
    same matches.
    """
    if min(len(previous.pixels), len(current.pixels)) < _FEWEST_MATCHES:
        return Matches(np.empty((0, 2)), np.empty((0, 2)))
    to_current, distinct = _nearest(previous.descriptors, current.descriptors)
    to_previous, distinct_back = _nearest(current.descriptors, previous.descriptors)
    rows = np.arange(len(to_current))
    mutual = np.flatnonzero(distinct & distinct_back[to_current] & (to_previous[to_current] == rows))
    previous_px, current_px = previous.pixels[mutual], current.pixels[to_current[mutual]]
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
    """Return (H, W) bool: where OPW counts a pixel of the current frame.

    The previous image, pulled along the flow, must have its colour: exp(-50 |I - I_warped|) > 0.01, colours 0..1, and
    the flow must be below 250 px along both axes (in the public code only where it is positive). Khan et al., WACV 2023
    (`depth_change`).

    Parameters
    ----------
    rgb_previous, rgb_current : (H, W, 3) uint8.
    to_previous : (H, W, 2) px: pixel p of the current frame is seen at p + to_previous(p) in the previous one.
    """
    difference = rgb_current.astype(np.float32) - pull(rgb_previous, to_previous)
    same_colour = np.einsum("hwc,hwc->hw", difference, difference) < _COLOUR_DISTANCE**2
    return same_colour & (np.abs(to_previous) < _FLOW_LIMIT_PX).all(axis=-1)
