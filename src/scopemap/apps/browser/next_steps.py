"""Next steps of a verdict that another run can take: which options of `scopemap run` they name, and its arguments."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scopemap.engine.config.input import InputSettings
from scopemap.result.result import Result
from scopemap.result.run_input import places_of_input

_OPTION = re.compile(r"--([a-z][a-z-]*)(?: ([a-z][\w.]*(?:[=|][\w.|]+)*))?")
_SCOPES = tuple(kind for kind in InputSettings.model_fields["scope"].annotation.__args__ if kind)  # type: ignore[union-attr]
_CAMERA = {"scope", "fov"}
"""Options of a lens that is not known: without effect where a calibration is."""

_QUESTIONS = {"scope": "Which endoscope was it?", "fov": "Its horizontal field of view, degrees"}
_BUTTONS = {"scope": "Run again with this endoscope", "fov": "Run again with this field of view"}


@dataclass(frozen=True)
class NextRun:
    """Another run that a next step names.

    option : of `scopemap run`. choices : values of which one is chosen, (): a number is asked for.
    number : its lowest and its highest value; None: no number. stated : what the run was given; "": nothing.
    """

    option: str
    choices: tuple[str, ...] = ()
    number: tuple[float, float] | None = None
    stated: str = ""

    @property
    def question(self) -> str:
        """What is asked for beside the button, or what was stated before; "": nothing."""
        if self.stated:
            return f"Run as: {self.stated}. Was it another?"
        return _QUESTIONS.get(self.option, "")

    def label(self, value: str = "") -> str:
        """Return the words of the button that takes a value, or the one that is set beside it; a setting is named."""
        if self.option == "scope" and value:
            return f"Run again as seen by a {value}"
        return _BUTTONS.get(self.option, f"Run again with {value}")

    def arguments(self, value: str) -> list[str]:
        """Return the arguments of the option with a value."""
        return [f"--{self.option}", value]


def next_runs(step: str, run: Result) -> list[NextRun]:
    """Return the runs that a next step names by options that need no file, for a result.

    `--scope laparoscope` is that one choice, `--scope a|b` are two, and `--scope` alone all kinds of endoscope.
    """
    found = []
    for option, stated in _OPTION.findall(step):
        value = stated.rstrip(".")
        if option in _CAMERA and run.provenance.get("camera", {}).get("origin") == "calibrated":
            continue
        if option == "set" and "=" in value:
            found.append(NextRun(option, (value,)))
        elif option == "scope":
            known = [kind for kind in value.split("|") if kind in _SCOPES]
            found.append(NextRun(option, tuple(known) or _SCOPES, stated=run.config.input.scope))
        elif option == "fov":
            found.append(NextRun(option, number=(5.0, 170.0)))
    return found


def source_of(run: Result) -> Path | None:
    """Return where the input of a result is, by its name alone; None where it is gone, or was a live stream."""
    if run.provenance.get("dataset") == "live":
        return None
    return next(iter(places_of_input(run.folder)), None)


def arguments_again(run: Result, instead: str = "") -> list[str]:
    """Return the arguments of `scopemap run` that repeat a run, but for the option that comes `instead` of its own.

    Its settings are in config.toml. The reader, the working size and the camera are not: a calibration was kept beside
    the result, for pictures of the input's size; a stated field of view is that of the camera that was kept.
    """
    camera = run.camera
    found = ["--config", str(run.folder / "config.toml"), "--size", f"{camera.width}x{camera.height}"]
    if dataset := run.provenance.get("dataset"):
        found += ["--dataset", str(dataset)]
    origin, source = run.provenance["camera"].get("origin"), run.source_camera
    if source is None or instead in _CAMERA:
        return found
    if origin == "calibrated" and not run.config.input.uses_both_views:
        found += ["--camera", str(run.source_camera_file), "--camera-fit", "exact"]
    elif origin == "stated":
        lens = source.central
        fov_deg = 2 * np.degrees(np.arctan(lens.width / 2 / lens.fx))
        found += ["--fov", f"{fov_deg:.10g}"]
    return found
