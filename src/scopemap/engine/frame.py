"""Frame: the data type that flows through all stages. Truth: known poses and depth, for evaluation only.

A stage takes a Frame and returns a new one (`dataclasses.replace`); frames are never changed in place. What is kept of
every frame of a run is in `Rows`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import check_shape

REGIONS = 6, 8  # by hand
"""Rows and columns of the regions of a picture whose tissue is looked at for motion of its own."""

_CONSTANT_RANGE = 4  # by hand: grey levels by which a picture of one colour varies, for lossy coding
_ROWS_AT_ONCE = 100_000  # by hand
# Width of the box filter that leaves little of a sensor's noise.
_NOISE_WIDTH_PX = 9  # by hand
TruthQuality = Literal["exact", "registered", "kinematic", "sfm", "stereo", "predicted"]


@dataclass(frozen=True)
class Frame:
    """One rectified image of the sequence with the results of the stages so far.

    Attributes
    ----------
    index : number of the frame in the input (file number or position in the video), not in the selection.
    time_s : time stamp, s.
    rgb : (H, W, 3) uint8, sRGB.
    camera : pinhole camera of the working size.
    valid : (H, W) bool, True where the pixel shows usable tissue.
    depth_mm : (H, W) float32 along the optical axis, NaN = unknown; None before depth estimation.
    T_world_camera : (4, 4) float64, takes a point in the camera to the world; None until tracked.
    name : the file's own name, or "".
    depth_sigma_mm : (H, W) float32, one standard deviation of `depth_mm`, NaN = unknown; None: not estimated.
    highlights : (H, W) bool, True where `valid` is False for a specular highlight alone; None: not looked for.
    nonrigidity : `REGIONS` float32, as `Track` has it; None: not measured.
    weight : (H, W) float32, by which its pixels count in fusion, also for frames that are left out; None: 1.
    quality : what the picture is worth beside those of recent frames, 0..1, as `PictureQuality` has it.
    instruments : (H, W) bool, where the depth network found some, which `valid` leaves out; None: not looked for.
    views : both views of a stereo pair as in the input, left first, each (h, w, 3) uint8; None: one view, or depth is
    known.
    depth_scale : factor of the estimated depth by which it agrees with the frames before, as MAPIS-Depth finds it; 1
    where the estimator knows no scale, as of disparity.
    """

    index: int
    time_s: float
    rgb: np.ndarray
    camera: PinholeCamera
    valid: np.ndarray
    depth_mm: np.ndarray | None = None
    T_world_camera: np.ndarray | None = None
    name: str = ""
    depth_sigma_mm: np.ndarray | None = None
    highlights: np.ndarray | None = None
    nonrigidity: np.ndarray | None = None
    weight: np.ndarray | None = None
    instruments: np.ndarray | None = None
    quality: float = 1.0
    depth_scale: float = 1.0
    views: tuple[np.ndarray, np.ndarray] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        check_shape("Frame.rgb", self.rgb, (*size, 3))
        check_shape("Frame.valid", self.valid, size)
        if self.depth_mm is not None:
            check_shape("Frame.depth_mm", self.depth_mm, size)
        if self.depth_sigma_mm is not None:
            check_shape("Frame.depth_sigma_mm", self.depth_sigma_mm, size)
        if self.highlights is not None:
            check_shape("Frame.highlights", self.highlights, size)
        if self.instruments is not None:
            check_shape("Frame.instruments", self.instruments, size)
        if self.T_world_camera is not None:
            check_shape("Frame.T_world_camera", self.T_world_camera, (4, 4))
        if self.nonrigidity is not None:
            check_shape("Frame.nonrigidity", self.nonrigidity, REGIONS)
        if self.weight is not None:
            check_shape("Frame.weight", self.weight, size)

    def downscaled(self, factor: int) -> Frame:
        """Return the image with its valid pixels and camera at 1/factor of the size, without results of stages."""
        if factor == 1:
            return self
        size = max(self.camera.width // factor, 1), max(self.camera.height // factor, 1)
        rgb = cv2.resize(self.rgb, size, interpolation=cv2.INTER_AREA)
        valid = cv2.resize(self.valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
        return Frame(self.index, self.time_s, rgb, self.camera.resized(*size), valid, name=self.name)

    def point_cloud(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the usable pixels with depth as points (N, 3) float32, world mm, and their colours (N, 3) uint8.

        Both are empty where the frame has no depth or no pose.
        """
        if self.depth_mm is None or self.T_world_camera is None:
            return np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)
        seen = self.valid & (self.depth_mm > 0)
        points = self.camera.rays[seen] * self.depth_mm[seen, None]
        world = points @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]
        return world.astype(np.float32), self.rgb[seen]


