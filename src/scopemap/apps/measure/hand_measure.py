"""What was measured by hand on a result, and is kept beside it: by which pixels of which frame, and what was found."""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scopemap.apps.measure.measure import Measure
from scopemap.apps.measure.surface_finding import SurfaceFinding
from scopemap.report.measured_by_hand import EARLIER, checked_measurements, read_measurements
from scopemap.report.page import keep_measurements
from scopemap.result.json_numbers import without_nan

Kind = Literal["measure", "lesion", "reference"]
_NUMBERS = ("value", "low", "high")


@dataclass(frozen=True)
class HandMeasure:
    """What was measured, where, and by which pixels (N, 2) of which frame; world: the places (N, 3), mm.

    folder : of the result, or of its submap, in the whole result's folder: "." or "maps/1". kind : "measure" is a
    distance or an area; a "reference" has the length `reference_mm` between its two pixels, and found nothing.
    reference_frame : of the reference's pixels where that is another frame. name : as it was given; "": none.
    """

    folder: str
    frame: int
    pixels: np.ndarray
    reference: np.ndarray | None
    reference_mm: float | None
    found: list[Measure]
    world: np.ndarray
    kind: Kind = "measure"
    name: str = ""
    reference_frame: int | None = None

    def command(self, folder: str) -> str:
        """Return the command that gives the same numbers, "" for a reference; folder : of the whole result."""
        if self.kind == "reference":
            return ""
        words = ["scopemap", "measure", shlex.quote(str(Path(folder) / self.folder)), "--frame", str(self.frame)]
        option = "--lesion" if self.kind == "lesion" else "--points"
        words += [option, f'"{pixels_in_words(self.pixels)}"']
        if self.reference is not None:
            words += ["--reference", f'"{pixels_in_words(self.reference)}"']
            words += [] if self.reference_mm is None else ["--reference-mm", f"{self.reference_mm:g}"]
            words += [] if self.reference_frame is None else ["--reference-frame", str(self.reference_frame)]
        return " ".join(words)

    @property
    def as_json(self) -> dict[str, Any]:
        """As measurements.json keeps it."""
        return {
            "kind": self.kind,
            "name": self.name,
            "folder": self.folder,
            "frame": self.frame,
            "points": self.pixels.tolist(),
            "reference": None if self.reference is None else self.reference.tolist(),
            "reference_mm": self.reference_mm,
            "reference_frame": self.reference_frame,
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
            Measure(one["what"], numbers["value"], numbers["low"], numbers["high"], one["unit"], why=one["why"])
            for one, numbers in zip(kept["found"], known, strict=True)
        ]
        return cls(
            kept["folder"],
            kept["frame"],
            np.array(kept["points"], float),
            None if kept["reference"] is None else np.array(kept["reference"], float),
            kept["reference_mm"],
            found,
            np.array(kept["world"], float).reshape(-1, 3),
            kept["kind"],
            kept["name"],
            kept["reference_frame"],
        )

    def __str__(self) -> str:
        """What was found, in a line, with its name and frame."""
        if self.kind == "reference":
            length = "of unknown length" if self.reference_mm is None else f"{self.reference_mm:g} mm long"
            return f"reference, {length} (frame {self.frame})"
        name = f"{self.name}: " if self.name else ""
        # A lesion has five figures: what widens each is left to the command.
        known = [replace(one, why="") for one in self.found] if self.kind == "lesion" else self.found
        found = "; ".join(str(one).replace(" (", ", 95 % interval ").rstrip(")") for one in known)
        return f"{name}{found} (frame {self.frame})"


def rounded(pixels: np.ndarray) -> np.ndarray:
    """Return pixels as a command states them: tenths."""
    return np.round(np.asarray(pixels, float), 1) + 0.0


def pixels_in_words(pixels: np.ndarray) -> str:
    """Return pixels as the options of `measure` take them, "x,y x,y"."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in np.asarray(pixels).tolist())


def kept_measures(folder: Path) -> list[HandMeasure]:
    """Return what was measured by hand and kept in a whole result's folder, references too."""
    return [HandMeasure.from_json(one) for one in read_measurements(folder)]


def add_measurement(folder: Path, one: HandMeasure) -> None:
    """Put a measurement to those kept in a result's folder, once; a result, and each submap, has one reference.

    Raises `InputError` where they cannot be written.
    """
    (new,) = checked_measurements(json.dumps([one.as_json]).encode())
    kept = [other for other in read_measurements(folder) if other != new]
    if one.kind == "reference":
        kept = _without_reference(kept, one.folder)
    _write(folder, [*kept, new])


def remove_measurement(folder: Path, gone: HandMeasure) -> None:
    """Remove a measurement from those kept in a result's folder. Raises `InputError` where they cannot be written."""
    (same,) = checked_measurements(json.dumps([gone.as_json]).encode())
    _write(folder, [one for one in read_measurements(folder) if one != same])


def remove_reference(folder: Path, of: str) -> None:
    """Remove the reference of a result, ".", or of a submap, "maps/1", where one is kept in a result's folder."""
    kept = read_measurements(folder)
    if len(left := _without_reference(kept, of)) < len(kept):
        _write(folder, left)


def as_csv(measured: Sequence[HandMeasure], earlier: Sequence[bool]) -> str:
    """Return what was measured as a table, a row for each figure, of three digits.

    measured : without references. earlier : for each whether its reference was changed or forgotten since.
    """
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(("number", "name", "folder", "frame", "what", "value", "low", "high", "unit", "pixels", "note"))
    for number, (one, is_earlier) in enumerate(zip(measured, earlier, strict=True), start=1):
        note = EARLIER if is_earlier else ""
        for found in one.found:
            known = (found.value, found.low, found.high)
            figures = [f"{float(f'{value:.3g}'):.15g}" if np.isfinite(value) else "" for value in known]
            where = (one.name, one.folder, one.frame)
            table.writerow((number, *where, found.what, *figures, found.unit, pixels_in_words(one.pixels), note))
    return text.getvalue()


def findings_of(kept: Sequence[HandMeasure]) -> list[SurfaceFinding]:
    """Return what was measured, for `write_findings`; distances across a gap of the surface are left out."""
    found = []
    for number, one in enumerate((one for one in kept if one.kind != "reference"), start=1):
        sizes = [size for size in one.found if np.isfinite(size.value)]
        found += [SurfaceFinding(one.name or f"{one.kind} {number}", one.world, sizes)] if sizes else []
    return found


def _without_reference(kept: list[dict[str, Any]], of: str) -> list[dict[str, Any]]:
    return [one for one in kept if (one["kind"], one["folder"]) != ("reference", of)]


def _write(folder: Path, kept: list[dict[str, Any]]) -> None:
    keep_measurements(folder, json.dumps(kept).encode())
