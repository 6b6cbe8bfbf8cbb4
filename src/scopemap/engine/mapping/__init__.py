"""Mapping: loop closure, map merging and bundle adjustment of keyframes, and the correction of all frames."""

from scopemap.engine.mapping.backend import Backend
from scopemap.engine.mapping.depth_correction import MAX_LOG_FACTOR
from scopemap.engine.mapping.frame_correction import FrameCorrection, TrackedPose
from scopemap.engine.mapping.submaps import Mapper, Submap

__all__ = ["MAX_LOG_FACTOR", "Backend", "FrameCorrection", "Mapper", "Submap", "TrackedPose"]
