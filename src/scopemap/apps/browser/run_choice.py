"""What a run is to do with an input: the options that an inspection advises, what may be changed, the arguments."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scopemap.engine.errors import SettingsError
from scopemap.input.scopes import SCOPES

if TYPE_CHECKING:
    from scopemap.apps.inspect.burned_in import Overlay
    from scopemap.apps.inspect.clip import VideoFinding
    from scopemap.apps.inspect.inspecting import Inspection

PRESETS = ("default", "realtime")
LAYOUTS = ("auto", "none", "left-right", "top-bottom")
MOST_FOV_DEG = 170.0
LEAST_FOV_DEG = 5.0
_MOST_BOXES = 20
_OUTSIDE = {"black", "one-colour", "not-tissue"}
"""Codes of findings about frames that show no tissue."""
_LEAST_KEPT = 0.5
"""Share of the frames that must be left where some at the ends are left out."""
_FRAMES = re.compile(r"-?\d{0,15}:-?\d{0,15}(:\d{0,15})?")
Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class RunChoice:
    """Options of `scopemap run`; those at their defaults are left to it.

    camera : calibration file. fov_deg, fps, near_mm, far_mm : None: not given; NaN: no number was typed. redact : boxes
    of the input's pictures to blacken, px. masks : folder of masks.
    """

    preset: str = "default"
    scope: str = ""
    camera: Path | None = None
    fov_deg: float | None = None
    stereo: str = "auto"
    fps: float | None = None
    frames: str = ""
    redact: tuple[Box, ...] = ()
    masks: Path | None = None
    near_mm: float | None = None
    far_mm: float | None = None

    def checked(self) -> RunChoice:
        """Return these; raises `SettingsError` in a sentence where a run would refuse them."""
        if self.scope and self.scope not in SCOPES:
            raise SettingsError(f"{self.scope} is no kind of endoscope")
        if self.preset not in PRESETS or self.stereo not in LAYOUTS:
            raise SettingsError("choose the preset and the two views from their lists")
        if self.fov_deg is not None and not LEAST_FOV_DEG <= self.fov_deg <= MOST_FOV_DEG:
            limits = f"{LEAST_FOV_DEG:g} to {MOST_FOV_DEG:g} degrees"
            raise SettingsError(f"type the horizontal field of view, {limits}, or choose another camera")
        if self.fps is not None and not self.fps > 0:
            raise SettingsError("type the most frames per second, such as 12.5, or leave it empty for all frames")
        if self.frames and not _FRAMES.fullmatch(self.frames):
            raise SettingsError("frames are a slice such as 50:900 or ::2, empty: all")
        if (self.near_mm, self.far_mm) != (None, None):
            self._check_range()
        return self

    def _check_range(self) -> None:
        near_mm, far_mm = self.near_mm, self.far_mm
        if near_mm is None or far_mm is None:
            raise SettingsError("type both the nearest and the farthest tissue, mm, or leave both empty")
        if not (near_mm > 0 and far_mm > 0):
            raise SettingsError("type the nearest and the farthest tissue as numbers of mm, such as 5 and 80")
        if near_mm >= far_mm:
            raise SettingsError("the nearest tissue must be nearer than the farthest")

    def arguments(self) -> list[str]:
        """Return the arguments of the command, in a fixed order: the same choice resumes the same run."""
        given = {
            "--preset": self.preset if self.preset != PRESETS[0] else "",
            "--scope": self.scope,
            "--camera": "" if self.camera is None else str(self.camera),
            "--fov": "" if self.fov_deg is None else f"{self.fov_deg:g}",
            "--stereo": self.stereo if self.stereo != LAYOUTS[0] else "",
            "--fps": "" if self.fps is None else f"{self.fps:g}",
            "--frames": self.frames,
            "--near-far": f"{self.near_mm:g}:{self.far_mm:g}" if self.near_mm is not None else "",
            "--set": "" if self.masks is None else f"mask.files={self.masks}",
        }
        # In one word: a value may begin with "-".
        out = [f"{name}={value}" for name, value in given.items() if value]
        return out + [f"--redact={','.join(map(str, box))}" for box in self.redact]


def suggested(found: Inspection, findings: Sequence[VideoFinding], *, whole: bool) -> RunChoice:
    """Return what the findings of an inspection advise; whole : whether it reached the end of the input.

    Burned-in text beside the field of view is blackened: it costs nothing there, and may name a patient.
    """
    by_code = {finding.code: finding for finding in findings}
    scopes = re.findall(r"--scope (\S+)", by_code["scope"].advice) if "scope" in by_code else []
    scope = scopes[0].rstrip(":") if scopes else ""
    rates = re.findall(r"--fps ([\d.]+)", by_code["rate-high"].advice) if "rate-high" in by_code else []
    return RunChoice(
        scope=scope if scope in SCOPES else "",
        stereo="auto" if found.packed is None else found.packed.layout,
        fps=float(rates[0]) if rates else None,
        frames=_without_ends(found, findings, whole=whole),
        redact=boxes_of(found, [one for one in found.overlays if not one.in_field]),
    )


def boxes_of(found: Inspection, overlays: Sequence[Overlay]) -> tuple[Box, ...]:
    """Return the boxes of overlays in the input's pictures, px; of two views, in both."""
    (width, height), corners = found.size, [(0, 0)]
    if found.packed is not None:
        beside = found.packed.layout == "left-right"
        corners.append((width, 0) if beside else (0, height))
    boxes = []
    for left, top, right, bottom in (one.box for one in overlays[:_MOST_BOXES]):
        x, y = int(left * width), int(top * height)
        side = max(1, round((right - left) * width) + 1), max(1, round((bottom - top) * height) + 1)
        boxes += [(x + right_px, y + down_px, *side) for right_px, down_px in corners]
    return tuple(sorted(boxes))


def _without_ends(found: Inspection, findings: Sequence[VideoFinding], *, whole: bool) -> str:
    """Return the frames without those at the ends that show no tissue, as `--frames` has them; "": all."""
    bad = [segment for finding in findings if finding.code in _OUTSIDE for segment in finding.segments]
    positions = [int(position) for position in found.clip["position"]]
    good = [place for place in positions if not any(first <= place <= last for first, last in bad)]
    if not good or len(good) < _LEAST_KEPT * len(positions):
        return ""
    start = good[0] if good[0] > positions[0] else 0
    stop = good[-1] + 1 if whole and good[-1] < positions[-1] else 0
    return f"{start or ''}:{stop or ''}" if start or stop else ""
