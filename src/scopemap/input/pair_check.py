"""Whether the calibration of a stereo pair is that of its pictures: rows and disparities of points that both show.

After rectification a point is in the same row of both views, and in the left one further to the right. Pictures that
were rectified before have that already; rectified once more by the calibration of the unrectified ones, their rows may
still be near, but the disparity is off by the distance of the principal points, and so is all depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel
from scopemap.engine.cameras.rectification import StereoPair
from scopemap.engine.errors import CalibrationError

ImagePair = tuple[np.ndarray, np.ndarray]

_LONGEST_SIDE_PX = 800
_FEATURES = 1500
_RATIO = 0.8  # Lowe 2004
_FEWEST_POINTS = 40
_EPIPOLAR_PX = 1.5
# Of the rows of three quarters of the points, px at that size: good calibrations leave 0.3, features 0.3 more.
_MOST_ROWS_PX = 1.2
_QUARTILE = 75
# By which one reading of the pictures must be the better one, and depths must differ to be told apart.
_BETTER = 0.5
_DEPTH_SHARE = 0.15


@dataclass(frozen=True)
class _EpipolarFit:
    """Points of a pair in one geometry: spread of their row differences, px, median disparity, px, and depth, mm."""

    rows_px: float
    disparity_px: float
    depth_mm: float


def check_pair(pair: StereoPair, views: Sequence[ImagePair]) -> str:
    """Return what could not be decided about a pair, "" where it is good; `views` (h, w, 3) uint8 of the input's size.

    Raises `CalibrationError` where the pictures contradict it: rectified already, wrong way round, or of another pair.
    """
    scale = min(1.0, _LONGEST_SIDE_PX / max(pair.left.central.width, pair.left.central.height))
    left, right = _matched(views, scale)
    if len(left) < _FEWEST_POINTS:
        return f"stereo: the calibration of the pair was not checked: its views have {len(left)} points in common"
    used, plain = _as_calibrated(pair, left, right, scale), _as_they_are(pair, left, right, scale)
    apart = abs(used.disparity_px - plain.disparity_px) > _DEPTH_SHARE * abs(used.disparity_px)
    fit_as_they_are = plain.rows_px <= _MOST_ROWS_PX and plain.rows_px < _BETTER * used.rows_px
    if fit_as_they_are and (apart or used.rows_px > _MOST_ROWS_PX):
        rows = f"rows agree to {plain.rows_px:.1f} px as they are, to {used.rows_px:.1f} px after the rectification"
        depth = f"; it would measure {used.depth_mm:.3g} mm for {plain.depth_mm:.3g} mm" if apart else ""
        remedy = "give the calibration of the rectified pictures (with its K1, K2, R, T), or the unrectified pictures"
        raise CalibrationError(f"the views are rectified already and {pair.source} is not: {rows}{depth}; {remedy}")
    if used.rows_px > _MOST_ROWS_PX:
        found = f"rectified by it, their rows differ by {used.rows_px:.1f} px, without it by {plain.rows_px:.1f} px"
        remedy = "check that both views show one moment, and that the file belongs to this pair and this size"
        raise CalibrationError(f"the views do not fit {pair.source}: {found}; {remedy}")
    if used.disparity_px <= 0:
        found = f"points lie {-used.disparity_px:.1f} px further to the left in the left view"
        remedy = "the views are the wrong way round, or the calibration is of other pictures: exchange them"
        raise CalibrationError(f"the views do not fit {pair.source}: {found}, which no depth explains; {remedy}")
    if apart and plain.disparity_px > 0 and plain.rows_px <= _MOST_ROWS_PX:
        either = f"{used.depth_mm:.3g} mm by its principal points, {plain.depth_mm:.3g} mm if they were the same"
        return f"stereo: rows do not show whether the pictures were rectified before: depth is {either}"
    return ""


def _as_calibrated(pair: StereoPair, left: np.ndarray, right: np.ndarray, scale: float) -> _EpipolarFit:
    R_left, R_right, P_left, P_right = pair.rectification((_side(pair, 0, scale), _side(pair, 1, scale)))
    one = _seen(pair.left, left / scale, R_left, P_left)
    other = _seen(pair.right, right / scale, R_right, P_right)
    return _epipolar_fit(one, other, float(-P_right[0, 3]))


def _as_they_are(pair: StereoPair, left: np.ndarray, right: np.ndarray, scale: float) -> _EpipolarFit:
    baseline_mm = float(np.linalg.norm(pair.T_right_left[:3, 3]))
    return _epipolar_fit(left, right, pair.left.central.fx * scale * baseline_mm)


def _epipolar_fit(left: np.ndarray, right: np.ndarray, focal_mm: float) -> _EpipolarFit:
    rows, disparity = left[:, 1] - right[:, 1], float(np.nanmedian(left[:, 0] - right[:, 0]))
    depth_mm = focal_mm / disparity if disparity > 0 else float("nan")
    return _EpipolarFit(float(np.nanpercentile(np.abs(rows), _QUARTILE)), disparity, depth_mm)


def _seen(camera: CameraModel, pixels: np.ndarray, R: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return where a rectified camera shows pixels (N, 2) of a view, (N, 2) px."""
    rays = camera.unproject(pixels) @ R.T @ P[:, :3].T
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _side(pair: StereoPair, axis: int, scale: float) -> int:
    return round(scale * (pair.left.central.width, pair.left.central.height)[axis])


def _matched(views: Sequence[ImagePair], scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2), (N, 2) of points that both views show, at a scale; of one epipolar geometry."""
    sift, matcher = cv2.SIFT.create(_FEATURES), cv2.BFMatcher()
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for pair in views:
        grey = [cv2.cvtColor(view, cv2.COLOR_RGB2GRAY) for view in pair]
        small = [cv2.resize(one, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for one in grey]
        (points, described), (others, other_described) = (sift.detectAndCompute(one, None) for one in small)
        if described is None or other_described is None or len(others) < 2:
            continue
        near = (two for two in matcher.knnMatch(described, other_described, k=2) if len(two) == 2)
        good = [first for first, second in near if first.distance < _RATIO * second.distance]
        if len(good) >= _FEWEST_POINTS // 4:
            left = np.array([points[match.queryIdx].pt for match in good])
            right = np.array([others[match.trainIdx].pt for match in good])
            found.append(_consistent(left, right))
    if not found:
        return np.empty((0, 2)), np.empty((0, 2))
    return np.concatenate([one for one, _ in found]), np.concatenate([other for _, other in found])


def _consistent(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    _, inside = cv2.findFundamentalMat(left, right, cv2.USAC_MAGSAC, _EPIPOLAR_PX, 0.999, 5000)
    if inside is None:
        return left[:0], right[:0]
    kept = inside.ravel().astype(bool)
    return left[kept], right[kept]
