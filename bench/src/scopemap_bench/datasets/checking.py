"""Faults of a data set, by the figures of one pass over it (`survey`).

Each check takes a `Survey` and returns findings. An error makes results wrong or impossible, a warning should be looked
at, an info states what was assumed. Thresholds are for endoscopy: centimetres of depth, steps of a few mm at most.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from scopemap.apps.inspect.clip import Finding, Severity
from scopemap.engine.errors import CalibrationError, ScopemapError
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad
from scopemap.input.decoding import frame_number
from scopemap.result.wording import in_words
from scopemap_bench.datasets.survey import (
    OTHERS,
    RIGID_TOLERANCE,
    Agreement,
    Survey,
    deviation,
    extent_mm,
    positions_of,
)

_NAMED = 3
_TIME_STAMP = re.compile(r"\d\.\d")
_BLACK_LEVEL = 16.0
_LEAST_SPREAD = 1.0
_UNEVEN = 0.5
_ASPECT_TOLERANCE = 0.1
_FOCAL_WIDTHS = (0.2, 5.0)
_MIDDLE = (0.25, 0.75)
_JUMP = 10.0
_JUMP_DEG = 30.0
_SMALLEST_JUMP_MM = 0.5
_AROUND = 5
_LARGEST_STEP_MM = 50.0
_LARGEST_EXTENT_MM = 10_000.0
_SMALLEST_STEP_MM = 0.005
_SMALLEST_EXTENT_MM = 1.0
_STILL_MM = 1e-6
_STILL_RAD = 1e-6
_DEPTH_MM = (1.0, 1000.0)
_ROOMS = ("7-scenes", "tum")
_ROOM_MM = 10_000.0
_MOST_UNKNOWN = 0.95
_COARSE = 256
_COUNTED_IN = 4 * _COARSE
_LARGEST_ERROR = 0.1
_SMALLEST_ERROR = 0.005
_FAR_BETTER = 4.0
_OUTLYING = 0.05
_OUTLYING_TIMES = 8.0
_OTHER_DEPTH_TIMES = 30.0


def check(survey: Survey) -> list[Finding]:
    """Return what every check finds, errors first."""
    found = [finding for one in CHECKS for finding in one(survey)]
    return sorted(found, key=lambda finding: ("error", "warning", "info").index(finding.severity))


def refusal(error: ScopemapError) -> Finding:
    """Return the finding that an input could not even be opened."""
    return Finding("error", "camera-refused" if isinstance(error, CalibrationError) else "refused", str(error))


def check_reading(survey: Survey) -> list[Finding]:
    """Errors while reading, frames that are announced but cannot be read, and the reader's own warnings."""
    found = _when(bool(survey.stopped), "error", "reading-stopped", survey.stopped)
    if survey.truth_faults:
        first, *others = survey.truth_faults
        more = f" (and {len(others)} more such errors)" if others else ""
        found.append(Finding("error", "truth-unreadable", first + more))
    if not survey.stopped:
        missing = sorted(set(survey.announced or []) - {frame.index for frame in survey.frames})
        found += _about(missing, "frame-unreadable", "cannot be read: {}")
        count = len(survey.frames)
        found += _when(count < 2, "error", "frame-few", f"{count} readable frame(s), two are needed")
    warnings = survey.sequence.warnings
    more_warnings = [f"and {len(warnings) - _NAMED} more warnings of the reader"] * (len(warnings) > _NAMED)
    return found + [Finding("warning", "source", in_words(warning)) for warning in warnings[:_NAMED] + more_warnings]


def check_numbers(survey: Survey) -> list[Finding]:
    """Gaps, repetitions and disorder of the frames' numbers, and of those in the names where frames are counted."""
    numbers = np.array(survey.announced or [frame.index for frame in survey.frames], dtype=np.int64)
    found = _numbers_in_names(survey, numbers)
    steps = np.diff(numbers)
    if not steps.size:
        return found
    usual = Counter(steps.tolist()).most_common(1)[0][0]
    found += _about(numbers[:-1][steps < 0], "number-unsorted", "numbers go back after {}", "error")
    found += _about(_repeated(numbers.tolist()), "number-repeated", "there more than once: {}", "error")
    found += _about(numbers[:-1][steps > max(usual, 1)], "number-gap", "numbers are missing after {}")
    return found + _when(usual > 1, "info", "number-step", f"frames are numbered in steps of {usual}")


