"""Options that several commands share, and parsers of their texts, which raise `SettingsError`."""

from __future__ import annotations

import json
import os
import re
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from scopemap.engine.errors import InputError, SettingsError

_MOST_NAMED = 3
_QUOTED = 80  # characters of a text that an error repeats
advanced = partial(typer.Option, rich_help_panel="Advanced")
"""An option below the first page of a command's help."""

Align = Literal["none", "origin", "se3", "sim3", "scale"]
Unit = Literal["mm", "m"]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print only errors and JSON.")]
ResultFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")]
Input = Annotated[
    Path, typer.Argument(metavar="INPUT", help="Video file, folder of images, or folder of a data set's sequence.")
]
InputNow = Annotated[
    Path | None,
    typer.Option("--input", metavar="PATH", help="Where the run's input is now, if it has moved."),
]
PresetName = Annotated[
    Literal["default", "paper", "paper-strict", "realtime"] | None,
    typer.Option(
        help="Preset: default (no downloads), paper (as published, made robust), paper-strict (as published), "
        "realtime (fast)."
    ),
]
ConfigFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="TOML file of settings; config.toml of a run repeats that run.")
]
CameraFit = Annotated[
    str | None,
    advanced(
        metavar="FIT",
        help="Fit a calibration of another image size: exact (refuse), scale (images were resized), crop:X,Y.",
    ),
]
Dataset = Annotated[
    str | None, advanced(metavar="NAME", help="Reader of the input (`scopemap datasets list`); default: recognised.")
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE|NUMBERS",
        help="Calibration file, or 'fx fy cx cy [k1 k2 p1 p2 \\[k3]]' in px of the input's images.",
    ),
]
FieldOfView = Annotated[
    float | None,
    typer.Option(
        min=5.0,
        max=170.0,
        help="Horizontal field of view of an unknown camera, degrees; default: estimated, else 70 (live: 70).",
    ),
]
Scope = Annotated[
    str | None,
    typer.Option(
        metavar="KIND",
        help="Kind of endoscope: colonoscope, gastroscope, bronchoscope, laparoscope, cystoscope, ureteroscope, "
        "sinus, capsule.",
    ),
]
NearFar = Annotated[
    str | None,
    typer.Option(metavar="NEAR:FAR", help="Nearest and farthest tissue in the first frame, mm; sets the scale."),
]
Size = Annotated[
    str | None,
    typer.Option(
        metavar="WxH",
        help="Working size, px; default: the input size divided by an integer, at most 400 px wide or high.",
    ),
]
SetPairs = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Set any setting, such as tracking.keyframe_every=5; may be repeated."
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace earlier output.")]


def check_output(file: Path, endings: tuple[str, ...], overwrite: bool) -> None:
    """Raise `InputError` for a file that cannot be written, before the work: its name, or what is there already."""
    if file.suffix.lower() not in endings:
        raise InputError(f"cannot write {file}: its name must end in {' or '.join(endings)}")
    if file.is_dir():
        raise InputError(f"cannot write {file}: there is a folder of that name")
    if file.exists() and not overwrite:
        raise InputError(f"{file} exists; give another name with --out, or --overwrite")
    around = next(folder for folder in file.absolute().parents if folder.exists())
    if not around.is_dir():
        raise InputError(f"cannot write {file}: {around} is a file")
    if not os.access(file if file.exists() else around, os.W_OK):
        raise InputError(f"cannot write {file}: no permission to write in {around}")


def warn_of_damage(run: Path, *, silent: bool = False) -> None:
    """Print a warning where a result is not as its run wrote it; of a large one its main files are looked at alone."""
    from scopemap.result.checksums import changed_files

    if not silent and (changed := changed_files(run)):
        more = f" and {len(changed) - _MOST_NAMED} more" if len(changed) > _MOST_NAMED else ""
        names = ", ".join(changed[:_MOST_NAMED])
        typer.echo(f"warning: {run} is not as its run wrote it: {names}{more}; see scopemap verify {run}", err=True)


