"""The back end: keyframes adjusted together, once the front end has tracked them."""

from scopemap.backend.backend import Backend
from scopemap.backend.correction import Correction, Seat
from scopemap.backend.depth_grid import LARGEST_LOG_FACTOR

__all__ = ["LARGEST_LOG_FACTOR", "Backend", "Correction", "Seat"]
