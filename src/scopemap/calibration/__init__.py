"""Calibration files: whatever form they have, told by their content, one camera comes out; one form is written.

Each form has a file of its own. They raise `ValueError` with what is wrong; `reading` says which file it was.
"""

from scopemap.calibration.fitting import fitted, fitted_to, rescaled_note
from scopemap.calibration.reading import read_calibration, stated_calibration
from scopemap.calibration.stated import Calibration
from scopemap.calibration.writing import write_calibration

__all__ = [
    "Calibration",
    "fitted",
    "fitted_to",
    "read_calibration",
    "rescaled_note",
    "stated_calibration",
    "write_calibration",
]
