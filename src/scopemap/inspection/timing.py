"""Time stamps: whether pictures come at one rate, in order, without holes, and for as long as the file says."""

from __future__ import annotations

import numpy as np

from scopemap.inspection.clip import Clip
from scopemap.inspection.finding import Finding, worded

_UNEVEN, _UNEVEN_SHARE = 0.2, 0.05
_HOLE = 1.5
_LENGTH_SHARE, _LENGTH_S = 0.05, 1.0
_FAST_HZ, _SLOW_MOTION = 45.0, 0.004


def check_timing(clip: Clip, claimed_s: float | None) -> list[Finding]:
    """Return what is wrong with the time stamps.

    claimed_s : the length that the file's header states, s, or None.
    """
    steps_s = clip.steps_s
    if steps_s.size < 2:
        return []
    back = clip.positions(tuple((int(i) + 1, int(i) + 1) for i in np.flatnonzero(steps_s <= 0)))
    if back:
        message = f"{len(back)} time stamps are not later than the one before (frames {worded(back)})"
        return [
            Finding(
                "warning", "time-order", message, "poses keep their order; take no speeds from the time stamps", back
            )
        ]
    usual_s = float(np.median(steps_s))
    found = [*_holes(clip, steps_s, usual_s), *_length(clip, claimed_s)]
    # A hole is no variable rate.
    rest = np.abs(steps_s[steps_s < _HOLE * usual_s] / usual_s - 1)
    if clip.stamped and (rest > _UNEVEN).mean() > _UNEVEN_SHARE:
        low, high = 1 / np.percentile(steps_s, [95, 5])
        message = f"variable rate: {low:.3g} to {high:.3g} pictures per second, usually {1 / usual_s:.3g}"
        found.append(
            Finding("info", "rate-variable", message, "runs use the time stamps; --fps thins out by them, too")
        )
    if clip.stamped and clip.rate_hz >= _FAST_HZ and np.median(clip["motion"]) < _SLOW_MOTION * clip.step:
        message = f"{clip.rate_hz:.3g} pictures per second, between which hardly anything moves"
        found.append(Finding("info", "rate-high", message, f"--fps {clip.rate_hz / 2:.3g} halves the work"))
    return found


def _holes(clip: Clip, steps_s: np.ndarray, usual_s: float) -> list[Finding]:
    before = np.flatnonzero(steps_s > _HOLE * usual_s)
    if not before.size or before.size > _UNEVEN_SHARE * len(clip):
        return []
    lost = int(np.round((steps_s[before] / usual_s - 1) * np.diff(clip["position"])[before]).sum())
    places = clip.positions(tuple((int(i), int(i) + 1) for i in before))
    what = "time stamps leave" if clip.stamped else "numbers in the names leave"
    message = f"{what} {before.size} hole(s), about {lost} picture(s) were dropped (between frames {worded(places)})"
    return [Finding("warning", "frames-dropped", message, "", places)]


def _length(clip: Clip, claimed_s: float | None) -> list[Finding]:
    if claimed_s is None or not clip.is_whole or not clip.stamped or not clip.rate_hz:
        return []
    times_s = clip["time_s"]
    read_s = float(times_s[-1] - times_s[0]) + 1 / clip.rate_hz
    if abs(read_s - claimed_s) <= max(_LENGTH_S, _LENGTH_SHARE * claimed_s):
        return []
    message = f"the file's header claims {claimed_s:.1f} s, its pictures last {read_s:.1f} s"
    return [
        Finding("warning", "length-claimed", message, "what can be read is used; copy the file anew if it is cut off")
    ]
