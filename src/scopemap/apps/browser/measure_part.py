"""Measuring: clicks on the surface become points, two of them a distance, more an area, with the command for it."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from scopemap.apps.browser.hand_measures import (
    HandMeasure,
    Reference,
    add_measurements,
    broken,
    measure_by_hand,
)
from scopemap.apps.browser.lesion_part import LesionPart
from scopemap.apps.browser.marks import draw_marks
from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.shown_surface import SurfacePick
from scopemap.apps.browser.window import escaped
from scopemap.report.page_data import MEASUREMENTS

Mode = Literal["Look", "Distance", "Area", "Lesion"]
_HINTS: dict[Mode, str] = {
    "Look": "Click on the surface to see which frames saw that place.",
    "Distance": "Click on two points of the surface.",
    "Area": "Click on three or more points around the area, then press Measure the area.",
    "Lesion": "Click around the lesion as this frame shows it, then press Measure the lesion.",
}
_UNKNOWN = "Sizes are unknown. Choose **Distance** and click on a length that you know: it becomes the reference."
_PICKED = "/page/picked"
_KEPT = "/page/measured"


class MeasurePart:
    """Controls of measuring; `add` takes a place that was clicked. mode : what a click is for."""

    def __init__(self, view: ResultView) -> None:
        self._view, window, gui = view, view.window, view.window.gui
        self.mode: Mode = "Look"
        self._picks: list[SurfacePick] = []
        self._reference: Reference | None = None
        self._measured: list[tuple[int, HandMeasure]] = []
        self._hint = gui.add_markdown("")
        modes = gui.add_button_group("Measure", [*get_args(Mode)[1:], "Stop"])
        modes.on_click(lambda event: window.do(self._choose, modes.value))
        points = gui.add_button_group("Points", ["Undo", "Clear"])
        points.on_click(lambda event: window.do(self._take_back, points.value))
        self._area = window.on(gui.add_button("Measure the area", visible=False), self._measure)
        self._length = gui.add_number("Its length, mm", 0.0, min=0.0, step=0.1, visible=False)
        self._length.hint = "0: not known; other lengths are then multiples of it"
        self._refer = window.on(gui.add_button("Use as reference", visible=False), self._use_as_reference)
        self._forget = window.on(gui.add_button("Forget the reference", visible=False), self._forget_reference)
        self._lesion = LesionPart(view, lambda: self._reference)
        self._list = gui.add_markdown("")
        self._save = window.on(gui.add_button("Save the measurements", visible=False), self._keep)
        self._save.hint = f"To {MEASUREMENTS} in the result's folder, where the report shows them"
        view.follow(submap=self._follow_submap)
        self._show()

    def add(self, pick: SurfacePick) -> None:
        """Take a place that was clicked on the surface, by what a click is for."""
        if self.mode == "Lesion":
            self._lesion.add(pick)
            return
        if self.mode == "Distance" and len(self._picks) == 2:
            self._picks = []
        self._picks.append(pick)
        self._show()
        if self.mode == "Distance" and len(self._picks) == 2:
            if self._view.whole.scale_known or self._reference is not None:
                self._measure()
            else:
                self._view.note("The scale is unknown: use these two points as reference, with their length if known.")

    def _choose(self, mode: str) -> None:
        self.mode = "Look" if mode == "Stop" else next(known for known in get_args(Mode) if known == mode)
        self._picks = []
        self._view.note("")
        self._view.measure_by_clicks(on=self.mode != "Look")
        self._lesion.begin(shown=self.mode == "Lesion")
        self._show()

    def _take_back(self, how: str) -> None:
        if self.mode == "Lesion":
            self._lesion.take_back(how == "Clear")
            return
        self._picks = [] if how == "Clear" else self._picks[:-1]
        self._show()

    def _measure(self) -> None:
        surface, picks, reference, number = self._view.surface, [*self._picks], self._reference, self._view.number

        def then(found: HandMeasure) -> None:
            self._measured.append((number, found))
            self._view.note(in_words(found))
            if self.mode == "Area":
                self._picks = []
            self._show()

        self._view.window.job("measuring", lambda: measure_by_hand(surface, picks, reference), then)

    def _use_as_reference(self) -> None:
        first, second = self._picks
        self._reference = Reference((first, second), float(self._length.value) or None)
        self._picks = []
        self._show()
        known = f"{self._length.value:g} mm" if self._length.value else "the unit of lengths"
        self._view.note(f"The reference is {known}. Now click on the two points to be measured.")

    def _forget_reference(self) -> None:
        self._reference = None
        self._show()

    def _keep(self) -> None:
        count = add_measurements(self._view.whole.folder, [found for _, found in self._measured])
        self._view.note(f"Saved: {MEASUREMENTS} has {count} now. `scopemap report` puts them into the report.")

    def _follow_submap(self) -> None:
        self._picks, self._reference = [], None
        self._lesion.begin(shown=self.mode == "Lesion")
        self._show()

    def _show(self) -> None:
        view, picks = self._view, self._picks
        self._hint.content = _hint(self.mode, known=view.whole.scale_known or self._reference is not None)
        two = self.mode == "Distance" and len(picks) == 2
        self._length.visible = self._refer.visible = two
        self._forget.visible = self._reference is not None
        self._area.visible = self.mode == "Area" and len(picks) > 2
        self._save.visible = bool(self._measured)
        size, scene = view.surface.size_mm, view.window.scene
        draw_marks(scene, _PICKED, np.array([view.surface.position(pick, view.state) for pick in picks]), size)
        scene.remove_by_name(_KEPT)
        for place, (number, one) in enumerate(self._measured):
            if number == view.number:
                draw_marks(scene, f"{_KEPT}/{place}", one.world, size, _label(one))
        self._list.content = "\n\n".join(
            f"**{place}.** {escaped(in_words(one))}\n```\n{broken(one.command(view.folder_words))}\n```"
            for place, (_, one) in enumerate(self._measured, 1)
        )


def in_words(one: HandMeasure) -> str:
    """Return what was measured in one line."""
    return f"{'; '.join(map(str, one.found))} (frame {one.frame})"


def _label(one: HandMeasure) -> str:
    return str(one.found[0]).partition(": ")[2].partition(" (")[0]


def _hint(mode: Mode, *, known: bool) -> str:
    if mode != "Look":
        return f"**{mode}.** {_HINTS[mode]}"
    return "Choose what to measure." if known else _UNKNOWN