def _matched(text: str, pattern: str, what: str, expected: str) -> re.Match[str]:
    match = re.fullmatch(pattern, text)
    if match is None:
        raise SettingsError(f"cannot read the {what} '{text[:_QUOTED]}': expected {expected}")
    return match


def parse_board(text: str) -> tuple[int, int]:
    """Return (columns, rows) of "COLUMNSxROWS"."""
    match = _matched(text, r"(\d{1,3})x(\d{1,3})", "board", "COLUMNSxROWS such as 9x6")
    return int(match[1]), int(match[2])


def parse_part(text: str) -> tuple[int, int]:
    """Return (k, n) of "K/N", 1 <= k <= n."""
    expected = "K/N with K from 1 to N, such as 3/10"
    match = _matched(text, r"(\d{1,6})/(\d{1,6})", "part", expected)
    if not 1 <= int(match[1]) <= int(match[2]):
        raise SettingsError(f"cannot read the part '{text}': expected {expected}")
    return int(match[1]), int(match[2])


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) of "WIDTHxHEIGHT", px."""
    match = _matched(text, r"(\d{1,6})x(\d{1,6})", "size", "WIDTHxHEIGHT such as 320x256")
    return int(match[1]), int(match[2])


def parse_slice(text: str) -> slice:
    """Return the slice of "A:B:S", as `slice_of` reads it."""
    from scopemap.input.frame_choice import slice_of

    return slice_of(text)


Frames = Annotated[
    slice | None,
    typer.Option(
        parser=parse_slice,
        metavar="A:B:S",
        help="Frames to use, as a Python slice such as 0:5000 or ::10; default: all.",
    ),
]


def parse_box(text: str) -> tuple[int, ...]:
    """Return (x, y, width, height) of "X,Y,WIDTH,HEIGHT", px."""
    _matched(text, r"\d{1,6}(,\d{1,6}){3}", "box", "X,Y,WIDTH,HEIGHT in px such as 0,0,300,40")
    return tuple(int(part) for part in text.split(","))


def parse_memory(text: str) -> int:
    """Return MB of "2GB", "1500MB" or "1.5G"."""
    pattern = r"(\d{1,6}(?:\.\d{1,3})?)\s*([MGmg])[Bb]?"
    match = _matched(text.strip(), pattern, "memory", "a size such as 2GB or 1500MB")
    return round(float(match[1]) * (1000 if match[2].upper() == "G" else 1))


def parse_near_far(text: str) -> tuple[float, float]:
    """Return (nearest, farthest) of "NEAR:FAR", mm."""
    try:
        near_mm, far_mm = (float(part) for part in text.split(":"))
    except ValueError:
        raise SettingsError(f"cannot read --near-far '{text}': expected NEAR:FAR in mm such as 10:100") from None
    return near_mm, far_mm


def parse_settings(pairs: list[str], *, of_runs: bool = True) -> dict[str, Any]:
    """Return the settings of "key=value" texts; values are numbers, true, false, lists in JSON, or plain text.

    of_runs : whether they are those of a `Config`, whose names are known.
    """
    settings: dict[str, Any] = {}
    for pair in pairs:
        key, found, value = pair.partition("=")
        if not found:
            if of_runs:
                from scopemap.engine.config.config import check_setting

                check_setting(key)
            raise SettingsError(
                f"cannot read the setting '{pair[:_QUOTED]}': expected KEY=VALUE such as tracking.keyframe_every=5"
            )
        try:
            settings[key] = json.loads(value)
        except json.JSONDecodeError:
            settings[key] = value
        except (RecursionError, ValueError) as error:  # lists in lists without end, numbers of thousands of digits
            raise SettingsError(f"cannot read the setting '{pair[:_QUOTED]}': {error}") from None
    return settings
