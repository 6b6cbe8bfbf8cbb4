"""A quick look at an input before its run: what it is, what is wrong, what a run will cost and give.

Of a long video few frames spread over its beginning are read, and some that follow each other, in about ten seconds.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from scopemap.apps.browser.run_choice import RunChoice, suggested
from scopemap.engine.errors import ScopemapError

if TYPE_CHECKING:
    from scopemap.apps.inspect.clip import VideoFinding
    from scopemap.apps.inspect.inspecting import Inspection

_MOST_WHOLE = 200
"""Frames of an input that is read whole."""
_MOST_DECODED = 1200
"""Videos are decoded from their beginning: no more than these."""
_SPREAD = 60
_TOGETHER = 60
_OF_NEIGHBOURS = {"rate-high", "duplicates", "motion-fast", "cut"}
"""Codes of findings that need frames that follow each other."""
_USUAL_FRAMES_PER_S = {"default": (4.0, 14.0), "realtime": (9.0, 21.0)}
"""Of the whole command on two idle cores, start-up included (README)."""
_LEAST_S = 10.0
_CALIBRATIONS = {".yaml", ".yml", ".json", ".txt", ".xml", ".mat", ".npz", ".ini", ".cal", ".cfg"}
_NAME_OF_CAMERA = re.compile("cam|calib|intrin")
"""What the name of a file holds that is taken for the camera unasked."""
_MOST_FILES = 200
_MOST_CALIBRATIONS = 20
_MOST_BYTES = 1_000_000
_MINUTE_S = 90.0
_HOUR_S = 5400.0


class LeftEarlier(Exception):
    """The look is no longer wanted."""


@dataclass(frozen=True)
class Look:
    """What was seen of an input.

    spread : frames over all of it, or its beginning. together : frames that follow each other; the same where all
    were read. count : frames of the input, None: not known. whole : whether its end was seen. calibrations : files
    beside it that hold a camera for pictures of this size. refused : those that are named like a camera, and hold none.
    """

    spread: Inspection
    together: Inspection
    count: int | None
    whole: bool
    calibrations: tuple[Path, ...]
    refused: tuple[Path, ...]

    @property
    def findings(self) -> list[VideoFinding]:
        """What is noteworthy, worst first."""
        if self.spread is self.together:
            return list(self.spread.findings)
        found = [one for one in self.spread.findings if one.code not in _OF_NEIGHBOURS]
        found += [one for one in self.together.findings if one.code in _OF_NEIGHBOURS]
        return sorted(found, key=lambda one: ("error", "warning", "info").index(one.severity))

    @property
    def suggested(self) -> RunChoice:
        """The options that these findings advise."""
        one = self.calibrations[0] if len(self.calibrations) == 1 else None
        camera = one if one is not None and _NAME_OF_CAMERA.search(one.stem.lower()) else None
        choice = suggested(self.spread, self.findings, whole=self.whole)
        return choice if camera is None else replace(choice, camera=camera, scope="")

    @property
    def facts(self) -> str:
        """Size, rate and length in words."""
        (width, height), rate_hz = self.spread.size, self.together.clip.rate_hz
        words = [f"{width} x {height} px{', one of two views' if self.spread.packed else ''}"]
        if self.together.clip.stamped and rate_hz:
            words.append(f"{rate_hz:.3g} frames per second")
        if self.count is not None:
            length = f", {in_words(self.count / rate_hz)}" if self.together.clip.stamped and rate_hz else ""
            words.append(f"{self.count} frames{length}")
        return ", ".join(words)

    @property
    def kind(self) -> str:
        """Which kinds of endoscope the pictures are typical of, in words."""
        found = next((one for one in self.findings if one.code == "scope"), None)
        return "the pictures are typical of no one kind" if found is None else found.message

    @property
    def trackable(self) -> str:
        """What share can probably be tracked, in words."""
        words = self.together.forecast
        if self.together is self.spread:
            return words
        positions = self.together.clip["position"]
        return f"{words} (judged by frames {positions[0]} to {positions[-1]})"

    @property
    def part(self) -> str:
        """Which part was looked at, in words; "": all."""
        if self.together is self.spread:
            return ""
        positions = self.spread.clip["position"]
        which = "" if self.whole else f" of the first {positions[-1] + 1}"
        return f"one frame in {self.spread.clip.step}{which} was looked at"

    def used(self, choice: RunChoice) -> int | None:
        """Return about how many frames a run uses; None: not known."""
        from scopemap.input.frame_choice import slice_of

        if self.count is None:
            return None
        chosen = len(range(*slice_of(choice.frames or None).indices(self.count)))
        rate_hz = self.together.clip.rate_hz if self.together.clip.stamped else 0.0
        return round(chosen * min(1.0, choice.fps / rate_hz)) if choice.fps and rate_hz else chosen


def look(path: Path, listener: Callable[[int, int], None]) -> Look:
    """Look at an input; `listener` is called after each frame with how many were read, and of how many.

    Raises `InputError` and `CalibrationError` where it cannot be opened or holds fewer than two pictures.
    """
    from scopemap.apps.inspect.inspecting import inspect
    from scopemap.engine.config import InputSettings
    from scopemap.input.opening import open_source

    count = open_source(path, settings=InputSettings(stereo="none", skip_duplicates=False, deinterlace="off")).count
    if count is not None and count <= _MOST_WHOLE:
        spread = together = inspect(path, listener=lambda done, all_: listener(done, all_ or count))
        whole = True
    else:
        end = _MOST_DECODED if count is None or path.is_file() else count
        stop = min(end, count or end)
        step, every = max(1, stop // _SPREAD), _SPREAD + _TOGETHER
        spread = inspect(path, frames=slice(0, stop, step), listener=lambda done, _: listener(done, every))
        middle = slice(stop // 2, stop // 2 + _TOGETHER)
        together = inspect(path, frames=middle, listener=lambda done, _: listener(_SPREAD + done, every))
        whole = stop == count
    return Look(spread, together, count, whole, *_calibrations(path, spread.size))


def _calibrations(path: Path, size: tuple[int, int]) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return files beside an input that hold a camera for pictures of a size, px, and those that are named like one."""
    files = [file for file in sorted(path.parent.iterdir()) if file.suffix.lower() in _CALIBRATIONS]
    found, refused = list[Path](), list[Path]()
    for file in files[:_MOST_FILES]:
        if file.is_symlink() or not file.is_file() or file.stat().st_size > _MOST_BYTES:
            continue
        if holds_camera(file, size):
            found.append(file)
        elif _NAME_OF_CAMERA.search(file.stem.lower()):
            refused.append(file)
    return tuple(found[:_MOST_CALIBRATIONS]), tuple(refused[:_MOST_CALIBRATIONS])


