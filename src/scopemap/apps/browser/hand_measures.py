"""What is measured by hand in the window: places on the surface become pixels of a frame, as `measure` takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scopemap.apps.browser.seen_by import Sight, frames_that_saw, pose_of
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.apps.measure.hand_measure import HandMeasure, rounded
from scopemap.apps.measure.measure import check_reference, measure
from scopemap.engine.errors import InputError
from scopemap.report.measured_by_hand import folder_in_whole, is_reference
from scopemap.result.result import Result

_MOST_TRIED = 4
_STEPS = 16
"""Parts of a line along the surface between two places."""
_LIFT = 0.01
"""By which share of the way to the camera such a line is above the surface, so that it is seen."""


@dataclass(frozen=True)
class Reference:
    """Two places whose straight distance is known, mm, or is the unit (None)."""

    picks: tuple[SurfacePick, SurfacePick]
    length_mm: float | None


def reference_as_kept(surface: ShownSurface, reference: Reference) -> HandMeasure:
    """Return a reference as it is kept; raises `InputError` where no frame saw both of its ends, or it is too short."""
    sight = frame_of_reference(surface, reference)
    check_reference(sight.pixels)
    world = np.array([surface.position(pick) for pick in reference.picks])
    folder, pixels = folder_in_whole(surface.run), rounded(sight.pixels)
    return HandMeasure(folder, sight.frame, pixels, None, reference.length_mm, [], world, "reference")


def frame_of_reference(surface: ShownSurface, reference: Reference, first: int | None = None) -> Sight:
    """Return the frame that saw both ends of a reference best, or `first` where that saw them.

    Raises `InputError` where none did.
    """
    seen = frames_that_saw(surface, reference.picks, first)
    if not seen:
        raise InputError("no frame saw both ends of the reference: choose another one")
    return next((sight for sight in seen if sight.frame == first), seen[0])


def kept_reference(surface: ShownSurface, kept: Sequence[HandMeasure]) -> Reference | None:
    """Return the reference of a surface among what is kept of its result; None where there is none, or no more."""
    for one in kept:
        if one.kind == "reference" and is_on(surface, one):
            eye = pose_of(surface.run, one.frame)[:3, 3]
            first, second = (surface.pick(eye, place - eye) for place in one.world)
            return None if first is None or second is None else Reference((first, second), one.reference_mm)
    return None


def is_on(surface: ShownSurface, one: HandMeasure) -> bool:
    """Return whether a measurement, or a reference, was made on a surface."""
    run = surface.run
    is_here = one.folder == folder_in_whole(run) and one.frame in run.tracked["index"]
    return bool(is_here and run.segment_at(one.frame) == surface.segment)


def submap_of(whole: Result, one: HandMeasure) -> int | None:
    """Return the number of the submap that a measurement of a whole result was made in; None: it is there no more."""
    found = (number for number, run in enumerate(whole.submaps) if folder_in_whole(run) == one.folder)
    return next((number for number in found if one.frame in whole.submaps[number].tracked["index"]), None)


def part_words(whole: Result, one: HandMeasure) -> str:
    """Return the time of the surface that a measurement was made on, "3.1 to 5.2 s"; in words where that is gone."""
    if (number := submap_of(whole, one)) is None:
        return "another part of the video"
    run = whole.submaps[number]
    if len(run.segments) > 1:
        return run.segments[run.segment_at(one.frame)].words
    times_s = run.tracked["time_s"]
    return f"{times_s[0]:.1f} to {times_s[-1]:.1f} s"


def is_by(surface: ShownSurface, one: HandMeasure, reference: Reference | None) -> bool:
    """Return whether a measurement on a surface was made by a reference, or by none."""
    if one.reference is None:
        return True
    frame = one.frame if one.reference_frame is None else one.reference_frame
    is_here = one.folder == folder_in_whole(surface.run)
    if reference is None or reference.length_mm != one.reference_mm or not is_here:
        return False
    ends = np.array([surface.position(pick) for pick in reference.picks])
    return is_reference(surface.run, frame, one.reference, ends)


def measure_by_hand(
    surface: ShownSurface, picks: Sequence[SurfacePick], reference: Reference | None = None, first: int | None = None
) -> HandMeasure:
    """Return the distance of two places on a surface, or the area between more, as `scopemap measure` finds it.

    It is measured in the frame `first` where that saw all of the places, and those of the reference, else in the frame
    that saw them best. Raises `InputError` where no frame did, and as `measure`.
    """
    ends = [] if reference is None else list(reference.picks)
    seen = sorted(frames_that_saw(surface, [*picks, *ends], first), key=lambda sight: sight.frame != first)
    if not seen:
        also = " and the reference" if ends else ""
        raise InputError(f"no frame saw all of these points{also}: choose points that are nearer to each other")
    length_mm = None if reference is None else reference.length_mm
    fault: InputError | None = None
    for sight in seen[:_MOST_TRIED]:
        pixels = rounded(sight.pixels)
        own, known = pixels[: len(picks)], pixels[len(picks) :] if ends else None
        try:
            found = measure(surface.run.folder, sight.frame, own, known, length_mm)
        except InputError as error:
            fault = fault or error
            continue
        world = np.array([surface.position(pick) for pick in picks])
        return HandMeasure(folder_in_whole(surface.run), sight.frame, own, known, length_mm, found, world)
    raise fault or InputError("these points cannot be measured")


def broken(command: str) -> str:
    """Return a command in lines, each with an option, as a terminal takes them."""
    return command.replace(" --", " \\\n  --")


def line_on_surface(surface: ShownSurface, frame: int, places: np.ndarray) -> np.ndarray:
    """Return the line (M, 3) on a surface that a frame sees as straight between places (N, 3); of more than two closed.

    Where the surface has a gap, it is straight in space. Places are as they are in the result.
    """
    closed = np.concatenate([places, places[: int(len(places) > 2)]])
    shares = np.linspace(0, 1, _STEPS + 1)[:, None]
    points = np.concatenate([first + shares * (last - first) for first, last in pairwise(closed)])
    tracked = surface.run.tracked
    row = np.flatnonzero(tracked["index"] == frame)
    if not len(row):
        return points
    eye, line = tracked["T_world_camera"][row[0]][:3, 3], []
    for point in points:
        met = surface.pick(eye, point - eye)
        on = point if met is None else surface.position(met)
        line.append(on + _LIFT * (eye - on))
    return np.array(line)