@dataclass(frozen=True)
class Truth:
    """Ground truth of a frame; never passed to an estimator.

    Attributes
    ----------
    index : as `Frame.index`.
    T_world_camera : (4, 4) float64, mm, or None.
    depth_mm : (H, W) float32 of the working size, NaN = unknown, or None.
    quality : how the truth was obtained.
    """

    index: int
    T_world_camera: np.ndarray | None = None
    depth_mm: np.ndarray | None = None
    quality: TruthQuality = "exact"


class Rows:
    """Rows of one numpy type, put in one after the other, packed: objects would take ten times as much memory."""

    def __init__(self, kind: np.dtype) -> None:
        self._kind, self._count = kind, 0
        self._bytes = np.zeros((0, kind.itemsize), np.uint8)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._count

    def append(self, rows: np.ndarray) -> None:
        """Put rows (n,) of the kind in."""
        end = self._count + len(rows)
        if end > len(self._bytes):
            larger = np.zeros((max(end, len(self._bytes) * 5 // 4), self._kind.itemsize), np.uint8)
            larger[: self._count] = self._bytes[: self._count]
            self._bytes = larger
        self._bytes[self._count : end] = self._raw(rows)
        self._count = end

    def read(self, first: int = 0, count: int | None = None) -> np.ndarray:
        """Return `count` rows from the row `first` on, a copy; None: all of them."""
        end = self._count if count is None else first + count
        found: np.ndarray = self._bytes[first:end].reshape(-1).view(self._kind).copy()
        return found

    def parts(self) -> Iterator[np.ndarray]:
        """Yield all rows in parts, since in one piece those of a long clip would fill memory."""
        for first in range(0, len(self), _ROWS_AT_ONCE):
            yield self.read(first, min(_ROWS_AT_ONCE, len(self) - first))

    def keep(self, kept: np.ndarray) -> None:
        """Forget the rows where `kept`, (N,) bool, is False."""
        rows, self._count = self.read()[kept], 0
        self.append(rows)

    def _raw(self, rows: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(rows, self._kind).view(np.uint8).reshape(len(rows), self._kind.itemsize)


RowTable = Callable[[str, np.dtype], Rows]
"""Returns new rows by name and kind: in memory, or on disk."""


def rows_in_memory(_: str, kind: np.dtype) -> Rows:
    """Return new rows in memory."""
    return Rows(kind)


def is_constant(rgb: np.ndarray) -> bool:
    """Return whether an image (H, W, 3) uint8 is black or of one colour, up to noise."""
    smooth = cv2.blur(rgb, (_NOISE_WIDTH_PX, _NOISE_WIDTH_PX))
    low, high = percentiles_uint8(cv2.cvtColor(smooth, cv2.COLOR_RGB2GRAY), [0.5, 99.5])
    return bool(high - low <= _CONSTANT_RANGE)


def percentiles_uint8(levels: np.ndarray, shares: list[float]) -> list[float]:
    """Return the percentiles (0..100) of values uint8, any shape but not empty, as numpy interpolates them."""
    below = np.cumsum(np.bincount(levels.ravel(), minlength=256))
    found = []
    for share in shares:
        place = share / 100 * (levels.size - 1)
        low, high = np.searchsorted(below, [math.floor(place), math.ceil(place)], side="right")
        found.append(float(low + (place - math.floor(place)) * (high - low)))
    return found
