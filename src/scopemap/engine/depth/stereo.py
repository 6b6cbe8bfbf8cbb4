"""Depth measured from the two views of a stereo pair: OpenCV's rectification and semi-global matching (SGBM)."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.rectification import StereoPair, working_size
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.frame import Frame

# Longest side at which views are matched, px: SGBM's time grows with its cube.
_LONGEST_SIDE_PX = 800  # by hand
_BLOCK_PX = 7  # by hand: side of the blocks that SGBM compares
# Blurred by so much first: a sensor's noise hides the mild texture of tissue.
_BLUR_PX = 0.8  # by hand
_SPECKLE_PIXELS = 400  # by hand: smaller islands of disparity are dropped (OpenCV's speckleWindowSize)
# Largest disparity, share of the width: for most endoscopes tissue that is nearer than two to three baselines.
_MOST_SHARE = 0.25  # by hand
# Disparity is good to a fifth of a pixel or so: depth beyond this one is worth nothing.
_LEAST_DISPARITY_PX = 2.0  # by hand
_LEFT_RIGHT_PX = 1  # OpenCV's usual check: largest difference of the disparities of both views
_SGBM_UNIT = 16  # OpenCV's: numbers of disparities are multiples of it, disparities are in sixteenths
_Pixels = tuple[np.ndarray, np.ndarray]


class StereoDepth:
    """Depth estimator of frames that carry both views.

    pair : both cameras, of views as in the input. camera : the working camera, with the left camera's centre and axes.
    measured_max_mm : the farthest depth that is measured.
    """

    name = "stereo"

    def __init__(self, pair: StereoPair, camera: PinholeCamera) -> None:
        self._pair = pair
        central = pair.left.central
        # Of square pixels, as rectified ones are.
        self._size = working_size(round(central.width * central.fy / central.fx), central.height, _LONGEST_SIDE_PX)
        left, right = (one.resized(*self._size) for one in (pair.left, pair.right))
        # The lenses are in the maps below, whatever their model.
        R_left, R_right, P_left, P_right = pair.rectification(self._size)
        self._maps = _map(left, R_left, P_left, self._size), _map(right, R_right, P_right, self._size)
        self._focal_mm = float(-P_right[0, 3])  # focal length times baseline, px mm
        rays = camera.rays @ R_left.T
        self._z = rays[..., 2].astype(np.float32)
        self._pixels = _split(rays @ P_left[:, :3].T / rays[..., 2:])
        self._disparities = _SGBM_UNIT * max(1, round(_MOST_SHARE * self._size[0] / _SGBM_UNIT))
        self.measured_max_mm = self._focal_mm / _LEAST_DISPARITY_PX

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return depth along the working camera's axis, mm, NaN = unknown: everywhere for a frame without its views."""
        if frame.views is None:
            return DepthEstimate(np.full(frame.valid.shape, np.nan, np.float32), "measured")
        left, right = (self._rectified(view, pixels) for view, pixels in zip(frame.views, self._maps, strict=True))
        disparity = disparity_of(left, right, self._disparities)
        seen = cv2.remap(disparity, *self._pixels, cv2.INTER_NEAREST, borderValue=np.nan)
        # A point at depth z on a ray r (z = 1) of the left camera is at depth z (R r)_z of the rectified one, f B / d.
        return DepthEstimate(self._focal_mm / (seen * self._z), "measured")

    def provenance(self) -> dict[str, str]:
        """Return the method, the size at which views are matched, the range of depth and the pair."""
        size = f"{self._size[0]}x{self._size[1]} px"
        near_mm = self._focal_mm / self._disparities
        reach = f"measured from {near_mm:.1f} to {self.measured_max_mm:.0f} mm"
        return {"depth": f"stereo, SGBM of OpenCV {cv2.__version__} at {size}, {reach}", "stereo": self._pair.source}

    def _rectified(self, view: np.ndarray, pixels: _Pixels) -> np.ndarray:
        small = cv2.resize(view, self._size, interpolation=cv2.INTER_AREA)
        return cv2.cvtColor(cv2.remap(small, *pixels, cv2.INTER_LINEAR), cv2.COLOR_RGB2GRAY)


def disparity_of(left: np.ndarray, right: np.ndarray, disparities: int) -> np.ndarray:
    """Return how far to the left `right` shows what `left` shows, (h, w) float32, px, NaN = unknown.

    Both are rectified, (h, w) uint8. Of 0 to `disparities`, a multiple of 16; a pixel is known where the disparities of
    both views agree, its match is in the other view, and it is at least 2 px.
    """
    area = _BLOCK_PX * _BLOCK_PX
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=_BLOCK_PX,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=-1,
        preFilterCap=31,
        uniquenessRatio=10,
        speckleWindowSize=_SPECKLE_PIXELS,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # SGBM knows nothing of a margin on the left, as wide as the largest disparity; to the right in the mirror.
    blurred = [cv2.GaussianBlur(view, (0, 0), _BLUR_PX) for view in (left, right)]
    padded = [cv2.copyMakeBorder(view, 0, 0, disparities, disparities, cv2.BORDER_CONSTANT) for view in blurred]
    inside = slice(disparities, -disparities)
    of_left = matcher.compute(*padded)[:, inside].astype(np.float32) / _SGBM_UNIT
    mirrored = [np.ascontiguousarray(view[:, ::-1]) for view in reversed(padded)]
    of_right = matcher.compute(*mirrored)[:, ::-1][:, inside].astype(np.float32) / _SGBM_UNIT
    columns = np.broadcast_to(np.arange(left.shape[1], dtype=np.float32), left.shape)
    rows = np.broadcast_to(np.arange(left.shape[0], dtype=np.float32)[:, None], left.shape)
    other = cv2.remap(of_right, columns - of_left, np.ascontiguousarray(rows), cv2.INTER_NEAREST, borderValue=-1e3)
    known = (np.abs(other - of_left) <= _LEFT_RIGHT_PX) & (of_left >= _LEAST_DISPARITY_PX)
    return np.where(known, of_left, np.float32(np.nan))


def _map(camera: CameraModel, R: np.ndarray, P: np.ndarray, size: tuple[int, int]) -> _Pixels:
    """Return the pixel, (h, w) and (h, w), of a camera's view for each rectified one; far off where it has none."""
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(P[:, :3]).T @ R
    return _split(np.nan_to_num(camera.project(rays), nan=-1e4))


def _split(pixels: np.ndarray) -> _Pixels:
    return np.array(pixels[..., 0], np.float32, order="C"), np.array(pixels[..., 1], np.float32, order="C")
