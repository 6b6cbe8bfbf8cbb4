"""Two results in one scene: of one video, how far they are apart; of two examinations, what changed."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from scopemap.apps.browser.legends import ramp_html, words_html
from scopemap.apps.browser.scene import draw_path, look_at
from scopemap.apps.browser.surface_pair import TINTS, SurfacePair, tinted
from scopemap.apps.browser.two_results import TwoResults, apart_of, compare_results, is_alone, is_same_input
from scopemap.apps.browser.window import escaped
from scopemap.apps.exams.wording import names_of
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.report.coverage_picture import OUTSIDE
from scopemap.report.sheet import rgb_of
from scopemap.result.result import Result

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_FIRST, _SECOND = TINTS
_DISTANCE = "distance to the other"
_ALONE = "in one alone"
_PICTURE = "picture"
_PLAIN = "one colour each"
_STOPS = 9


class ComparePage:
    """Two results: of one video, or of two examinations of a place.

    Raises `InputError` where a folder holds no finished run, or both are one.
    """

    def __init__(self, first: Path, second: Path) -> None:
        self._runs = Result(first).checked(with_poses=True), Result(second).checked(with_poses=True)
        if first.resolve() == second.resolve():
            raise InputError(f"{first} cannot be compared with itself: name another result")
        self._folders = first, second

    def open(self, window: BrowserWindow) -> None:
        """Make the elements; what takes long is done beside."""
        self._window, gui = window, window.gui
        given = [window.names.of(folder.resolve(), "result") for folder in self._folders]
        self._names = names_of(given[0], given[1])
        if window.first_page is not None:
            window.on(gui.add_button("Back to the start", color="gray"), window.start)
        first, second = (escaped(name) for name in self._names)
        gui.add_markdown(f"### {first} and {second}")
        if is_same_input(*self._runs):
            window.job("Comparing the paths and surfaces", partial(compare_results, *self._runs), self._show_results)
        else:
            from scopemap.apps.exams.compare_exams import compare_exams

            self._kind = gui.add_markdown("Two videos: they are compared as two examinations of one place.")
            words = "Looking for the places of each examination in the other, which can take minutes"
            window.job(words, partial(compare_exams, *self._folders), self._show_exams)

    def tick(self) -> None:
        """Nothing changes by itself."""

    def close(self) -> None:
        """Nothing was begun."""

    def _show_exams(self, found: Any) -> None:
        from scopemap.apps.browser.changes import ShownChanges

        self._kind.visible = False  # the judgement stands first
        ShownChanges(self._window, found, self._folders, self._names).open()
        exchange = self._window.gui.add_button("Exchange the two", color="gray")
        self._window.on_button(exchange, lambda: self._window.show(ComparePage(*reversed(self._folders))))

    def _show_results(self, found: TwoResults) -> None:
        window, gui, self._found = self._window, self._window.gui, found
        gui.add_markdown("\n".join(f"- {escaped(line)}" for line in found.sentences(*self._names)))
        self._legend = gui.add_html("")
        if found.surfaces is not None:
            self._pair = SurfacePair(window, found.surfaces, np.concatenate(found.poses), self._names)
            chosen = gui.add_dropdown("Colours", (_DISTANCE, _ALONE, _PICTURE, _PLAIN), initial_value=_DISTANCE)
            window.on(chosen, self._colour)
            overlaid = gui.add_checkbox("One over the other", initial_value=False)
            window.on(overlaid, self._overlay)
            self._colour(_DISTANCE)
        else:
            self._legend.content = words_html(self._of_paths())
        places = ("/page", "/page") if found.surfaces is None else self._pair.nodes
        for place, poses, colour, name in zip(places, found.poses, (_FIRST, _SECOND), self._names, strict=True):
            draw_path(window.scene, f"{place}/path {colour}", poses[:, :3, 3], rgb_of(colour))
            if found.surfaces is None:  # else the surfaces have names
                window.scene.add_label(f"{place}/name {colour}", name, position=tuple(poses[0, :3, 3]))
        if found.surfaces is None:
            look_at(window, found.poses[0][0], np.concatenate([poses[:, :3, 3] for poses in found.poses]))
        if not window.anonymous:
            gui.add_markdown(f"The same distance of the paths:\n```\n{found.command(*map(str, self._folders))}\n```")

    def _of_paths(self) -> dict[str, str]:
        first, second = self._names
        return {f"path of {first}": _FIRST, f"path of {second}": _SECOND}

    def _overlay(self, is_over: bool) -> None:
        self._pair.place(is_over)
        self._colour(self._chosen)

    def _colour(self, chosen: str) -> None:
        """Show both surfaces in the chosen colours, and what these mean; pictures over each other are tinted."""
        found, self._chosen = self._found, chosen
        first, second = self._names
        far, legend = found.most_apart, words_html(self._of_paths())
        colours = [np.asarray(vertex_colours(surface)[:, :3]) for surface in self._pair.shown]
        apart, own = [apart_of(surface) for surface in self._pair.shown], [_of(_FIRST), _of(_SECOND)]
        if chosen == _DISTANCE:
            table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
            colours = [table[np.round(255 * np.clip(of / far, 0, 1)).astype(int)] for of in apart]
            stops = [f"#{bytes(table[level]).hex()}" for level in np.linspace(0, 255, _STOPS).astype(int)]
            numbers = ["0", found.number(far / 2), f"{found.number(far)} or more"]
            legend = ramp_html(f"Distance to the other surface, {found.unit}", stops, numbers) + legend
        elif chosen == _ALONE:
            colours = [
                np.where(is_alone(of)[:, None], one, _of(OUTSIDE))
                for of, one in zip(self._pair.shown, own, strict=True)
            ]
            alone = {"in both": OUTSIDE, f"in {first} alone": _FIRST, f"in {second} alone": _SECOND}
            legend = words_html(alone | self._of_paths())
        elif chosen == _PLAIN:
            colours = [np.tile(one, (len(of), 1)) for one, of in zip(own, apart, strict=True)]
        elif self._pair.overlaid:
            colours = [tinted(*each) for each in zip(colours, TINTS, strict=True)]
            legend = words_html({first: _FIRST, second: _SECOND} | self._of_paths())
        self._pair.draw(colours)
        self._legend.content = legend


def _of(colour: str) -> np.ndarray:
    return np.array(rgb_of(colour), np.uint8)
