"""Landmarks: corners that are known again when seen from elsewhere, and the pose that follows from knowing them.

SIFT (Lowe, IJCV 2004) with the root of its descriptors (Arandjelovic and Zisserman, CVPR 2012): tissue offers few
corners, and little tells one from another, so every one is taken and geometry sorts them out, by PnP in RANSAC.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.frame import Frame
from scopemap.geometry.se3 import se3, so3_exp

_MOST = 500
_LEAST_CONTRAST = 0.01  # a quarter of SIFT's own: mottling is faint
_SHARPEST_EDGE = 15.0
_BORDER_PX = 3
_LEAST_RATIO = 0.8  # of distances to the best and the second best descriptor: Lowe's ratio test
_TRIES = 300
_SURE = 0.999
_OFF_SHARE = 1 / 80  # of the picture's width: how far a landmark may be from where it should be


@dataclass(frozen=True)
class Landmarks:
    """What a frame offers to be known again by, strongest first.

    Attributes
    ----------
    pixels : (N, 2) float64 x, y. descriptors : (N, 128) float32 of unit length. points_mm : (N, 3) float64 in the
    camera, NaN where the depth is unknown.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    points_mm: np.ndarray


@dataclass(frozen=True)
class Located:
    """Where a frame was taken, as seen from another.

    Attributes
    ----------
    T_current_reference : (4, 4), mm of the reference's depth. pairs : (M, 2) int, numbers of the landmarks in the
    reference and in the current frame that agree with it.
    """

    T_current_reference: np.ndarray
    pairs: np.ndarray


def find_landmarks(frame: Frame) -> Landmarks:
    """Return the landmarks of a frame's usable pixels, 500 at most; with depth where the frame has some."""
    usable = cv2.erode(frame.valid.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8), borderValue=0)
    sift = cv2.SIFT.create(nfeatures=_MOST, contrastThreshold=_LEAST_CONTRAST, edgeThreshold=_SHARPEST_EDGE)
    corners, descriptors = sift.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), 255 * usable)
    if descriptors is None:
        return Landmarks(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3)))
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
    return Landmarks(pixels, rooted.astype(np.float32), depth_mm[:, None].astype(np.float64) * ray)


def matches(reference: Landmarks, current: Landmarks) -> np.ndarray:
    """Return pairs (M, 2) int of landmarks that are each other's likeliest, and much likelier than the next."""
    if len(reference.pixels) < 2 or len(current.pixels) < 2:
        return np.zeros((0, 2), dtype=int)
    alike = np.asarray(reference.descriptors, np.float32) @ np.asarray(current.descriptors, np.float32).T
    rows = np.arange(len(alike))
    best = alike.argmax(1)
    mutual = alike.argmax(0)[best] == rows
    first = alike[rows, best]
    alike[rows, best] = -1.0
    # Of unit vectors the squared distance is 2 (1 - cosine).
    distinct = 1 - first < _LEAST_RATIO**2 * (1 - alike.max(1))
    return np.column_stack([rows, best])[mutual & distinct]


def locate(reference: Landmarks, current: Landmarks, camera: PinholeCamera, least: int) -> Located | None:
    """Return where `current` was taken as seen from `reference`, whose depth counts; None below `least` agreeing pairs.

    Deterministic: OpenCV's RANSAC draws from a seed of its own.
    """
    pairs = matches(reference, current)
    pairs = pairs[np.isfinite(reference.points_mm[pairs[:, 0]]).all(1)]
    if len(pairs) < max(least, 6):
        return None
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points, pixels = reference.points_mm[pairs[:, 0]], current.pixels[pairs[:, 1]]
    off_px = _OFF_SHARE * camera.width
    found, turn, way, agreeing = cv2.solvePnPRansac(
        points,
        pixels,
        K,
        None,
        iterationsCount=_TRIES,
        reprojectionError=off_px,
        confidence=_SURE,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found or agreeing is None or len(agreeing) < least:
        return None
    agreeing = agreeing.ravel()
    turn, way = cv2.solvePnPRefineLM(points[agreeing], pixels[agreeing], K, None, turn, way)
    T = se3(so3_exp(turn.ravel()), way.ravel())
    return Located(T, pairs[agreeing]) if np.isfinite(T).all() else None
