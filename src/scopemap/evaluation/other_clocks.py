"""Other clocks and counts by which two trajectories may be meant: late, milliseconds, another rate, lines in order.

Whole milliseconds look like frame numbers, a rate of 25 in place of 30 frames/s meets the other's stamps now and then,
and the first line of a KITTI file is frame 0 even where it was written of frames 20 to 49. The poses that match by
chance have figures that look like a method's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from scopemap.engine.errors import AlignmentError
from scopemap.evaluation.clock import fitted_offset, read_later
from scopemap.evaluation.poses import associate, in_milliseconds
from scopemap.input.trajectory.trajectory import Trajectory

ClockReading = tuple[Trajectory, Trajectory, str, str]
"""The two as read by another clock, and in words what that supposes and what to do."""

# A clock that is meant matches more frames than one that is not; by chance (2400 frames, 25 in place of 30 frames/s)
# 60 % match, of milliseconds that are read as frame numbers 3 %.
_MORE = 1.2
_MOST_RATIO = 2.0  # of frame rates that are mistaken for each other: 25, 30, 50, 60
_SAME_RATE = 1e-3
# Offsets that are tried, s. A recorder that starts by hand is a second or two late. All offsets are compared on the
# frames that have a true pose by each: of a clip of 2 s the second leaves enough, of one of 5 s the first.
_MOST_LATE_S = (2.0, 0.6)
# So many frames, spread over the path, tell an offset as well as all, in a fraction of the time.
_FRAMES_TRIED = 300


def clock_readings(estimate: Trajectory, reference: Trajectory) -> Iterator[ClockReading]:
    """Yield other readings of the time stamps or frame numbers of two trajectories, by which more frames match."""
    before = _matched(estimate, reference)
    ways = (_in_milliseconds, _of_another_rate, _in_order)
    for reading in (one for way in ways for one in way(estimate, reference)):
        if _matched(reading[0], reading[1]) > _MORE * before:
            yield reading


def late_readings(estimate: Trajectory, reference: Trajectory, read_s: float = 0.0) -> Iterator[ClockReading]:
    """Yield the truth by a clock that is early or late by an offset that the path tells; nothing where it tells none.

    read_s : so much later the truth is read already, s.
    """
    few = estimate.rows(np.arange(0, len(estimate), math.ceil(len(estimate) / _FRAMES_TRIED)))
    for most_s in _MOST_LATE_S:
        try:
            fit = fitted_offset(few, reference, "sim3", most_s=most_s)
            if fit is None:
                continue
            read = read_later(reference, fit.offset_s)
        except AlignmentError:  # standing still, or too few true poses
            continue
        early = f"{abs(fit.offset_s):.3f} s {'late' if fit.offset_s > 0 else 'early'} (to within {fit.within_s:.3f} s)"
        give = f"give --time-offset {read_s + fit.offset_s:.3f} to scopemap evaluate"
        yield estimate, read, f"the truth's clock may be {early}", give
        return


def _matched(estimate: Trajectory, reference: Trajectory) -> int:
    return len(associate(estimate, reference.rows(reference.tracked))[0])


def _in_milliseconds(estimate: Trajectory, reference: Trajectory) -> Iterator[ClockReading]:
    for whose, is_truth in (("truth", True), ("trajectory", False)):
        pair = (estimate, in_milliseconds(reference)) if is_truth else (in_milliseconds(estimate), reference)
        yield *pair, f"the time stamps of the {whose} may be milliseconds", "say so in its first line, # time: ms"


def _of_another_rate(estimate: Trajectory, reference: Trajectory) -> Iterator[ClockReading]:
    if (estimate.has_indices and reference.has_indices) or min(len(estimate), len(reference)) < 2:
        return
    own_s, true_s = (float(np.median(np.diff(side.times_s))) for side in (estimate, reference))
    if not (min(own_s, true_s) > 0 and 1 / _MOST_RATIO < own_s / true_s < _MOST_RATIO):
        return
    if abs(own_s / true_s - 1) > _SAME_RATE:
        first_s = reference.times_s[0]
        read = replace(reference, times_s=first_s + (reference.times_s - first_s) * own_s / true_s)
        rates = f"{1 / true_s:.4g} poses/s where the trajectory's are {1 / own_s:.4g}"
        yield estimate, read, f"the truth's stamps may be by another frame rate ({rates})", "correct its time stamps"


def _in_order(estimate: Trajectory, reference: Trajectory) -> Iterator[ClockReading]:
    own, true = (side.rows(side.tracked) for side in (estimate, reference))
    if len(own) != len(true) or not (own.has_indices and true.has_indices):
        return
    for whose, side, other in (("truth", true, own), ("trajectory", own, true)):
        if np.array_equal(side.indices, np.arange(len(side))):  # lines that have no numbers of their own
            read = replace(side, indices=other.indices, times_s=other.times_s)
            frames = f"the frames {other.indices[0]} to {other.indices[-1]} of the other, in their order"
            pair = (estimate, read) if whose == "truth" else (read, reference)
            yield *pair, f"the poses of the {whose} may be those of {frames}", "number them so, as lines of TUM"
