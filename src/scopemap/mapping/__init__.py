"""The back end: keyframes adjusted together, once the front end has tracked them."""

from scopemap.mapping.backend import Backend
from scopemap.mapping.depth_correction import LARGEST_LOG_FACTOR
from scopemap.mapping.pose_interpolation import Correction, TrackedPose
from scopemap.mapping.submaps import Mapper, Submap

__all__ = ["LARGEST_LOG_FACTOR", "Backend", "Correction", "Mapper", "Submap", "TrackedPose"]
