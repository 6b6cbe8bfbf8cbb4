"""What was measured by hand in the window, as measurements.json keeps it beside the result."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, TypeAdapter, ValidationError

from scopemap.result.result import Result

MEASUREMENTS = "measurements.json"
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
