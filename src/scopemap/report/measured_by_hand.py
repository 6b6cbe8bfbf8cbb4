"""What was measured by hand in the window, as measurements.json keeps it beside the result."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError

from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.result.result import Result

MEASUREMENTS = "measurements.json"
EARLIER = "by an earlier reference"
"""What is said beside sizes whose reference was changed or forgotten."""
_SAME_PX = 0.15
"""Pixels are kept in tenths."""
_SIZES = re.compile(r"Sizes .*$")
"""What a verdict's advice says of sizes: its end."""


class _Value(BaseModel):
    what: str
    value: float | None
    low: float | None
    high: float | None
    unit: str
    why: str = ""


class _ByHand(BaseModel):
    """One measurement, lesion or reference; the ends of a reference are its points, its length is `reference_mm`."""

    kind: Literal["measure", "lesion", "reference"] = "measure"
    name: str = ""
    folder: str
    frame: int
    points: list[tuple[float, float]]
    reference: list[tuple[float, float]] | None
    reference_mm: float | None
    reference_frame: int | None = None
    found: list[_Value]
    command: str
    world: list[tuple[float, float, float]]


def folder_in_whole(run: Result) -> str:
    """Return where a submap is in the whole result: "maps/1", or "." for the result itself."""
    return f"maps/{run.folder.resolve().name}" if run.is_submap else "."


def checked_measurements(text: bytes) -> list[dict[str, Any]]:
    """Return what is kept of measuring by hand, from its JSON; raises `ValueError` where it is anything else."""
    try:
        return [one.model_dump() for one in TypeAdapter(list[_ByHand]).validate_json(text)]
    except ValidationError:
        raise ValueError("it is no list of measurements") from None


def read_measurements(folder: Path) -> list[dict[str, Any]]:
    """Return what was measured by hand and kept beside the result; [] where nothing was, or it is damaged."""
    try:
        return checked_measurements((folder / MEASUREMENTS).read_bytes())
    except (OSError, ValueError):
        return []


def sizes_by(length_mm: float | None) -> str:
    """Return what sizes are by a reference of a length, mm, or of an unknown one, as a sentence."""
    if length_mm is None:
        return "Sizes are in multiples of your reference."
    return f"Sizes are in mm by your reference ({length_mm:g} mm)."


def advice_with_sizes(advice: str, words: str) -> str:
    """Return a verdict's advice with another sentence in place of what it says of sizes."""
    return _SIZES.sub(words, advice)


def advice_by_reference(advice: str, kept: Sequence[dict[str, Any]]) -> str:
    """Return a verdict's advice, with sizes by the reference that is kept for the result itself; as it is for none."""
    known = [one for one in kept if one["kind"] == "reference" and one["folder"] == "."]
    return advice_with_sizes(advice, sizes_by(known[-1]["reference_mm"])) if known else advice


def is_reference(run: Result, frame: int, pixels: np.ndarray, ends: np.ndarray) -> bool:
    """Return whether pixels (2, 2) of a frame are those of two places (2, 3) of a submap; False without a pose."""
    tracked = run.tracked
    pose = tracked["T_world_camera"][tracked["index"] == frame]
    if not len(pose):
        return False
    return bool((np.abs(run.camera.project(transform(inverse(pose[0]), ends)) - pixels) < _SAME_PX).all())


def earlier_references(run: Result, measured: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> list[bool]:
    """Return for each of what was measured in a whole result whether its reference is not the one that is kept.

    measured, kept : as `read_measurements` returns them; of `kept` the references count.
    """
    submaps = {folder_in_whole(one): one for one in run.submaps}
    references = {one["folder"]: one for one in kept if one["kind"] == "reference" and len(one["world"]) == 2}

    def is_earlier(one: dict[str, Any]) -> bool:
        if one["kind"] == "reference" or one["reference"] is None:
            return False
        now, submap = references.get(one["folder"]), submaps.get(one["folder"])
        if now is None or submap is None or now["reference_mm"] != one["reference_mm"]:
            return True
        frame = one["frame"] if one["reference_frame"] is None else one["reference_frame"]
        return not is_reference(submap, frame, np.array(one["reference"]), np.array(now["world"]))

    return [is_earlier(one) for one in measured]
