"""What is measured by hand in the window: places on the surface become pixels of a frame, as `measure` takes them."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.apps.browser.seen_by import frames_that_saw
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.apps.measure.measure import Measure, measure
from scopemap.engine.errors import InputError
from scopemap.report.page import keep_measurements
from scopemap.report.page_data import checked_measurements, read_measurements
from scopemap.result.json_numbers import without_nan
from scopemap.result.result import Result

_MOST_TRIED = 4
_NUMBERS = ("value", "low", "high")
_STEPS = 16
"""Parts of a line along the surface between two places."""
_LIFT = 0.01
"""By which share of the way to the camera such a line is above the surface, so that it is seen."""


@dataclass(frozen=True)
class Reference:
    """Two places whose straight distance is known, mm, or is the unit (None)."""

    picks: tuple[SurfacePick, SurfacePick]
    length_mm: float | None


@dataclass(frozen=True)
class HandMeasure:
    """What was measured, where, and by which pixels (N, 2) of which frame; world: the places (N, 3), mm.

    folder : of the result, or of its submap, in the whole result's folder: "." or "maps/1".
    """

    folder: str
    frame: int
    pixels: np.ndarray
    reference: np.ndarray | None
    reference_mm: float | None
    found: list[Measure]
    world: np.ndarray

    def command(self, folder: str) -> str:
        """Return the command that gives the same numbers; folder : of the whole result."""
        words = ["scopemap", "measure", shlex.quote(str(Path(folder) / self.folder)), "--frame", str(self.frame)]
        words += ["--points", f'"{pixels_in_words(self.pixels)}"']
        return " ".join([*words, *reference_words(self.reference, self.reference_mm)])

    @property
    def as_json(self) -> dict[str, Any]:
        """As the report keeps it in measurements.json."""
        return {
            "folder": self.folder,
            "frame": self.frame,
            "points": self.pixels.tolist(),
            "reference": None if self.reference is None else self.reference.tolist(),
            "reference_mm": self.reference_mm,
            "found": [without_nan(vars(one)) for one in self.found],
            "command": self.command("."),
            "world": self.world.tolist(),
        }

    @classmethod
    def from_json(cls, kept: dict[str, Any]) -> HandMeasure:
        """Return what measurements.json has of one, as `read_measurements` returns it."""
        known = [
            {name: np.nan if one[name] is None else float(one[name]) for name in _NUMBERS} for one in kept["found"]
        ]
        found = [
            Measure(one["what"], numbers["value"], numbers["low"], numbers["high"], one["unit"], why=one.get("why", ""))
            for one, numbers in zip(kept["found"], known, strict=True)
        ]
        reference = None if kept["reference"] is None else np.array(kept["reference"], float)
        pixels, world = np.array(kept["points"], float), np.array(kept["world"], float).reshape(-1, 3)
        return cls(kept["folder"], kept["frame"], pixels, reference, kept["reference_mm"], found, world)


def measure_by_hand(
    surface: ShownSurface, picks: Sequence[SurfacePick], reference: Reference | None = None
) -> HandMeasure:
    """Return the distance of two places on a surface, or the area between more, as `scopemap measure` finds it.

    It is measured in the frame that saw all of the places, and those of the reference, best. Raises `InputError` where
    no frame did, and as `measure`.
    """
    ends = [] if reference is None else list(reference.picks)
    seen = frames_that_saw(surface, [*picks, *ends])
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


def rounded(pixels: np.ndarray) -> np.ndarray:
    """Return pixels as a command states them: tenths."""
    return np.round(np.asarray(pixels, float), 1) + 0.0


def pixels_in_words(pixels: np.ndarray) -> str:
    """Return pixels as the options of `measure` take them, "x,y x,y"."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in np.asarray(pixels).tolist())


def reference_words(reference: np.ndarray | None, length_mm: float | None) -> list[str]:
    """Return the options of `measure` for a reference."""
    if reference is None:
        return []
    length = [] if length_mm is None else ["--reference-mm", f"{length_mm:g}"]
    return ["--reference", f'"{pixels_in_words(reference)}"', *length]


def broken(command: str) -> str:
    """Return a command in lines, each with an option, as a terminal takes them."""
    return command.replace(" --", " \\\n  --")


def folder_in_whole(run: Result) -> str:
    """Return where a submap is in the whole result: "maps/1", or "." for the result itself."""
    return f"maps/{run.folder.resolve().name}" if run.is_submap else "."


def kept_measures(folder: Path) -> list[HandMeasure]:
    """Return what was measured by hand and kept in a result's folder."""
    return [HandMeasure.from_json(one) for one in read_measurements(folder)]


def remove_measurement(folder: Path, gone: HandMeasure) -> None:
    """Remove a measurement from those kept in a result's folder. Raises `InputError` where they cannot be written."""
    (same,) = checked_measurements(json.dumps([gone.as_json]).encode())
    keep_measurements(folder, json.dumps([one for one in read_measurements(folder) if one != same]).encode())


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


def add_measurements(folder: Path, measured: Sequence[HandMeasure]) -> int:
    """Put measurements to those kept in a result's folder, each once; return how many are kept then."""
    kept = read_measurements(folder)
    new = checked_measurements(json.dumps([one.as_json for one in measured]).encode())
    kept += [one for one in new if one not in kept]
    keep_measurements(folder, json.dumps(kept).encode())
    return len(kept)
