"""What depth files cannot hold: nothing, a scale of their own in each frame, a depth that no endoscope sees."""

from __future__ import annotations

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.input.depth_files import FilesDepth

SEEN_MM = (1.0, 500.0)
"""Median depths that endoscopes see: from a wall that is nearly touched to far beyond an inflated abdomen."""

_USUAL_MM = (5.0, 200.0)  # by hand: a unit is suggested where the median is usual for it
# mm per unit, and what files of that unit are.
_UNITS = (
    (1000.0, "in metres"),
    (10.0, "in centimetres"),
    (1.0, "in mm"),
    (0.2, "5000 levels per metre, as TUM's"),
    (0.1, "in tenths of mm"),
    (100.0 / 65535, "16 bits over 100 mm, as C3VD's"),
    (1.0 / 256, "256 levels per mm"),
    (0.01, "in hundredths of mm"),
    (0.001, "in micrometres"),
)
_MOST_SUGGESTED = 3
# By hand: a depth that is cut off at a farthest one has more pixels there, one that is stretched to it a few.
_MOST_AT_THE_LARGEST = 1e-3
_ROUNDED = 1e-5  # of the largest: by hand, what float32 leaves of equal numbers after a few operations
_FEWEST_ALIKE = 3  # files whose largest value may be the same by chance; by hand


def check_values(files: FilesDepth) -> None:
    """Raise `InputError` where a few files hold no positive number, or one number everywhere."""
    known = [array[np.isfinite(array) & (array > 0)] for array in files.samples()]
    if not known:
        return  # none can be read: the first frame says so
    if not any(values.size for values in known):
        raise InputError(
            f"the depth files in {files.folder} hold no positive number: depth and disparity are positive, and 0, NaN "
            "and negative numbers mean unknown; give what the network returned"
        )
    known = [values for values in known if values.size]
    if all(np.ptp(values) == 0 for values in known):
        raise InputError(
            f"the depth files in {files.folder} hold one number everywhere, such as {known[0][0]:g}: they say nothing "
            "of depth; give what the network returned"
        )


def check_common_scale(files: FilesDepth) -> None:
    """Raise `InputError` where each file of depth in mm was stretched to the same range: their scales differ."""
    arrays = [array[np.isfinite(array)].astype(np.float64) for array in files.samples() if np.isfinite(array).any()]
    ranges = np.array([(array.min(), array.max()) for array in arrays])
    if len(arrays) < _FEWEST_ALIKE or (np.ptp(ranges, axis=0) > _ROUNDED * ranges.max()).any():
        return
    if all((array == array.max()).mean() < _MOST_AT_THE_LARGEST for array in arrays):
        low, high = ranges[0]
        raise InputError(
            f"the depth files in {files.folder} each reach from {low:g} to {high:g}: each frame was stretched by "
            "itself, so they are not mm, nor of one scale; give depth as the network returned it, or inverse depth, "
            "whose scale may differ, with --set depth.files_kind=disparity"
        )


def check_unit(files: FilesDepth, near_far_mm: tuple[float, float] | None = None) -> None:
    """Raise `InputError` where the depth of files, in mm by their scale, is none that an endoscope sees.

    near_far_mm : the range of depth that the user states, mm; a median within it is accepted.
    """
    median, (scale_mm, source) = files.median(), files.scale
    low_mm, high_mm = SEEN_MM
    if near_far_mm is not None:
        low_mm, high_mm = min(low_mm, near_far_mm[0]), max(high_mm, near_far_mm[1])
    if not median * scale_mm > 0 or low_mm <= median * scale_mm <= high_mm:
        return
    raise InputError(
        f"the depth files in {files.folder} have a median of {median * scale_mm:.3g} mm, by {scale_mm:g} mm per unit "
        f"({source}), but endoscopes see {SEEN_MM[0]:g} to {SEEN_MM[1]:g} mm: {_remedy(median, scale_mm)}"
    )


def _remedy(median: float, scale_mm: float) -> str:
    """Return which settings would fit, as the end of a sentence."""
    inverted = ((1000.0 / scale_mm, f"{scale_mm:g} levels per metre"), (1.0 / scale_mm, f"{scale_mm:g} levels per mm"))
    units = (*(inverted if scale_mm != 1 else ()), *_UNITS)
    fitting = {mm: f"--set depth.files_scale_mm={mm:.6g} if they are {unit}" for mm, unit in reversed(units)}
    fitting = {mm: fitting[mm] for mm, _ in units if _USUAL_MM[0] <= median * mm <= _USUAL_MM[1]}
    options = list(fitting.values())[:_MOST_SUGGESTED] or [
        "--set depth.files_scale_mm=MM if you know their mm per unit"
    ]
    return ", ".join([*options, "or --set depth.files_kind=depth with --near-far NEAR:FAR if they have no unit"])
