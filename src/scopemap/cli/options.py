"""Options that several commands share, and parsers of their texts, which raise `SettingsError`."""

from __future__ import annotations

import json
import re
from typing import Annotated, Any, Literal

import typer

from scopemap.errors import SettingsError

Align = Literal["none", "origin", "se3", "sim3", "scale"]
Unit = Literal["mm", "m"]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors and JSON.")]
SetPairs = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Any setting, such as tracking.keyframe_every=5.")
]


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) of "WIDTHxHEIGHT", px."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match:
        raise SettingsError(f"cannot read the size '{text}': expected WIDTHxHEIGHT such as 320x256")
    return int(match[1]), int(match[2])


def parse_slice(text: str) -> slice:
    """Return the slice of "A:B:S", a Python slice over the input's frames; A, B and S may be left out."""
    if not re.fullmatch(r"(-?\d+)?:(-?\d+)?(:\d*)?", text):
        raise SettingsError(f"cannot read the frames '{text}': expected START:STOP or START:STOP:STEP such as 0:100")
    return slice(*(int(part) if part else None for part in text.split(":")))


def parse_near_far(text: str) -> tuple[float, float]:
    """Return (nearest, farthest) of "NEAR:FAR", mm."""
    try:
        near_mm, far_mm = (float(part) for part in text.split(":"))
    except ValueError:
        raise SettingsError(f"cannot read --near-far '{text}': expected NEAR:FAR in mm such as 10:100") from None
    return near_mm, far_mm


def parse_settings(pairs: list[str]) -> dict[str, Any]:
    """Return the settings of "key=value" texts; values are numbers, true, false, lists in JSON, or plain text."""
    settings: dict[str, Any] = {}
    for pair in pairs:
        key, found, value = pair.partition("=")
        if not found:
            raise SettingsError(
                f"cannot read the setting '{pair}': expected KEY=VALUE such as tracking.keyframe_every=5"
            )
        try:
            settings[key] = json.loads(value)
        except json.JSONDecodeError:
            settings[key] = value
    return settings