def check_frames(survey: Survey) -> list[Finding]:
    """Black frames, frames of one colour, frames that repeat the one before."""
    black = [f.index for f in survey.frames if f.brightest < _BLACK_LEVEL]
    lit = [f for f in survey.frames if f.brightest >= _BLACK_LEVEL]
    return [
        *_about(black, "frame-black", "black: {}"),
        *_about([f.index for f in lit if f.spread < _LEAST_SPREAD], "frame-constant", "of one colour: {}"),
        *_about([f.index for f in lit if f.is_repeat], "frame-repeated", "the same picture as before: {}"),
    ]


def check_times(survey: Survey) -> list[Finding]:
    """Time stamps that do not increase, or not evenly."""
    numbers, times_s = (np.array([getattr(f, key) for f in survey.frames]) for key in ("index", "time_s"))
    steps_s = np.diff(times_s)
    wrong = ~(steps_s > 0)
    if wrong.any() or not steps_s.size:
        return _about(numbers[:-1][wrong], "time-order", "time does not increase after {}", "error")
    rates_s = steps_s / np.maximum(np.diff(numbers), 1)
    median_s = float(np.median(rates_s))
    uneven = np.abs(rates_s / median_s - 1) > _UNEVEN
    words = f"time to the next is not half to one and a half of the usual {1000 * median_s:.4g} ms: {{}}"
    return _about(numbers[:-1][uneven], "time-irregular", words)


