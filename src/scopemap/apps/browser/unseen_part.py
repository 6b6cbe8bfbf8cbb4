"""What was not seen: its share with an interval, and blind spots as a list that flies there."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.window import escaped

if TYPE_CHECKING:
    from scopemap.apps.coverage.coverage import BlindSpot, Coverage

_MOST_LISTED = 20
_MARK = "/page/blind_spot"
_INK = (155, 34, 38)
_SHARE = 0.012


class UnseenPart:
    """Controls of what was not seen."""

    def __init__(self, view: ResultView) -> None:
        self._view, gui = view, view.window.gui
        self._ask = view.window.on(
            gui.add_button("What was not seen", disabled=view.surface.is_empty),
            lambda: view.coverage(self._list),
        )
        self._words = gui.add_markdown("It takes some seconds. Colour by coverage shows it on the surface.")
        self._place = gui.add_folder(None)
        self._buttons: list[Any] = []
        view.follow(submap=self._clear)

    def _clear(self) -> None:
        for button in self._buttons:
            button.remove()
        self._buttons = []
        self._view.window.scene.remove_by_name(_MARK)
        self._ask.disabled, self._words.content = self._view.surface.is_empty, ""

    def _list(self, found: Coverage) -> None:
        self._clear()
        along, area = found.facts["along_unit"], f"{found.unit}²"
        shown = found.spots[:_MOST_LISTED]
        count = f"{len(found.spots)} blind spots" + (
            f", the largest {len(shown)}:" if len(found.spots) > len(shown) else ""
        )
        self._words.content = escaped(f"{found.sentence} {found.scale.capitalize()}. {count}")
        with self._place:
            for number, spot in enumerate(shown, 1):
                size = np.format_float_positional(float(f"{spot.area:.3g}"), trim="-")
                label = f"{number}. {size} {area} at {spot.time_s:.1f} s"
                button = self._view.window.gui.add_button(label, hint=spot.where(along))
                self._buttons.append(self._view.window.on(button, self._fly, number, spot))

    def _fly(self, number: int, spot: BlindSpot) -> None:
        view, place = self._view, np.array(spot.position_mm)
        view.show_frame(spot.frame)
        view.look_from_spot(place)
        scene, radius = view.window.scene, _SHARE * view.surface.size_mm
        scene.add_icosphere(f"{_MARK}/ball", radius, _INK, position=tuple(place), cast_shadow=False)
        scene.add_label(f"{_MARK}/words", f"blind spot {number}", position=tuple(place), anchor="bottom-center")
        view.note(f"Blind spot {number}, seen from frame {spot.frame}, whose camera was nearest.")
