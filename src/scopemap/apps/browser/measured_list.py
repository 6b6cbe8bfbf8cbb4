"""What was measured by hand: kept in measurements.json, listed in the panel, and drawn on the surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.apps.browser.hand_measures import (
    Reference,
    broken,
    is_by,
    is_on,
    kept_reference,
    line_on_surface,
    part_words,
    reference_as_kept,
)
from scopemap.apps.browser.marks import INK, PALE, draw_marks
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.window import escaped, fenced
from scopemap.apps.measure.hand_measure import (
    HandMeasure,
    add_measurement,
    as_csv,
    kept_measures,
    remove_measurement,
    remove_reference,
)
from scopemap.apps.measure.measure import Measure
from scopemap.report.measured_by_hand import (
    EARLIER,
    MEASUREMENTS,
    earlier_references,
    folder_in_whole,
    read_measurements,
)

_KEPT = "/page/measured"
_SHORT = {"mm": "mm", "mm2": "mm²", "times the reference": "x", "times the reference's square": "x²"}


@dataclass(frozen=True)
class _Listed:
    """One measurement, and its line on the surface; None: not found yet."""

    one: HandMeasure
    line: np.ndarray | None = None


class MeasuredList:
    """The measurements of a result; they are kept as they are made, and are there when the result is opened again."""

    def __init__(self, shown: ShownResult) -> None:
        self._shown, gui = shown, shown.window.gui
        self._reference: Reference | None = None
        self._all = [_Listed(one) for one in kept_measures(shown.whole.folder) if one.kind != "reference"]
        # Rebuilt within a place that stays.
        self._outer = gui.add_folder(None)
        with self._outer:
            self._place = gui.add_folder(None)
        self._table = gui.add_button("Download as a table (CSV)", color="gray")
        self._table.on_click(lambda event: shown.window.do(self._send, event.client))

    def add(self, one: HandMeasure, line: np.ndarray) -> None:
        """Show and keep a measurement, with its line (M, 3) on the surface."""
        self._all.append(_Listed(one, line))
        self.show(self._reference)
        add_measurement(self._shown.whole.folder, one)

    def kept_reference(self) -> tuple[Reference | None, HandMeasure | None]:
        """Return the reference that is kept for the surface that is shown; where there is none, that of another one."""
        surface, kept = self._shown.surface, kept_measures(self._shown.whole.folder)
        others = [one for one in kept if one.kind == "reference" and not is_on(surface, one)]
        found = kept_reference(surface, kept)
        return found, next(iter(others), None) if found is None else None

    def keep_reference(self, reference: Reference | None) -> None:
        """Keep the reference of the surface that is shown; None: none. Raises as `reference_as_kept`."""
        shown = self._shown
        if reference is None:
            remove_reference(shown.whole.folder, folder_in_whole(shown.run))
        else:
            add_measurement(shown.whole.folder, reference_as_kept(shown.surface, reference))

    def show(self, reference: Reference | None) -> None:
        """List and draw all; those by another reference than this one are pale."""
        self._reference = reference
        gui = self._shown.window.gui
        self._place.remove()
        with self._outer:
            self._place = gui.add_folder(None)
        self._outer.visible = self._table.visible = bool(self._all)
        with self._place:
            if self._all:
                gui.add_markdown(f"Measured, and kept in {escaped(MEASUREMENTS)} for the report:")
            for number, listed in enumerate(self._all, 1):
                gui.add_markdown(f"**{number}.** {measured_words(listed.one)}{self._note(listed)}")
                with gui.add_folder(f"Command of {number}", expand_by_default=False):
                    gui.add_markdown(fenced(broken(listed.one.command(self._shown.folder_words))))
                remove = gui.add_button(f"Remove {number}", color="gray")
                self._shown.window.on(remove, self._remove, listed)
        self._draw()

    def _send(self, client: Any) -> None:
        """Send what is listed as a table to the browser that asked for it."""
        whole, listed = self._shown.whole, [each.one for each in self._all]
        earlier = earlier_references(whole, [one.as_json for one in listed], read_measurements(whole.folder))
        content = as_csv(listed, earlier).encode()
        client.send_file_download(Path(MEASUREMENTS).with_suffix(".csv").name, content, save_immediately=True)

    def _is_here(self, listed: _Listed) -> bool:
        """Whether it is on the surface that is shown: each segment of the video has one of its own."""
        return is_on(self._shown.surface, listed.one)

    def _is_earlier(self, listed: _Listed) -> bool:
        return not is_by(self._shown.surface, listed.one, self._reference)

    def _note(self, listed: _Listed) -> str:
        if not self._is_here(listed):
            return f" *on the surface of {part_words(self._shown.whole, listed.one)}*"
        return f" *{EARLIER}*" if self._is_earlier(listed) else ""

    def _draw(self) -> None:
        shown = self._shown
        for place in range(len(self._all) + 1):
            if place == len(self._all) or not self._is_here(self._all[place]):
                shown.window.scene.remove_by_name(f"{_KEPT}/{place}")
        for place, listed in enumerate(self._all):
            one = listed.one
            if not self._is_here(listed):
                continue
            if listed.line is None:
                listed = self._all[place] = replace(listed, line=line_on_surface(shown.surface, one.frame, one.world))
            is_earlier = self._is_earlier(listed)
            colour = PALE if is_earlier else INK
            name, size_mm = f"{_KEPT}/{place}", shown.surface.size_mm
            words = ": ".join(filter(None, (one.name, with_interval(one.found[0]))))
            words += f", {EARLIER}" if is_earlier else ""
            draw_marks(shown.window.scene, name, one.world, size_mm, words, colour, listed.line)

    def _remove(self, gone: _Listed) -> None:
        self._all = [listed for listed in self._all if listed.one is not gone.one]
        self.show(self._reference)
        remove_measurement(self._shown.whole.folder, gone.one)
        self._shown.note(f"Removed: {short(gone.one.found[0])}.")


def measured_words(one: HandMeasure) -> str:
    """Return what was found of a measurement as Markdown: a line each, then why intervals are wide."""
    lines = [f"{escaped(one.name or 'Measured')} (frame {one.frame})"]
    for found in one.found:
        said = str(replace(found, why=""))
        lines.append(f"- {escaped(said.replace(' (', ', 95 % interval ').rstrip(')'))}")
    if whys := list(dict.fromkeys(found.why for found in one.found if found.why)):
        lines.append(f"\nWide mainly because of {escaped('; of '.join(whys))}.")
    return "\n".join(lines)


def with_interval(measure: Measure) -> str:
    """Return a value as the scene shows it, with its interval: "4.5 (1.1 to 13) mm"."""
    if not np.isfinite([measure.value, measure.low, measure.high]).all():
        return short(measure)
    if not measure.is_measurable:
        return f"not measurable (to {measure.high:.2g} {_SHORT.get(measure.unit, measure.unit)})"
    value, low, high = (f"{number:.2g}" for number in (measure.value, measure.low, measure.high))
    return f"{value} ({low} to {high}) {_SHORT.get(measure.unit, measure.unit)}"


def short(measure: Measure) -> str:
    """Return a value as the scene shows it: "16 mm", "0.75 x"."""
    if not np.isfinite(measure.value):
        return "gap"
    if not measure.is_measurable:
        return "not measurable"
    return f"{measure.value:.3g} {_SHORT.get(measure.unit, measure.unit)}"
