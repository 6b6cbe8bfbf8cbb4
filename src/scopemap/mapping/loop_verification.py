"""Loop verification: whether two keyframes show the same where the pose of a loop says so, between the features, too.

Folds that repeat, and what stays in place in the picture, give enough features that fit a wrong pose by chance. The
rest of the picture does not. Fine detail is compared, relative to its surround, because the lamp moves with the camera.
"""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.flow.corners import usable_pixels
from scopemap.frame import Frame
from scopemap.geometry.local_contrast import local_contrast, local_mean
from scopemap.geometry.se3 import transform

_WIDTH, _HEIGHT, _STEP = 160, 128, 2  # px of the small picture, and between the pixels that are compared
_FINE_PX, _COARSE_PX = 0.75, 2.5  # standard deviations of the Gaussians between which the detail lies
_DARKEST, _LEAST_CONTRAST = 8.0, 0.01  # grey levels added before the logarithm; ln, below which detail is noise
_MIN_PIXELS = 100
# In an examination of which the truth is known: 96 of 100 right loops are above, and 8 of 100 wrong ones.
_MIN_CORRELATION = 0.12
VIEW = np.dtype(
    [
        ("detail", np.float16, (_HEIGHT, _WIDTH)),
        ("depth_mm", np.float32, (_HEIGHT // _STEP, _WIDTH // _STEP)),
    ]
)
"""What a keyframe shows, small: its detail, of local standard deviation 1, and depth at every second pixel.

NaN: not usable, or the depth is unknown.
"""


def small_view(keyframe: Frame) -> np.ndarray:
    """Return what a keyframe with depth shows, (1,) of the kind `VIEW`."""
    assert keyframe.depth_mm is not None
    size, view = (_WIDTH, _HEIGHT), np.zeros(1, VIEW)
    usable = usable_pixels(keyframe.valid).astype(np.float32)
    grey = cv2.cvtColor(keyframe.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    weight = cv2.resize(usable, size, interpolation=cv2.INTER_AREA)
    relative = np.log(cv2.resize(grey, size, interpolation=cv2.INTER_AREA) + _DARKEST)
    detail = local_mean(relative, _FINE_PX, weight) - local_mean(relative, _COARSE_PX, weight)
    contrast = local_contrast(detail, _COARSE_PX, weight, least=_LEAST_CONTRAST)
    view["detail"] = np.where(weight == 1, contrast, np.nan)
    view["depth_mm"] = cv2.resize(keyframe.depth_mm, size, interpolation=cv2.INTER_NEAREST)[::_STEP, ::_STEP]
    return view


def is_verified(past: np.ndarray, new: np.ndarray, T_new_past: np.ndarray, camera: PinholeCamera) -> bool:
    """Return whether two keyframes look alike by a relative pose; too small an overlap verifies nothing.

    past, new : views, () of the kind `VIEW`. T_new_past : (4, 4), mm of the past one's depth. camera : of both, at any
    size.
    """
    small = camera.resized(_WIDTH, _HEIGHT)
    seen = small.project(transform(T_new_past, past["depth_mm"][..., None] * small.rays[::_STEP, ::_STEP]))
    column, row = np.moveaxis(np.nan_to_num(seen, nan=-1.0), -1, 0).astype(np.float32)
    detail, beyond = new["detail"].astype(np.float32), cv2.BORDER_CONSTANT
    there = cv2.remap(detail, column, row, cv2.INTER_LINEAR, borderMode=beyond, borderValue=np.nan)
    here = past["detail"][::_STEP, ::_STEP].astype(np.float32)
    both = np.isfinite(here) & np.isfinite(there)
    if both.sum() < _MIN_PIXELS:
        return False
    return bool(np.corrcoef(here[both], there[both])[0, 1] >= _MIN_CORRELATION)
