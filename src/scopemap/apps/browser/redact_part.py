"""Boxes to blacken that are drawn by hand: two clicks on a picture of the video, which is shown in the scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scopemap.apps.browser.run_choice import Box, boxes_of
from scopemap.apps.browser.scene import look_from

if TYPE_CHECKING:
    from viser import SceneClickEvent

    from scopemap.apps.browser.window import BrowserWindow
    from scopemap.apps.inspect.inspecting import Inspection

_PICTURE = "/page/to_blacken"
_FIRST = "Click on a corner of the box, in the picture."
_SECOND = "Click on the opposite corner."
_NO_BOX = "The two corners make no box: click on them again, in the picture."
_CORNER = (255, 220, 0)
_CORNER_SHARE = 0.04
_LEAST_SHARE = 0.002


class RedactPart:
    """Controls of drawing; changed : called with the boxes that were drawn so far, px of the input's pictures."""

    def __init__(self, window: BrowserWindow, spread: Inspection, changed: Callable[[tuple[Box, ...]], None]) -> None:
        self._window, self._spread, self._changed, gui = window, spread, changed, window.gui
        self._drawn: list[tuple[float, float, float, float]] = []
        self._corner: tuple[float, float] | None = None
        hint = "For a name that was not found: it is black in everything that the run writes."
        self._switch = window.on(gui.add_checkbox("Draw boxes to blacken", False, hint=hint), self._begin_or_end)
        self._words = gui.add_markdown("", visible=False)
        count = len(spread.samples)
        self._which = gui.add_slider("Picture", 1, max(count, 2), 1, (count + 1) // 2, visible=False)
        window.on(self._which, lambda value: self._show())
        self._back = window.on(gui.add_button("Take back the last box", color="gray", visible=False), self._take_back)

    def close(self) -> None:
        """End what takes clicks."""
        self._window.scene.remove_click_callback(self._clicked)

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Take a click by its ray, (3,) each: a corner of a box."""
        if not self._switch.value or direction[2] <= 0 or origin[2] >= 1:
            return
        place = origin + (1 - origin[2]) / direction[2] * direction
        width, height = self._spread.size
        x, y = place[0] + 0.5, place[1] * width / height + 0.5
        # Names stand at the rim: a click a little beside the picture is one on its rim.
        x, y = float(np.clip(x, 0, 1)), float(np.clip(y, 0, 1))
        if self._corner is None:
            self._corner = x, y
            self._show(_SECOND)
            return
        (left, right), (top, bottom) = sorted((self._corner[0], x)), sorted((self._corner[1], y))
        self._corner = None
        if min(right - left, bottom - top) < _LEAST_SHARE:
            self._show(_NO_BOX)
            return
        self._drawn.append((left, top, right, bottom))
        self._tell()

    def _begin_or_end(self, is_on: bool) -> None:
        window, self._corner = self._window, None
        self._words.visible = self._which.visible = is_on
        if is_on:
            window.scene.on_click()(self._clicked)
            look_from(window, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
            self._show()
        else:
            self.close()
            window.scene.remove_by_name(_PICTURE)

    def _clicked(self, event: SceneClickEvent) -> None:
        """Take a click in the scene; called by a thread of the server."""
        self._window.do(self.click, np.array(event.ray_origin), np.array(event.ray_direction))

    def _take_back(self) -> None:
        self._drawn, self._corner = self._drawn[:-1], None
        self._tell()

    def _tell(self) -> None:
        from scopemap.apps.inspect.burned_in import Overlay

        self._back.visible = bool(self._drawn)
        self._changed(boxes_of(self._spread, [Overlay(box, in_field=False) for box in self._drawn]))
        if self._switch.value:
            self._show()

    def _show(self, words: str = _FIRST) -> None:
        """Show the picture as the run will have it, with the corner that was clicked on."""
        samples = self._spread.samples
        rgb = samples[min(int(self._which.value), len(samples)) - 1].rgb.copy()
        height, width = rgb.shape[:2]
        for left, top, right, bottom in self._drawn:
            rgb[int(top * height) : int(bottom * height) + 1, int(left * width) : int(right * width) + 1] = 0
        if self._corner is not None:
            place = int(self._corner[0] * width), int(self._corner[1] * height)
            cv2.drawMarker(rgb, place, _CORNER, cv2.MARKER_CROSS, max(5, int(_CORNER_SHARE * width)))
        self._words.content = words
        size, place_mm = self._spread.size, (0.0, 0.0, 1.0)
        self._window.scene.add_image(
            _PICTURE, rgb, 1.0, size[1] / size[0], cast_shadow=False, receive_shadow=False, position=place_mm
        )
