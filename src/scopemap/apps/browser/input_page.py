"""The page of an input that was chosen: what it is, what is wrong, the options that mend it, and the start of a run."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scopemap.apps.browser.camera_part import CameraPart
from scopemap.apps.browser.forecast import VideoForecast
from scopemap.apps.browser.looking import LeftEarlier, Look, look, measured_rates, time_in_words
from scopemap.apps.browser.redact_part import RedactPart
from scopemap.apps.browser.run_choice import LAYOUTS, PRESETS, Box, RunChoice, boxes_of
from scopemap.apps.browser.runs import BrowserRun
from scopemap.apps.browser.window import escaped, fenced, typed_number
from scopemap.apps.browser.workspace import Workspace
from scopemap.engine.errors import InputError, ScopemapError, SettingsError
from scopemap.input.scopes import SCOPES
from scopemap.report.frame_pictures import shrunk

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_UNKNOWN = "not known"
_PRESETS = {"default: best quality": PRESETS[0], "realtime: about twice as fast": PRESETS[1]}
_LAYOUTS = {"found by itself": LAYOUTS[0], "one view": LAYOUTS[1], "left and right": LAYOUTS[2], "above": LAYOUTS[3]}
_NEXT_LINE = " \\\n  "
_PICTURE_PX = 240
_PICTURES = 3
_MOST_MEASURED = 5
_MOST_FINDINGS = 8
_SET_BELOW = {"scope", "stereo", "rate-high", "black", "one-colour", "not-tissue", "inset"}
"""Codes of findings that a switch of this page answers."""
_WORDS = {"error": "Error", "warning": "Caution", "info": "Note"}


class InputPage:
    """An input; started : called with the run that is started. back : called where the page is left.

    is_new : whether it is a file that was just sent, which is not kept where it cannot be read.
    """

    def __init__(
        self,
        workspace: Workspace,
        source: Path,
        started: Callable[[BrowserRun], None],
        back: Callable[[], None],
        *,
        is_new: bool = False,
    ) -> None:
        self._workspace, self._source, self._started, self._back = workspace, source, started, back
        self._is_new = is_new
        self._looked: Look | None = None
        self._camera: CameraPart | None = None
        self._drawing: RedactPart | None = None
        self._drawn: tuple[Box, ...] = ()
        self._done, self._all, self._left = 0, 1, False
        self._forecast = VideoForecast(source, workspace.logs / "forecast.log")
        self.choice = RunChoice()
        """The options as they are set."""

    def open(self, window: BrowserWindow) -> None:
        """Make the elements, and look at the input."""
        self._window, gui = window, window.gui
        self._name = window.names.of(self._source, "video")
        gui.add_markdown(f"### {escaped(self._name)}")
        self._bar = gui.add_progress_bar(0, animated=True)
        self._place = gui.add_folder(None)
        window.on(gui.add_button("Back to the start", color="gray"), self._back)
        window.job("looking at the video", self._look, self._show)

    def tick(self) -> None:
        """Show how far the look is, and what is found out about the time."""
        if self._looked is None:
            self._bar.value = min(100.0, 100 * self._done / self._all)
        elif self._forecast.poll():
            self._show_choice()
        if self._camera is not None:
            self._camera.tick()

    def close(self) -> None:
        """End the look, and what is measured."""
        self._left = True
        self._forecast.close()
        if self._drawing is not None:
            self._drawing.close()

    def _heard(self, done: int, all_: int) -> None:
        if self._left:
            raise LeftEarlier
        self._done, self._all = done, max(all_, 1)

    def _look(self) -> Look | ScopemapError:
        try:
            return look(self._source, self._heard)
        except ScopemapError as error:
            return error

    def _show(self, found: Look | ScopemapError) -> None:
        self._bar.visible = False
        if isinstance(found, InputError) and self._is_new:
            self._source.unlink(missing_ok=True)
            raise InputError(f"{found}; the file is not kept")
        if isinstance(found, ScopemapError):
            raise found
        self._looked = found
        self.choice = found.suggested
        results = self._workspace.finished[:_MOST_MEASURED]
        self._rates = {preset: measured_rates(results, preset) for preset in PRESETS}
        with self._place:
            gui = self._window.gui
            gui.add_image(_strip(found), format="jpeg")
            gui.add_markdown(words_of(found, self._window.names.hidden))
            self._time = gui.add_markdown("")
            self._add_switches(found)
            self._start = self._window.on(gui.add_button("Reconstruct", color="green"), self._reconstruct)
            self._command = gui.add_markdown("")
        self._show_choice()

    def _add_switches(self, found: Look) -> None:
        """Add what the findings advise, and what is usually asked, in sight; the rest in a folder."""
        self._add_list("Endoscope", {_UNKNOWN: "", **{scope: scope for scope in SCOPES}}, "scope")
        self._camera = CameraPart(self._window, self._workspace, found, self.choice.camera, self._set)
        self._add_list("Quality", _PRESETS, "preset")
        overlays = found.spread.overlays
        for inside, label in ((False, "Blacken burned-in text"), (True, "Blacken what rests in the field of view")):
            boxes = boxes_of(found.spread, [one for one in overlays if one.in_field is inside])
            if boxes:
                self._add_boxes(f"{label} ({len(boxes)})", boxes)
        self._drawing = RedactPart(self._window, found.spread, self._set_drawn)
        if found.spread.insets:
            self._add_mask()
        seen, rest = list[Callable[[], None]](), list[Callable[[], None]]()
        for add, is_advised in (
            (self._add_layout, self.choice.stereo != LAYOUTS[0]),
            (self._add_rate, self.choice.fps is not None),
            (self._add_frames, bool(self.choice.frames)),
        ):
            (seen if is_advised else rest).append(add)
        for add in seen:
            add()
        with self._window.gui.add_folder("More options", expand_by_default=False):
            for add in rest:
                add()
            self._add_range()

    def _add_list(self, label: str, values: dict[str, str], name: str) -> None:
        shown = next((label for label, value in values.items() if value == getattr(self.choice, name)), None)
        handle = self._window.gui.add_dropdown(label, tuple(values), initial_value=shown)
        # What a browser sends need not be of the list.
        self._window.on(handle, lambda chosen: self._set({name: _of_list(values, chosen)}))

    def _add_boxes(self, label: str, boxes: tuple[tuple[int, int, int, int], ...]) -> None:
        are_set = set(boxes) <= set(self.choice.redact)
        handle = self._window.gui.add_checkbox(label, are_set, hint="It is black in everything that the run writes.")

        def changed(is_on: bool) -> None:
            rest = [box for box in self.choice.redact if box not in boxes]
            self._set({"redact": tuple(sorted([*rest, *(boxes if is_on else ())]))})

        self._window.on(handle, changed)

    def _set_drawn(self, drawn: tuple[Box, ...]) -> None:
        """Blacken boxes that were drawn by hand in place of those so far."""
        rest = set(self.choice.redact) - set(self._drawn)
        self._drawn = drawn
        self._set({"redact": tuple(sorted(rest | set(drawn)))})

    def _add_mask(self) -> None:
        folder = self._workspace.masks_of(self._source)
        self.choice = replace(self.choice, masks=folder)
        handle = self._window.gui.add_checkbox("Leave out the picture in the picture", True)
        self._window.on(handle, lambda is_on: self._set({"masks": folder if is_on else None}))

    def _add_layout(self) -> None:
        self._add_list("Two views in a picture", _LAYOUTS, "stereo")

    def _add_rate(self) -> None:
        hint = "Leave out frames beyond this rate, such as 12.5. Empty: use all."
        self._add_number("Most frames per second", "fps", hint)

    def _add_frames(self) -> None:
        hint = "From the first to before the last, such as 50:900; with a step: ::2. Empty: all."
        handle = self._window.gui.add_text("Frames", self.choice.frames, hint=hint)
        self._window.on(handle, lambda text: self._set({"frames": str(text).strip()}))

    def _add_range(self) -> None:
        hint = "In the first frame, such as 5 and 80; both set the scale. Empty: not known."
        for label, name in (("Nearest tissue, mm", "near_mm"), ("Farthest tissue, mm", "far_mm")):
            self._add_number(label, name, hint)

    def _add_number(self, label: str, name: str, hint: str) -> None:
        """Add a field for a number that may be left empty: 0 would look like a measured one."""
        advised = getattr(self.choice, name)
        handle = self._window.gui.add_text(label, "" if advised is None else f"{advised:g}", hint=hint)
        self._window.on(handle, lambda text: self._set({name: typed_number(text) if text.strip() else None}))

    def _set(self, changes: dict[str, Any]) -> None:
        self.choice = replace(self.choice, **changes)
        self._show_choice()

    def _show_choice(self) -> None:
        """Show the command, and how long it takes; or what is wrong with it."""
        assert self._looked is not None
        try:
            choice = self.choice.checked()
            frames = self._looked.used(choice)
        except ScopemapError as error:
            self._start.disabled = True
            self._window.fail(str(error))
            return
        self._window.clear_error()
        self._start.disabled = False
        self._time.content = f"**Time:** {escaped(self._time_words(choice, frames))}"
        out = self._workspace.new_result(self._source)
        words = [f"scopemap run {shlex.quote(str(self._source))}", f"--out {shlex.quote(str(out))}"]
        command = _NEXT_LINE.join([*words, *map(shlex.quote, choice.arguments())])
        self._command.content = f"The same in a terminal:\n\n{fenced(self._window.names.hidden(command))}"

    def _time_words(self, choice: RunChoice, frames: int | None) -> str:
        """Return how long a run takes; where nothing else runs, a second of the video is run to find out."""
        if self._workspace.runs.running is None and frames is not None:
            # Masks are written with the run.
            self._forecast.ask(choice.preset, replace(choice, masks=None).arguments())
        usual = time_in_words(frames, choice.preset, self._rates[choice.preset])
        if self._forecast.is_measured(choice.preset):
            return f"being measured: one second of this video is run. Without that: {usual}"
        return self._forecast.words(choice.preset, frames) or usual

    def _reconstruct(self) -> None:
        from scopemap.apps.inspect.inspection_sheet import write_mask

        assert self._looked is not None
        choice = self.choice.checked()
        if choice.masks is not None:
            write_mask(self._looked.spread, choice.masks)
        self._start.disabled = True
        self._forecast.close()  # before the run: it would share the cores
        self._started(self._workspace.reconstruct(self._source, choice.arguments()))


def words_of(found: Look, hidden: Callable[[str], str] = str) -> str:
    """Return what was seen of an input, in Markdown; hidden : returns a text without names that are not to be read."""
    lines = [
        escaped(found.facts),
        f"**Kind of endoscope:** {escaped(found.kind)}",
        f"**Tracking:** {escaped(found.trackable)}",
    ]
    findings = [one for one in found.findings if one.code != "scope"]
    items = []
    for one in findings[:_MOST_FINDINGS]:
        advice = "it is set below" if one.code in _SET_BELOW else one.advice
        more = f" *{escaped(hidden(advice))}*" if advice else ""
        items.append(f"- **{_WORDS[one.severity]}:** {escaped(hidden(one.message))}.{more}")
    if len(findings) > _MOST_FINDINGS:
        items.append(f"- and {len(findings) - _MOST_FINDINGS} more: `scopemap inspect` lists all")
    lines.append("\n".join(items) if items else "No problem was found.")
    if found.part:
        lines.append(f"To be quick, {escaped(found.part)}.")
    return "\n\n".join(lines)


def _strip(found: Look) -> np.ndarray:
    """Return pictures from its beginning to its end, beside each other, (h, w, 3) uint8."""
    samples = found.spread.samples
    places = np.linspace(0, len(samples) - 1, min(_PICTURES, len(samples))).round().astype(int)
    return np.hstack([shrunk(samples[place].rgb, _PICTURE_PX) for place in places])


def _of_list(values: dict[str, Any], label: str) -> Any:
    if label not in values:
        raise SettingsError("choose one of the list")
    return values[label]
