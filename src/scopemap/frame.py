"""Frame: the one thing that flows. Truth: what only evaluation may see.

A stage takes a Frame and returns a new one (`dataclasses.replace`); nothing is changed in place.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape

TruthQuality = Literal["exact", "registered", "kinematic", "sfm", "stereo", "predicted"]


@dataclass(frozen=True)
class SeenAgain:
    """Points of an earlier frame, where optical flow finds them in this one.

    Attributes
    ----------
    points_mm : (N, 3) float64, in the camera of the earlier frame. pixels : (N, 2) float64 x, y in this frame.
    share : of this frame's pixels that flow and depth could be trusted in; the points are some of them. Of corners, the
    share of them that was found. host : number of the earlier frame, -1: the one before.
    """

    points_mm: np.ndarray
    pixels: np.ndarray
    share: float
    host: int = -1

    def __post_init__(self) -> None:
        check_shape("SeenAgain.points_mm", self.points_mm, (None, 3))
        check_shape("SeenAgain.pixels", self.pixels, (len(self.points_mm), 2))


@dataclass(frozen=True)
class Frame:
    """One rectified image of the sequence and what the stages have found out about it.

    Attributes
    ----------
    index : number of the frame in the input (file number or position in the video), not in the selection.
    time_s : time stamp, s.
    rgb : (H, W, 3) uint8, sRGB.
    camera : pinhole camera of the working size.
    valid : (H, W) bool, True where the pixel shows usable tissue.
    depth_mm : (H, W) float32 along the optical axis, NaN = unknown; None until a depth stage has spoken.
    T_world_camera : (4, 4) float64, takes a point in the camera to the world; None until tracked.
    name : the file's own name, or "".
    depth_sigma_mm : (H, W) float32, one standard deviation of `depth_mm`, NaN = unknown; None: nothing is said of it.
    seen_again : what flow carries over from the frame before; None where there is none, or nothing is known of it.
    corners_again : the same of the corners of the keyframe.
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
    seen_again: SeenAgain | None = None
    corners_again: SeenAgain | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        check_shape("Frame.rgb", self.rgb, (*size, 3))
        check_shape("Frame.valid", self.valid, size)
        if self.depth_mm is not None:
            check_shape("Frame.depth_mm", self.depth_mm, size)
        if self.depth_sigma_mm is not None:
            check_shape("Frame.depth_sigma_mm", self.depth_sigma_mm, size)
        if self.T_world_camera is not None:
            check_shape("Frame.T_world_camera", self.T_world_camera, (4, 4))


@dataclass(frozen=True)
class Truth:
    """What is known to be true of a frame; never handed to an estimator.

    Attributes
    ----------
    index : as `Frame.index`.
    T_world_camera : (4, 4) float64, mm, or None.
    depth_mm : (H, W) float32 of the working size, NaN = unknown, or None.
    quality : how the truth came about.
    """

    index: int
    T_world_camera: np.ndarray | None = None
    depth_mm: np.ndarray | None = None
    quality: TruthQuality = "exact"
