"""Features with depth (RootSIFT, Arandjelovic, Zisserman, CVPR 2012), matching, relative pose by PnP in RANSAC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import usable_pixels
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import se3, so3_exp

_MAX_FEATURES = 500  # by hand
_MIN_CONTRAST = 0.01  # a quarter of OpenCV's default: tissue texture is faint
_MAX_EDGE_RATIO = 15.0  # by hand; OpenCV's default, Lowe's, is 10
_MAX_RATIO = 0.8  # Lowe 2004: ratio test
_MIN_SIMILARITY = 0.8  # by hand: cosine of descriptors above which they count for the similarity of two pictures
_AT_ONCE = 32  # by hand, for memory: pictures that are compared
_MAX_ITERATIONS = 500  # by hand: of RANSAC
_CONFIDENCE = 0.999  # by hand: of RANSAC
_INLIER_SHARE = 1 / 80  # by hand: largest reprojection error of an inlier, share of the image's width


@dataclass(frozen=True)
class Features:
    """Features of a frame, strongest first.

    pixels : (N, 2) float64 x, y. descriptors : (N, D) float32 of unit length. points_mm : (N, 3) float64 in the
    camera frame, NaN where the depth is unknown. max_ratio : of the distances to the nearest and to the second nearest
    descriptor, above which a feature is not matched; 1: mutual nearest neighbours are matched however close others are.
    """

    pixels: np.ndarray
    descriptors: np.ndarray
    points_mm: np.ndarray
    max_ratio: float = _MAX_RATIO


class FeatureDetector(Protocol):
    """Protocol of `SiftFeatures` and `AlikeFeatures`; any thread may call it."""

    name: str
    descriptor_size: int
    max_ratio: float
    """See `Features`."""

    def detect(self, frame: Frame) -> Features:
        """Return features in the usable pixels of a frame, with depth where the frame has it."""

    def provenance(self) -> dict[str, str]:
        """Return what the result depends on, as text: names, versions, hashes."""


class SiftFeatures:
    """RootSIFT features by OpenCV."""

    name, descriptor_size, max_ratio = "sift", 128, _MAX_RATIO

    def detect(self, frame: Frame) -> Features:
        """Return at most 500 features in the usable pixels of a frame, with depth where the frame has it."""
        sift = cv2.SIFT.create(nfeatures=_MAX_FEATURES, contrastThreshold=_MIN_CONTRAST, edgeThreshold=_MAX_EDGE_RATIO)
        usable = 255 * usable_pixels(frame.valid).astype(np.uint8)
        corners, descriptors = sift.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), usable)
        if descriptors is None:
            return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros((0, 3)))
        order = np.argsort([-corner.response for corner in corners], kind="stable")
        pixels = np.array([corner.pt for corner in corners], dtype=np.float64)[order]
        rooted = np.sqrt(descriptors[order] / np.maximum(descriptors[order].sum(1, keepdims=True), 1e-9))
        return Features(pixels, rooted.astype(np.float32), points_at(pixels, frame.depth_mm, frame.camera))

    def provenance(self) -> dict[str, str]:
        """Return the name and OpenCV's version."""
        return {"features": self.name, "opencv": cv2.__version__}


@dataclass(frozen=True)
class RelativePose:
    """Relative pose (4, 4), mm of the reference's depth, and its inliers (M, 2) int, in reference and current frame."""

    T_current_reference: np.ndarray
    pairs: np.ndarray


def points_at(pixels: np.ndarray, depth_mm: np.ndarray | None, camera: PinholeCamera) -> np.ndarray:
    """Return the points (N, 3) mm in the camera at pixels (N, 2); NaN where the depth (H, W), mm, is unknown."""
    column, row = np.clip(np.rint(pixels).astype(int), 0, [camera.width - 1, camera.height - 1]).T
    known_mm = np.full(len(pixels), np.nan) if depth_mm is None else depth_mm[row, column]
    return known_mm[:, None].astype(np.float64) * camera.unproject(pixels)


def match_features(reference: Features, current: Features) -> np.ndarray:
    """Return index pairs (M, 2) int of mutual nearest neighbours that pass the ratio test, of features of one kind."""
    if len(reference.pixels) < 2 or len(current.pixels) < 2:
        return np.zeros((0, 2), dtype=int)
    cosine = np.asarray(reference.descriptors, np.float32) @ np.asarray(current.descriptors, np.float32).T
    rows = np.arange(len(cosine))
    best = cosine.argmax(1)
    mutual = cosine.argmax(0)[best] == rows
    if reference.max_ratio < 1:
        first = cosine[rows, best]
        cosine[rows, best] = -1.0
        # Of unit vectors the squared distance is 2 (1 - cosine).
        mutual &= 1 - first < reference.max_ratio**2 * (1 - cosine.max(1))
    return np.column_stack([rows, best])[mutual]


def similarities(strongest: np.ndarray, pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Return how alike pictures are to one with `strongest` (n, D), by descriptors (m, D) of each, (pictures,).

    It is the sum over the n descriptors of the cosine to the nearest in the picture, above a threshold.
    """
    found = np.zeros(len(pictures))
    known = [place for place, descriptors in enumerate(pictures) if len(descriptors)]
    for first in range(0, len(known) if len(strongest) else 0, _AT_ONCE):
        some = known[first : first + _AT_ONCE]
        joined = np.concatenate([pictures[place] for place in some]).astype(strongest.dtype)
        starts = np.cumsum([0] + [len(pictures[place]) for place in some[:-1]])
        nearest = np.maximum.reduceat(joined @ strongest.T, starts)
        found[some] = np.maximum(nearest - _MIN_SIMILARITY, 0).sum(1)
    return found


def relative_pose_pnp(
    reference: Features, current: Features, camera: PinholeCamera, min_inliers: int
) -> RelativePose | None:
    """Return the relative pose from the reference's points and current pixels; or None below `min_inliers`."""
    pairs = match_features(reference, current)
    pairs = pairs[np.isfinite(reference.points_mm[pairs[:, 0]]).all(1)]
    if len(pairs) < max(min_inliers, 6):
        return None
    points, pixels = reference.points_mm[pairs[:, 0]], current.pixels[pairs[:, 1]]
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        None,
        iterationsCount=_MAX_ITERATIONS,
        reprojectionError=_INLIER_SHARE * camera.width,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    inliers = inliers.ravel()
    rotation, translation = cv2.solvePnPRefineLM(
        points[inliers], pixels[inliers], camera.matrix, None, rotation, translation
    )
    T = se3(so3_exp(rotation.ravel()), translation.ravel())
    return RelativePose(T, pairs[inliers]) if np.isfinite(T).all() else None