def holds_camera(file: Path, size: tuple[int, int]) -> bool:
    """Return whether a file is a calibration for pictures of a size, px."""
    from scopemap.input.camera_files.reading import read_calibration

    try:
        read_calibration(file, size)
    except (OSError, ScopemapError):
        return False
    return True


def time_in_words(frames: int | None, preset: str, measured: Iterable[float]) -> str:
    """Return about how long a run of `frames` takes; measured : frames per second of earlier runs with the preset."""
    if frames is None:
        return "how long it takes is not known: the number of frames is not"
    rates = list(measured)
    if rates:
        rate = median(rates)
        return f"about {in_words(frames / rate)} (runs here made {rate:.1f} frames per second)"
    slow, fast = (max(frames / rate, _LEAST_S) for rate in _USUAL_FRAMES_PER_S[preset])
    usual = "{:g} to {:g} frames per second on two idle cores".format(*_USUAL_FRAMES_PER_S[preset])
    return f"about {in_words(fast)} to {in_words(slow)} ({usual})"


def measured_rates(results: Iterable[Path], preset: str) -> list[float]:
    """Return the frames per second of finished results that were made with a preset; of the first few."""
    from scopemap.result.result import Result
    from scopemap.result.summary import frames_per_s

    rates = []
    for folder in results:
        try:
            head = (folder / "config.toml").read_text(encoding="utf-8").partition("\n")[0]
            rate = frames_per_s(Result(folder)) if head == f'preset = "{preset}"' else None
        except (OSError, ValueError, ScopemapError):
            continue
        rates += [rate] if rate else []
    return rates


def in_words(seconds: float) -> str:
    """Return a time as one says it: "40 s", "3 min", "2.5 h"."""
    if seconds < _MINUTE_S:
        return f"{max(1, round(seconds))} s"
    return f"{seconds / 60:.0f} min" if seconds < _HOUR_S else f"{seconds / 3600:.1f} h"
