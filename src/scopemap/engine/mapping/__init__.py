"""Mapping: loop closure, map merging and bundle adjustment of keyframes, and the correction of all frames."""

from scopemap.engine.mapping.correction import FrameCorrection, TrackedPose
from scopemap.engine.mapping.depth_correction import MAX_LOG_FACTOR
from scopemap.engine.mapping.mapper import Backend, Mapper
from scopemap.engine.mapping.segments import Submap

__all__ = ["MAX_LOG_FACTOR", "Backend", "FrameCorrection", "Mapper", "Submap", "TrackedPose"]
