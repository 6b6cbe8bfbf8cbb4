"""Camera motion: photometric alignment to a keyframe, and smoothing of the poses."""

from scopemap.odometry.smoothing import NoSmoothing, Smoother, Wema, create_smoother
from scopemap.odometry.track import FrameTracker, Status, Track
from scopemap.odometry.tracker import Tracker

__all__ = ["FrameTracker", "NoSmoothing", "Smoother", "Status", "Track", "Tracker", "Wema", "create_smoother"]
