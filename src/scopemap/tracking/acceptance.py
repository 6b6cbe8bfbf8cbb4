"""Whether the pose of a frame is accepted, by its alignment with the keyframe and the motion since the last frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scopemap.config import TrackingSettings
from scopemap.geometry.se3 import inverse, rotation_angle_rad
from scopemap.tracking.relocalisation import Keyframe
from scopemap.tracking.rtdl import Alignment
from scopemap.tracking.track import TrackingLoss
from scopemap.trajectory.causes import LossCause

_DOUBTFUL_INLIER_SHARE = 0.6  # below it an unsharp frame is lost, unless so many features match: by chance 20 at most
MIN_TEXTURE = 0.5
"""Of a wall that shows nothing but noise; tissue has 0.65 and more."""
CLEAR_MATCHES = 40
"""Features that do not match by chance."""


class LastPose(NamedTuple):
    """The pose that was tracked last, (4, 4), the number of its map, and how many frames were lost since."""

    map: int
    T_world_camera: np.ndarray
    frames_lost: int


def is_obscured(sharpness: float, alignment: Alignment, least: float) -> bool:
    """Whether an image is too unsharp for its alignment to be reliable.

    sharpness : over the usual one. least : below which an alignment without much evidence does not count.
    """
    # Pixels of smoke fit smoke; its features match by chance alone. Below half of it neither is evidence.
    is_evident = alignment.inlier_share >= _DOUBTFUL_INLIER_SHARE or alignment.matches >= CLEAR_MATCHES
    return sharpness < (least / 2 if is_evident else least)


def rejection(
    keyframe: Keyframe, alignment: Alignment, T_world_camera: np.ndarray, last: LastPose, settings: TrackingSettings
) -> TrackingLoss | None:
    """Return why a pose (4, 4) is rejected, or None."""
    advanced = settings.advanced
    if not np.isfinite(T_world_camera).all():
        return TrackingLoss(LossCause.VIEW_CHANGED, "the alignment diverged")
    if alignment.overlap < settings.min_valid_share:
        return TrackingLoss(LossCause.VIEW_CHANGED, f"overlap {alignment.overlap:.0%} with the keyframe")
    if alignment.inlier_share < advanced.min_inlier_share and not alignment.is_supported:
        return TrackingLoss(LossCause.VIEW_CHANGED, f"inlier share {alignment.inlier_share:.0%} with the keyframe")
    # Measured depth constrains a pose by shape alone.
    by_shape = keyframe.measured and advanced.depth_weight > 0
    if alignment.correlation < advanced.min_correlation and not by_shape:
        if alignment.texture < MIN_TEXTURE:
            return TrackingLoss(LossCause.NO_TEXTURE, "weakly constrained, hardly any texture")
        # A supported pose may be a pixel off, which decorrelates fine texture.
        if alignment.correlation < advanced.min_correlation / 3 or not alignment.is_supported:
            return TrackingLoss(LossCause.VIEW_CHANGED, f"correlation {alignment.correlation:.2f} with the keyframe")
    # A cut may turn the view by any angle: so many features do not match by chance.
    if keyframe.map != last.map or alignment.matches >= CLEAR_MATCHES:
        return None
    T_step = inverse(last.T_world_camera) @ T_world_camera
    rotation_rad = float(rotation_angle_rad(T_step[:3, :3]))
    translation = float(np.linalg.norm(T_step[:3, 3])) / keyframe.depth_mm
    if max(rotation_rad, translation) > advanced.max_step * (1 + last.frames_lost):
        return TrackingLoss(
            LossCause.VIEW_CHANGED, f"jump of {np.degrees(rotation_rad):.0f} deg and {translation:.2f} mean depths"
        )
    return None
