"""Camera motion: photometric alignment to a keyframe, and smoothing of the poses."""

from scopemap.tracking.smoothing import NoSmoothing, Smoother, Wema, create_smoother
from scopemap.tracking.track import FrameTracker, Status, Track
from scopemap.tracking.tracker import Tracker

__all__ = ["FrameTracker", "NoSmoothing", "Smoother", "Status", "Track", "Tracker", "Wema", "create_smoother"]
