"""The back end: keyframes adjusted together, once the front end has tracked them."""

from scopemap.backend.backend import Backend
from scopemap.backend.correction import Correction

__all__ = ["Backend", "Correction"]
