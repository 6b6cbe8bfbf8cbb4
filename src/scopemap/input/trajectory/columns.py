"""Columns of text files of poses: which number is what, by the names in their header; and the unit of time stamps.

Names as they are written by EuRoC (`#timestamp [ns],p_RS_R_x [m],...,q_RS_w [],q_RS_x []`; Burri et al., IJRR 2016),
TUM (`# timestamp tx ty tz qx qy qz qw`), ROS (`%time,...,field.pose.pose.position.x,...,orientation.w`), and tables.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from scopemap.engine.errors import InputError

TUM_ORDER: Final = (0, 1, 2, 3, 4, 5, 6, 7)
W_FIRST: Final = (0, 1, 2, 3, 5, 6, 7, 4)
"""Columns of time, tx ty tz and qx qy qz qw where the scalar comes first, as in EuRoC's files."""

_UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]")
_QUATERNION = re.compile(r"q|quat|rot|orient", re.IGNORECASE)
# Names of the first column, the surest first; a table's own count of rows has none.
_TIMES = (re.compile(r"time|stamp", re.IGNORECASE), re.compile(r"frame|index|^t(_[mnu]?s)?$|^id$|^$", re.IGNORECASE))
# Velocity, bias, turn rate, acceleration.
_NO_POSITION = re.compile(r"[vbwag](_|\d|$)|vel|acc|gyr|omega|lin|ang|eul|rpy|bias", re.IGNORECASE)
_LENGTHS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
}
_ENDING = re.compile(r"[_.-]?(x|y|z)[_.-](mm|m)$", re.IGNORECASE)  # tx_mm
_TIME_UNIT = re.compile(r"(?:.*_)?(n|nano|u|µ|micro|m|milli|)s(?:ec|ecs|econds?)?", re.IGNORECASE)
_TIME_PREFIXES = {"": "s", "n": "ns", "nano": "ns", "u": "us", "µ": "us", "micro": "us", "m": "ms", "milli": "ms"}
_MOST_FRAMES = 1e9  # whole seconds since 1970 are more
# Stamps that step by so much count no frames and no seconds: they are microseconds or less.
_LEAST_STEP = 1e4
# Seconds since 1970 have ten digits until 2286; stamps with more are of a smaller unit.
_MOST_SECONDS = 1e11
# Of a video and of its keyframes, s: the ends are 1000 apart, so that one unit alone fits.
_STEPS_S = (2e-3, 2.0)
_POWERS = {"s": 0, "ms": 3, "us": 6, "ns": 9}


@dataclass(frozen=True)
class Columns:
    """What the header of a file says of its columns.

    order : the columns of time, tx ty tz and qx qy qz qw. count : how many there are. unit, time_unit : of lengths and
    stamps; "": not stated.
    """

    order: tuple[int, ...]
    count: int
    unit: str = ""
    time_unit: str = ""

    @property
    def words(self) -> str:
        """The order of the columns where it is another than TUM's, in words."""
        names = ("time", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
        by_column = [name for _, name in sorted(zip(self.order, names, strict=True))]
        return "" if tuple(self.order) == TUM_ORDER else f"columns {' '.join(by_column)} by its header"


def named_columns(line: str) -> Columns | None:
    """Return the columns that a line names; None where it does not name the three of a position and four of a turn.

    Raises `InputError` where it states positions in another unit than m and mm.
    """
    text = line.strip().lstrip("#%/ ").replace("\t", ",").replace(";", ",")
    units = {name: unit.strip() for name, unit in re.findall(r"([\w.]+)\s*[\[(]([^\])]*)[\])]", text)}
    text = _UNIT.sub("", text)
    names = [name.strip().strip("\"'") for name in (text.rstrip(", ").split(",") if "," in text else text.split())]
    for number, name in enumerate(names):
        if ending := _ENDING.search(name):
            names[number] = name[: ending.end(1)]
            units[names[number]] = ending[2].lower()
    axes = {number: (name[:-1].rstrip("_.- "), name[-1:].lower()) for number, name in enumerate(names)}
    scalars = [stem for stem, axis in axes.values() if axis == "w" and _QUATERNION.search(stem)]
    # EuRoC's biases of the gyroscope, b_w_RS_S_x, end in an axis, too, and are no turn.
    places = {(stem.lower(), axis): number for number, (stem, axis) in axes.items()}
    if len(scalars) != 1 or len(places) < len(names) - len([name for name in names if not name]):
        return None
    quaternion = [places.get((scalars[0].lower(), axis)) for axis in "xyzw"]
    stems = [stem.lower() for stem, axis in axes.values() if axis == "x" and stem != scalars[0] and _is_position(stem)]
    positions = [[places.get((stem, axis)) for axis in "xyz"] for stem in stems]
    position = next((one for one in positions if None not in one), [])
    found = [number for number in (*position, *quaternion) if number is not None]
    if len(found) != 7:
        return None
    times = [n for pattern in _TIMES for n, name in enumerate(names) if n not in found and pattern.search(name)]
    without_time = not times and min(found) == 0  # the names of a pose's numbers alone
    time = times[0] if times else 0
    order = (time, *(number + without_time for number in found))
    stated = units.get(names[found[0]], "")
    if stated and stated.lower() not in _LENGTHS:
        raise InputError(f"the header {line.strip()[:80]!r} states positions in {stated[:20]!r}: m and mm are read")
    time_unit = "" if without_time else _time_unit(units.get(names[time], ""), names[time])
    return Columns(order, len(names) + without_time, _LENGTHS.get(stated.lower(), ""), time_unit)


def _is_position(stem: str) -> bool:
    """Return whether a name without its axis may be a position's: t, p_RS_R, field.pose.pose.position."""
    return _NO_POSITION.match(stem.rsplit(".", 1)[-1]) is None


def _time_unit(stated: str, name: str) -> str:
    """Return the unit of time stamps that stands in brackets behind their name, or ends it: timestamp [ns], time_us."""
    found = _TIME_UNIT.fullmatch(stated or (name if "_" in name else ""))
    return "" if found is None else _TIME_PREFIXES[found[1].lower()]


def are_frame_numbers(stamps: np.ndarray) -> bool:
    """Return whether stamps (N,) are whole, small enough to count frames, and near enough to each other."""
    whole = np.all((stamps == np.round(stamps)) & (np.abs(stamps) < _MOST_FRAMES))
    return bool(whole) and not _usual_step(stamps) >= _LEAST_STEP


def stamps_s(stamps: np.ndarray, unit: str = "") -> tuple[np.ndarray, str]:
    """Return time stamps (N,) in s, and their unit in words: the stated one, else what their size and steps tell."""
    found = unit
    if not unit:
        step, most = _usual_step(stamps), float(np.abs(stamps).max(initial=0))
        found = "s"
        if most >= _MOST_SECONDS or step >= _LEAST_STEP:
            by_step = [name for name, p in _POWERS.items() if _STEPS_S[0] <= step / 10**p < _STEPS_S[1]]
            by_size = [name for name, p in _POWERS.items() if most / 10**p < _MOST_SECONDS]
            found = [*by_step, *by_size, "ns"][0]
    words = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}[found]
    return stamps / 10.0 ** _POWERS[found], f"stamps are {words}"


def _usual_step(stamps: np.ndarray) -> float:
    """Return the median step of ascending time stamps; 0 where there is none."""
    return float(np.median(np.diff(np.unique(stamps)))) if len(np.unique(stamps)) > 1 else 0.0
