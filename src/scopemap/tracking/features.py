"""SIFT features with depth, their matching, and the relative pose of two frames by PnP in RANSAC.

SIFT (Lowe, IJCV 2004) with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012). Tissue has few distinctive
corners: the detection threshold is low, and RANSAC rejects the wrong matches.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.frame import Frame
from scopemap.geometry.se3 import se3, so3_exp

_MAX_FEATURES = 500
_MIN_CONTRAST = 0.01  # a quarter of OpenCV's default: tissue texture is faint
_MAX_EDGE_RATIO = 15.0
_BORDER_PX = 3
_MAX_RATIO = 0.8  # Lowe's ratio test
_MAX_ITERATIONS = 300
_CONFIDENCE = 0.999
_INLIER_SHARE = 1 / 80  # largest reprojection error of an inlier, share of the image's width


@dataclass(frozen=True)
class Features:
    """SIFT features of a frame, strongest first.

    Attributes
    ----------
    pixels : (N, 2) float64 x, y. descriptors : (N, 128) float32 of unit length. points_mm : (N, 3) float64 in the
    camera frame, NaN where the depth is unknown.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    points_mm: np.ndarray


@dataclass(frozen=True)
class RelativePose:
    """Relative pose of two frames and its inlier matches.

    Attributes
    ----------
    T_current_reference : (4, 4), mm of the reference's depth. pairs : (M, 2) int, indices of the inlier
    features in the reference and in the current frame.
    """

    T_current_reference: np.ndarray
    pairs: np.ndarray


def detect_features(frame: Frame) -> Features:
    """Return at most 500 features in the usable pixels of a frame, with depth where the frame has it."""
    usable = cv2.erode(frame.valid.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8), borderValue=0)
    sift = cv2.SIFT.create(nfeatures=_MAX_FEATURES, contrastThreshold=_MIN_CONTRAST, edgeThreshold=_MAX_EDGE_RATIO)
    corners, descriptors = sift.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), 255 * usable)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3)))
    order = np.argsort([-corner.response for corner in corners], kind="stable")
    pixels = np.array([corner.pt for corner in corners], dtype=np.float64)[order]
    height, width = frame.valid.shape
    column, row = np.clip(np.rint(pixels).astype(int), 0, [width - 1, height - 1]).T
    depth_mm = np.full(len(pixels), np.nan) if frame.depth_mm is None else frame.depth_mm[row, column]
    camera = frame.camera
    ray = np.column_stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))]
    )
    rooted = np.sqrt(descriptors[order] / np.maximum(descriptors[order].sum(1, keepdims=True), 1e-9))
    return Features(pixels, rooted.astype(np.float32), depth_mm[:, None].astype(np.float64) * ray)


def match_features(reference: Features, current: Features) -> np.ndarray:
    """Return index pairs (M, 2) int of mutual nearest neighbours that pass the ratio test."""
    if len(reference.pixels) < 2 or len(current.pixels) < 2:
        return np.zeros((0, 2), dtype=int)
    cosine = np.asarray(reference.descriptors, np.float32) @ np.asarray(current.descriptors, np.float32).T
    rows = np.arange(len(cosine))
    best = cosine.argmax(1)
    mutual = cosine.argmax(0)[best] == rows
    first = cosine[rows, best]
    cosine[rows, best] = -1.0
    # Of unit vectors the squared distance is 2 (1 - cosine).
    distinct = 1 - first < _MAX_RATIO**2 * (1 - cosine.max(1))
    return np.column_stack([rows, best])[mutual & distinct]


def relative_pose_pnp(
    reference: Features, current: Features, camera: PinholeCamera, min_inliers: int
) -> RelativePose | None:
    """Return the relative pose from the reference's 3D points and the current pixels; None below `min_inliers` inliers.

    Deterministic: OpenCV's RANSAC uses a fixed seed.
    """
    pairs = match_features(reference, current)
    pairs = pairs[np.isfinite(reference.points_mm[pairs[:, 0]]).all(1)]
    if len(pairs) < max(min_inliers, 6):
        return None
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points, pixels = reference.points_mm[pairs[:, 0]], current.pixels[pairs[:, 1]]
    max_error_px = _INLIER_SHARE * camera.width
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        K,
        None,
        iterationsCount=_MAX_ITERATIONS,
        reprojectionError=max_error_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    inliers = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(points[inliers], pixels[inliers], K, None, rotation, translation)
    T = se3(so3_exp(rotation.ravel()), translation.ravel())
    return RelativePose(T, pairs[inliers]) if np.isfinite(T).all() else None