def check_camera(survey: Survey) -> list[Finding]:
    """Whether a stated camera can be one of an endoscope."""
    camera = survey.sequence.rectifier.source.central
    if not survey.sequence.calibrated:
        return [Finding("info", "camera-assumed", "no calibration was found: the focal length is a guess (--camera)")]
    size, point = f"images of {camera.width}x{camera.height} px", f"{camera.cx:.4g}, {camera.cy:.4g} px"
    widths, lengths = camera.fx / camera.width, f"focal lengths {camera.fx:.4g} and {camera.fy:.4g} px"
    centre = ((camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height)
    aspect = camera.fy / camera.fx / survey.sequence.source.pixel_aspect
    return [
        *_when(not _FOCAL_WIDTHS[0] <= widths <= _FOCAL_WIDTHS[1], "error", "camera-focal",
               f"a focal length of {camera.fx:.4g} px does not fit {size}: it is {widths:.2g} of their width"),
        *_when(not all(_MIDDLE[0] <= share <= _MIDDLE[1] for share in centre), "warning", "camera-centre",
               f"the principal point {point} is outside the middle half of {size}"),
        *_when(abs(aspect - 1) > _ASPECT_TOLERANCE, "warning", "camera-aspect",
               f"{lengths} differ by more than a tenth: are pixels square?"),
    ]  # fmt: skip


def check_poses(survey: Survey) -> list[Finding]:
    """Frames without a pose, and poses that are no rigid motions."""
    posed = [(frame.index, frame.T_world_camera) for frame in survey.frames if frame.T_world_camera is not None]
    finite = [(index, T) for index, T in posed if np.isfinite(T).all()]
    odd = [index for index, T in posed if not np.isfinite(T).all()]
    left = [index for index, T in finite if np.linalg.det(T[:3, :3]) < 0]
    bent = [index for index, T in finite if index not in set(left) and deviation(T) > RIGID_TOLERANCE]
    return [
        *_missing(survey, [index for index, _ in posed], "pose"),
        *_about(odd, "pose-not-finite", "the pose holds NaN or infinity: {}", "error"),
        *_about(left, "pose-left-handed", "the pose is left-handed (negative determinant): {}", "error"),
        *_about(bent, "pose-not-rigid", "the pose is no rigid motion (scaled, sheared, transposed): {}", "error"),
    ]


def check_path(survey: Survey) -> list[Finding]:
    """Jumps of the camera, and sizes of its path that indicate wrong units."""
    frames = survey.rigid
    if len(frames) < 2:
        return []
    numbers = np.array([frame.index for frame in frames])
    apart = np.maximum(np.diff(numbers), 1)
    positions_mm = positions_of(frames)
    steps_mm = np.linalg.norm(np.diff(positions_mm, axis=0), axis=1) / apart
    poses = np.stack([frame.T_world_camera for frame in frames if frame.T_world_camera is not None])
    turns_rad = rotation_angle_rad((inverse(poses[:-1]) @ poses[1:])[:, :3, :3]) / apart
    extent = extent_mm(positions_mm)
    if extent < _STILL_MM and turns_rad.max() < _STILL_RAD:
        return [Finding("warning", "pose-still", "the camera does not move: all poses are the same")]
    moving_mm = steps_mm[steps_mm > 0]
    median_mm = float(np.median(moving_mm)) if moving_mm.size else 0.0
    far, turned = numbers[1:][_jumps(steps_mm, median_mm)], numbers[1:][turns_rad > np.radians(_JUMP_DEG)]
    return [
        *_path_unit(median_mm, extent),
        *_about(far, "pose-jump", f"the camera jumps, more than {_JUMP:g} times the usual {median_mm:.3g} mm, to {{}}"),
        *_about(turned, "pose-turn", f"the camera turns by more than {_JUMP_DEG:g} deg to {{}}"),
    ]


def check_depth(survey: Survey) -> list[Finding]:
    """Frames without depth, and depth that is empty, flat, coarse, impossible or of another unit."""
    known = [(frame.index, frame.depth) for frame in survey.frames if frame.depth is not None]
    full = [(index, depth) for index, depth in known if depth.known_count]
    usual_mm = float(np.median([depth.median_mm for _, depth in full])) if full else _DEPTH_MM[0]
    coarse = [i for i, d in full if not d.is_constant and d.distinct < _COARSE and d.known_count >= _COUNTED_IN]
    times = _OTHER_DEPTH_TIMES
    jumps = [i for i, depth in full if not 1 / times < depth.median_mm / usual_mm < times]
    return [
        *_missing(survey, [index for index, _ in known], "depth"),
        *_about([i for i, d in known if d.impossible_share > 0], "depth-impossible",
                "depth is infinite, zero or negative in places: {}", "error"),
        *_about([i for i, d in known if 1 - d.known_share > _MOST_UNKNOWN], "depth-unknown",
                f"depth is unknown in more than {_MOST_UNKNOWN:.0%} of the pixels: {{}}"),
        *_about([i for i, d in full if d.is_constant], "depth-constant", "depth is the same everywhere: {}"),
        *_about(coarse, "depth-coarse",
                f"depth has fewer than {_COARSE} different values, as of 8 bit or whole units: {{}}"),
        *_depth_unit(usual_mm, survey.sequence.source.name in _ROOMS),
        *_about(jumps, "depth-jump",
                f"the median depth is {times:g} times that of the others, or a {times:g}th: {{}}, of another unit?"),
    ]  # fmt: skip


def check_agreement(survey: Survey) -> list[Finding]:
    """Whether depth fits depth through the poses, and whether it would fit far better by another convention."""
    if not survey.agreements:
        return []
    near, *later = survey.agreements
    # Frames far apart may well see nothing in common.
    for agreement in [near, *(one for one in later if np.isfinite(one.given))]:
        found = _better(agreement)
        if found:
            return found
    if not np.isfinite(near.given):
        return [Finding("warning", "pose-depth-apart", "by the poses, frames close in time show no surface in common")]
    still = near.given > _SMALLEST_ERROR and near.at_rest < near.given / _FAR_BETTER
    if still or near.given > _LARGEST_ERROR:
        rest = f", {near.at_rest:.2%} if nothing moved" if near.at_rest < near.given else ""
        off = f"depth moved by the poses is off by {near.given:.2%}{rest}"
        return [Finding("error", "pose-depth-disagree", f"{off}: poses, depth or camera do not belong together")]
    limit = max(_OUTLYING, _OUTLYING_TIMES * near.given)
    outlying = [index for index, error in survey.depth_errors.items() if error > limit]
    words = f"depth moved by the poses is off by more than {limit:.2%}, usually by {near.given:.2%}: {{}}"
    return _about(outlying, "pose-depth-frame", words)


def check_assumptions(survey: Survey) -> list[Finding]:
    """What the reader assumed."""
    return [Finding("info", "assumed", in_words(note)) for note in survey.sequence.notes]


CHECKS = (
    *(check_reading, check_numbers, check_frames, check_times, check_camera),
    *(check_poses, check_path, check_depth, check_agreement, check_assumptions),
)


def _repeated(numbers: list[int]) -> list[int]:
    return [number for number, times in Counter(numbers).items() if times > 1]


def _numbers_in_names(survey: Survey, numbers: np.ndarray) -> list[Finding]:
    """Names whose numbers repeat or go back make a reader count: poses and depth then belong to positions."""
    names = [frame.name for frame in survey.frames]
    own = [number for name in names if (number := frame_number(Path(name))) is not None]
    counted = np.array_equal(numbers, np.arange(len(numbers))) and not any(_TIME_STAMP.search(name) for name in names)
    if not counted or len(own) < len(names):
        return []
    effect = "so frames are counted, and a pose or depth by number may belong to another"
    repeated = _repeated(own)
    if not repeated and (np.diff(own) < 0).any():
        return [Finding("error", "number-unsorted", f"numbers in the names go back, {effect}")]
    return _about(repeated, "number-repeated", f"names repeat the number of {{}}, {effect}", "error")


def _better(agreement: Agreement) -> list[Finding]:
    """Return the convention that fits far better than the poses as given, and than no motion at all."""
    best = int(np.argmin(agreement.others))
    error, other = agreement.given, agreement.others[best]
    limit = min(error / _FAR_BETTER, agreement.at_rest / _FAR_BETTER, _LARGEST_ERROR)
    if error <= _SMALLEST_ERROR or other >= limit:
        return []
    given = f"to {error:.2%}" if np.isfinite(error) else "nowhere"
    fits = f"so, depth fits depth to {other:.2%}, as given {given}"
    return [Finding("error", OTHERS[best].code, f"the poses look like {OTHERS[best].looks_like}: {fits}")]


def _jumps(steps_mm: np.ndarray, usual_mm: float) -> np.ndarray:
    """Return where a step (n,) is far longer than is usual, and than those around it: a camera at rest trembles."""
    far = steps_mm > max(_JUMP * usual_mm, _SMALLEST_JUMP_MM)
    for at in np.flatnonzero(far):
        around_mm = steps_mm[max(at - _AROUND, 0) : at + _AROUND + 1]
        far[at] = steps_mm[at] > _JUMP * np.median(around_mm)
    return far


def _path_unit(median_mm: float, extent: float) -> list[Finding]:
    size = f"steps of {median_mm:.2g} mm, {extent:.2g} mm from end to end"
    is_large = median_mm > _LARGEST_STEP_MM or extent > _LARGEST_EXTENT_MM
    is_small = 0 < median_mm < _SMALLEST_STEP_MM and extent < _SMALLEST_EXTENT_MM
    return [
        *_when(is_large, "warning", "pose-unit", f"the path is too large ({size}): it looks like micrometres"),
        *_when(is_small, "warning", "pose-unit", f"the path is too small ({size}): it looks like metres"),
    ]


def _depth_unit(median_mm: float, is_room: bool) -> list[Finding]:
    if _DEPTH_MM[0] <= median_mm <= _DEPTH_MM[1]:
        return []
    if is_room and _DEPTH_MM[1] < median_mm <= _ROOM_MM:
        return [Finding("info", "depth-unit", f"a median depth of {median_mm:.4g} mm is that of a room: no endoscopy")]
    unit = "metres" if median_mm < _DEPTH_MM[0] else "micrometres, or no endoscopy"
    return [Finding("warning", "depth-unit", f"a median depth of {median_mm:.4g} mm looks like {unit}")]


def _missing(survey: Survey, known: list[int], what: str) -> list[Finding]:
    """Frames without truth: a fault where they are few, an info where most have none."""
    without = sorted({frame.index for frame in survey.frames} - set(known)) if known else []
    severity: Severity = "warning" if 2 * len(known) >= len(survey.frames) else "info"
    message = f"{len(without)} of {len(survey.frames)} frames have no {what}: {{}}"
    return _about(without, f"{what}-missing", message, severity)


def _when(holds: bool, severity: Severity, code: str, message: str) -> list[Finding]:
    return [Finding(severity, code, message)] if holds else []


def _about(numbers: Iterable[int], code: str, message: str, severity: Severity = "warning") -> list[Finding]:
    """Return one finding about the frames with these numbers, none where there are none."""
    chosen = [int(number) for number in numbers]
    if not chosen:
        return []
    named = ", ".join(map(str, chosen[:_NAMED])) + ", ..." * (len(chosen) > _NAMED)
    frames = f"frame {chosen[0]}" if len(chosen) == 1 else f"{len(chosen)} frames ({named})"
    return [Finding(severity, code, message.format(frames))]
