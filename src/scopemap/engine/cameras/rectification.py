"""Rectification: every frame once to a pinhole camera of the working size."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera, source_pixel
from scopemap.engine.errors import CalibrationError, check_shape

LONGEST_SIDE_PX = 400  # by hand: the default of `input.longest_side_px`
_BLUR_PER_SHRINK = 0.4  # by hand: sigma of the blur against aliasing, px per factor of shrinking


def working_size(width: int, height: int, longest_side_px: int = LONGEST_SIDE_PX) -> tuple[int, int]:
    """Return (width, height) divided, rounded down, by the least whole number that brings both to the longest side."""
    divisor = -(-max(width, height) // longest_side_px) if longest_side_px else 1
    return width // divisor, height // divisor


def working_camera(source: CameraModel, size: tuple[int, int], zoom: float = 1.0) -> PinholeCamera:
    """Return the pinhole of `size` (width, height) around the principal point of `source`, scaled, times `zoom`."""
    camera = source.central.resized(*size)
    return replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom)


class Rectifier:
    """Moves images, depth and labels from a source camera to a pinhole camera with the same centre.

    sensor : the camera of the depth where it is another one than the images', or None. Raises `CalibrationError` where
    source and target share no view.
    """

    def __init__(self, source: CameraModel, target: PinholeCamera, sensor: DepthSensor | None = None) -> None:
        self.source, self.target, self._sensor = source, target, sensor
        u, v = np.meshgrid(np.arange(target.width), np.arange(target.height))
        x, y = np.moveaxis(source_pixel(np.stack([u, v], -1), target, source), -1, 0)
        # A pixel is an area: its outer half belongs to the image too.
        self._valid = (np.abs(x - (source.width - 1) / 2) <= source.width / 2) & (
            np.abs(y - (source.height - 1) / 2) <= source.height / 2
        )
        if not self._valid.any():
            sizes = f"{source.width}x{source.height} px to {target.width}x{target.height} px"
            raise CalibrationError(f"rectifying {sizes}: no pixel of the source is seen; check the calibration")
        self._x = np.where(self._valid, x, 0).astype(np.float32)
        self._y = np.where(self._valid, y, 0).astype(np.float32)
        self._shrink = source.central.fx / target.fx

    def enlarged(self, width: int, height: int) -> Rectifier:
        """Return the rectifier to the same view at a larger size, without solving the lens at each of its pixels.

        Within a pixel of the target a lens bends lines by less than a hundredth of a pixel, so its map is interpolated
        linearly; along the border of what is `valid` it is wrong by up to half of such a pixel.
        """
        found, size = copy(self), (width, height)
        for name in ("only_resizes", "_halved"):
            found.__dict__.pop(name, None)
        found.target = self.target.resized(width, height)
        both = (self._x, self._y)
        found._x, found._y = (cv2.resize(one, size, interpolation=cv2.INTER_LINEAR).astype(np.float32) for one in both)
        found._valid = cv2.resize(self._valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        found._shrink = self.source.central.fx / found.target.fx
        return found

    @property
    def valid(self) -> np.ndarray:
        """(H, W) bool, a copy: target pixels that have a source pixel."""
        return self._valid.copy()

    @cached_property
    def only_resizes(self) -> bool:
        """Whether source and target are the same view at two sizes."""
        same = self.source.central.resized(self.target.width, self.target.height)
        is_pinhole = isinstance(self.source, PinholeCamera)
        return is_pinhole and np.allclose(same.matrix, self.target.matrix, rtol=0, atol=1e-6)

    def image(self, image: np.ndarray) -> np.ndarray:
        """Return the rectified image.

        `image` is (h, w, 3) or (h, w) uint8 of the source's size; the result (H, W, ...) uint8, 0 where not `valid`.
        A coarser target sees the source blurred first, so that fine texture does not alias.
        """
        check_shape("image", image[..., 0] if image.ndim == 3 else image, (self.source.height, self.source.width))
        if self.only_resizes:
            interpolation = cv2.INTER_AREA if self._shrink > 1 else cv2.INTER_LINEAR
            return cv2.resize(image, (self.target.width, self.target.height), interpolation=interpolation)
        sigma_px, x, y = _BLUR_PER_SHRINK * self._shrink, self._x, self._y
        if self._shrink > 2:
            # The mean of 2 by 2 pixels blurs by half a pixel already, and leaves a quarter of the work.
            height, width = (side // 2 for side in image.shape[:2])
            image = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
            sigma_px, x, y = math.sqrt(sigma_px**2 - 0.25) / 2, self._halved[0], self._halved[1]
        if self._shrink > 1:
            image = cv2.GaussianBlur(image, (0, 0), sigma_px)
        rectified = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        rectified[~self._valid] = 0
        return rectified

    def nearest(self, array: np.ndarray) -> np.ndarray:
        """Return depth or labels taken from the nearest pixel.

        `array` (h, w, ...) shows the view of the source, or of the depth sensor where there is one (mm then), at any
        size. Where not `valid`: NaN for floats, else 0.
        """
        if self._sensor is not None:
            array = self._sensor.registered(array, self.source)
        x, y = self._maps(array)
        rows = np.clip(np.rint(y).astype(np.intp), 0, array.shape[0] - 1)
        columns = np.clip(np.rint(x).astype(np.intp), 0, array.shape[1] - 1)
        rectified = array[rows, columns]
        rectified[~self._valid] = np.nan if np.issubdtype(array.dtype, np.floating) else 0
        return rectified

    def smooth(self, array: np.ndarray) -> np.ndarray:
        """Return a float32 map (H, W) interpolated linearly, for disparity.

        `array` (h, w) shows the source's view at any size; NaN = unknown. Unknown pixels take no part; the result is
        NaN where they would hold more than half of the weight, and where not `valid`.
        """
        check_shape("array", array, (None, None))
        x, y = self._maps(array)
        known = np.isfinite(array)
        values = np.where(known, array, 0).astype(np.float32)
        total = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        weight = cv2.remap(known.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.where(self._valid & (weight >= 0.5), total / np.maximum(weight, 0.5), np.nan).astype(np.float32)

    @cached_property
    def _halved(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the pixels are in a picture of half the source's size."""
        return self._x / 2 - np.float32(0.25), self._y / 2 - np.float32(0.25)

    def _maps(self, array: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, width = array.shape[:2]
        sx, sy = width / self.source.width, height / self.source.height
        if abs(sx / sy - 1) > 0.02:
            images = f"{self.source.width}x{self.source.height} px images"
            raise CalibrationError(
                f"rectifying an array of {width}x{height} px: its aspect is not that of the {images}"
            )
        return (self._x + 0.5) * np.float32(sx) - 0.5, (self._y + 0.5) * np.float32(sy) - 0.5


@dataclass(frozen=True)
class DepthSensor:
    """A depth camera; T_colour_depth (4, 4), mm, takes its points to the camera of the images beside it."""

    camera: PinholeCamera
    T_colour_depth: np.ndarray

    def registered(self, depth_mm: np.ndarray, colour: CameraModel) -> np.ndarray:
        """Return the depth that `colour` sees, (h, w) float32, NaN = unknown; of several in a pixel the nearest.

        depth_mm : as the sensor sees it, at any size, NaN = unknown.
        """
        points = self.camera.resized(depth_mm.shape[1], depth_mm.shape[0]).rays * depth_mm[..., None]
        points = points[np.isfinite(depth_mm)] @ self.T_colour_depth[:3, :3].T + self.T_colour_depth[:3, 3]
        pixels = colour.project(points)
        seen = np.isfinite(pixels).all(-1)
        # Rounding halves to even would leave every second pixel empty.
        points, pixels = points[seen], np.floor(pixels[seen] + 0.5).astype(int)
        inside = ((pixels >= 0) & (pixels < [colour.width, colour.height])).all(-1)
        seen_mm = np.full((colour.height, colour.width), np.inf, dtype=np.float32)
        np.minimum.at(seen_mm, (pixels[inside, 1], pixels[inside, 0]), points[inside, 2].astype(np.float32))
        return np.where(np.isfinite(seen_mm), seen_mm, np.float32(np.nan))


@dataclass(frozen=True)
class StereoPair:
    """Two cameras whose images have one size, the left one first.

    T_right_left (4, 4), mm, takes points in the left camera to the right one. source : how they are known, one phrase.
    """

    left: CameraModel
    right: CameraModel
    T_right_left: np.ndarray
    source: str

    def rectification(self, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return R_left, R_right (3, 3), P_left, P_right (3, 4) of OpenCV's `stereoRectify` for views of a size, px.

        R turns a camera's rays to the rectified one's, without the lenses; -P_right[0, 3] is focal length times
        baseline, px mm.
        """
        left, right = (one.central.resized(*size).matrix for one in (self.left, self.right))
        turned = self.T_right_left[:3, :3], self.T_right_left[:3, 3:]
        R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
            left, np.zeros(4), right, np.zeros(4), size, *turned, flags=cv2.CALIB_ZERO_DISPARITY
        )
        return R_left, R_right, P_left, P_right
