"""Measuring: clicks on the surface become points, two of them a distance, more an area; and the reference of sizes."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from scopemap.apps.browser.frame_images import FrameImages
from scopemap.apps.browser.hand_measures import (
    Reference,
    line_on_surface,
    measure_by_hand,
    part_words,
    submap_of,
)
from scopemap.apps.browser.lesion_part import LesionPart
from scopemap.apps.browser.marks import REFERENCE, draw_marks
from scopemap.apps.browser.measured_list import MeasuredList, short
from scopemap.apps.browser.picture_part import PicturePart
from scopemap.apps.browser.shown_result import LOOKING, ShownResult
from scopemap.apps.browser.shown_surface import SurfacePick
from scopemap.apps.browser.window import typed_number
from scopemap.apps.measure.hand_measure import HandMeasure
from scopemap.report.measured_by_hand import sizes_by

Mode = Literal["Look", "Distance", "Area", "Lesion"]
_CHOOSE = "Choose what to measure."
_UNKNOWN = "Sizes are unknown. Choose **Distance** and click on both ends of something whose length you know."
_BACK = "Go to the reference"
_ELSEWHERE = "Your reference is on the surface of {part}. “{back}”, in Measure, shows it; one set here replaces it."
_EMPTY = "Type its length in mm. If it is not known, press again: other lengths are then multiples of it."
_FEWEST = 3
_PICKED = "/page/picked"
_REFERRED = "/page/reference"


class MeasurePart:
    """Controls of measuring; `add` takes a place that was clicked. mode : what a click is for."""

    def __init__(self, shown: ShownResult, images: FrameImages) -> None:
        self._shown, window, gui = shown, shown.window, shown.window.gui
        self.mode: Mode = "Look"
        self._picks: list[SurfacePick] = []
        self._reference: Reference | None = None
        self._elsewhere: HandMeasure | None = None
        self._is_told = False  # what a reference without a length is
        self._hint = gui.add_markdown("")
        self._back = window.on(gui.add_button(_BACK, visible=False), self._go_to_reference)
        modes = gui.add_button_group("Measure", get_args(Mode)[1:])
        modes.on_click(lambda event: window.do(self._choose, modes.value))
        self.picture = PicturePart(shown, images)
        self._points = points = gui.add_button_group("Points", ["Undo", "Clear"], visible=False)
        points.on_click(lambda event: window.do(self._take_back, points.value))
        self._area = window.on(gui.add_button("Measure the area", visible=False), self._measure)
        self._length = gui.add_text("Length of this line, mm", "", visible=False)
        self._length.hint = "Empty where it is not known: other lengths are then multiples of it"
        self._refer = window.on(gui.add_button("Use as reference", visible=False), self._use_as_reference)
        forget = gui.add_button("Forget the reference", visible=False, color="gray")
        self._forget = window.on(forget, self._forget_reference)
        self._lesion = LesionPart(
            shown, lambda: self._reference, self._say_mode, lambda one, line: self._measured.add(one, line)
        )
        self._measured = MeasuredList(shown)
        shown.follow(submap=self._follow_surface)
        self._follow_surface()

    @property
    def _is_known(self) -> bool:
        return self._shown.whole.scale_known or self._reference is not None

    def add(self, pick: SurfacePick) -> None:
        """Take a place that was clicked on the surface, by what a click is for."""
        if self.mode == "Lesion":
            self._lesion.add(pick)
            return
        if self.mode == "Distance" and len(self._picks) == 2:
            self._picks = []
        self._picks.append(pick)
        self._is_told = False
        self._show()
        if self.mode == "Distance" and len(self._picks) == 2 and self._is_known:
            self._measure()

    def stop(self) -> None:
        """Let clicks no longer measure."""
        self._choose("Look")

    def _choose(self, mode: str) -> None:
        self.mode = next(known for known in get_args(Mode) if known == mode)
        self._picks, self._is_told = [], False
        self._shown.note("")
        self._lesion.begin(shown=self.mode == "Lesion")
        self._show()

    def _take_back(self, how: str) -> None:
        if self.mode == "Lesion":
            self._lesion.take_back(how == "Clear")
            return
        self._picks = [] if how == "Clear" else self._picks[:-1]
        self._show()

    def _measure(self) -> None:
        surface, picks, reference = self._shown.surface, [*self._picks], self._reference
        frame = self.picture.frame

        def work() -> tuple[HandMeasure, np.ndarray]:
            found = measure_by_hand(surface, picks, reference, frame)
            return found, line_on_surface(surface, found.frame, found.world)

        def then(found: tuple[HandMeasure, np.ndarray]) -> None:
            one, line = found
            # The ends of a distance stay: of known length, it becomes the reference.
            if self.mode != "Distance":
                self._picks = []
            self._shown.note(", ".join(f"{found.what}: {short(found)}" for found in one.found))
            self._show()
            self._measured.add(one, line)

        self._shown.window.job("measuring", work, then)

    def _use_as_reference(self) -> None:
        length_mm, is_empty = typed_number(self._length.value), not self._length.value.strip()
        if not (length_mm > 0 or (is_empty and self._is_told)):
            self._is_told = is_empty
            self._shown.note(_EMPTY if is_empty else "Type the length in mm, such as 2.5.")
            return
        first, second = self._picks
        reference = Reference((first, second), length_mm if length_mm > 0 else None)
        self._measured.keep_reference(reference)
        self._picks, self._length.value = [], ""
        self._refer_to(reference)
        self._shown.note("The reference is set. Now measure with two clicks.")

    def _forget_reference(self) -> None:
        self._measured.keep_reference(None)
        self._refer_to(None)
        self._shown.note("The reference is forgotten.")

    def _refer_to(self, reference: Reference | None) -> None:
        """Use a reference, or none, and say what sizes are by it."""
        self._reference, self._elsewhere = reference, self._measured.kept_reference()[1]
        self._shown.say_sizes("" if reference is None else sizes_by(reference.length_mm))
        self._measured.show(reference)
        self._show()

    def _follow_surface(self) -> None:
        self._picks = []
        self._refer_to(self._measured.kept_reference()[0])
        self._shown.note(self._where_reference_is())
        self._lesion.begin(shown=self.mode == "Lesion")

    def _where_reference_is(self) -> str:
        """Return on which surface the reference is, where that is another than the one shown; else ""."""
        one, whole = self._elsewhere, self._shown.whole
        return "" if one is None else _ELSEWHERE.format(part=part_words(whole, one), back=_BACK)

    def _go_to_reference(self) -> None:
        one = self._elsewhere
        if one is not None and (number := submap_of(self._shown.whole, one)) is not None:
            self._shown.show_frame_of(number, one.frame)

    def _show(self) -> None:
        shown, picks, scene = self._shown, self._picks, self._shown.window.scene
        two = self.mode == "Distance" and len(picks) == 2
        self._length.visible = self._refer.visible = two
        self._forget.visible = self._reference is not None
        elsewhere = self._elsewhere
        self._back.visible = elsewhere is not None and submap_of(shown.whole, elsewhere) is not None
        self._area.visible = self.mode == "Area" and len(picks) >= _FEWEST
        self._hint.content = _CHOOSE if self._is_known else _UNKNOWN
        size_mm = shown.surface.size_mm
        draw_marks(scene, _PICKED, self._places(picks), size_mm)
        reference = self._reference
        ends = self._places(list(reference.picks) if reference else [])
        words = f"{reference.length_mm:g} mm" if reference and reference.length_mm else "reference"
        draw_marks(scene, _REFERRED, ends, size_mm, words, REFERENCE)
        self._say_mode()

    def _places(self, picks: list[SurfacePick]) -> np.ndarray:
        return np.array([self._shown.surface.position(pick) for pick in picks])

    def _say_mode(self) -> None:
        """Say what the next click does, and offer to take back where there is something."""
        count = self._lesion.count if self.mode == "Lesion" else len(self._picks)
        # They stay where they are: what came up in their place was clicked instead.
        self._points.visible = self.mode != "Look"
        self._shown.clicks_are_for(self._next_click(count))

    def _next_click(self, count: int) -> str:
        if self.mode == "Look":
            return LOOKING
        if self.mode == "Distance":
            if self._is_known:
                return f"Distance: click on the {'2nd' if count == 1 else '1st'} of 2 points."
            if count == 2:
                return "Distance: press Use as reference, in Measure."
            return f"Distance: click on the {'2nd' if count == 1 else '1st'} end of a known length."
        what = self.mode.lower()
        if count < _FEWEST:
            return f"{self.mode}: click on point {count + 1} of 3 or more around it."
        return f"{self.mode}: add points, or press Measure the {what}."
