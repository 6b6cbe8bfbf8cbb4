"""How long a run of a video takes: one second of it is run in a process of its own, as by `scopemap run --dry-run`."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scopemap.apps.browser.looking import in_words
from scopemap.apps.browser.runs import end_of, started

_LENS = "; a run without a calibration may begin again with a better lens, and then takes longer"


class VideoForecast:
    """Costs of runs of a video by their presets, once they are known; log : file for what the process prints."""

    def __init__(self, source: Path, log: Path) -> None:
        self._source, self._log = source, log
        self._costs: dict[str, dict[str, Any]] = {}
        self._process: subprocess.Popen[bytes] | None = None
        self._preset = ""

    def is_measured(self, preset: str) -> bool:
        """Return whether a second of the video is being run with a preset."""
        return self._process is not None and self._preset == preset

    def ask(self, preset: str, arguments: Sequence[str]) -> None:
        """Begin to measure a preset, with the arguments of its run; one that is measured or known stays."""
        if preset in self._costs or self.is_measured(preset):
            return
        self.close()
        # Nothing is written to --out.
        words = ["run", str(self._source), "--out", str(self._log.with_suffix("")), *arguments, "--dry-run", "--json"]
        self._process, self._preset = started([*words, "--quiet"], self._log, subprocess.DEVNULL), preset

    def poll(self) -> bool:
        """Return whether something has become known since the last call."""
        if self._process is None or self._process.poll() is None:
            return False
        self._process, printed = None, end_of(self._log)
        try:
            self._costs[self._preset] = json.loads(printed[printed.index("{") :])
        except ValueError:  # what is wrong with the video the run itself tells
            self._costs[self._preset] = {}
        return True

    def words(self, preset: str, frames: int | None) -> str:
        """Return about how long a run of so many frames takes; "" where it is not known."""
        if not (cost := self._costs.get(preset)) or frames is None:
            return ""
        seconds = in_words(cost["fixed_s"] + cost["frame_s"] * frames)
        return f"about {seconds} (one second of this video was run{_LENS * cost['lens_is_assumed']})"

    def close(self) -> None:
        """End what is being measured."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
