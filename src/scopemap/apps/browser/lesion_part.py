"""A lesion: its outline, clicked in the view of one frame, and its sizes from all frames, with the command for them."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scopemap.apps.browser.hand_measures import (
    Reference,
    broken,
    folder_in_whole,
    pixels_in_words,
    reference_words,
    rounded,
)
from scopemap.apps.browser.marks import draw_marks
from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.seen_by import frames_that_saw
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.apps.browser.window import escaped, fenced
from scopemap.apps.measure.lesion import MeasuredLesion, measure_lesion
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse, transform

_OUTLINE = "/page/lesion"
_FEWEST = 3


class LesionPart:
    """Controls of a lesion's outline in the frame that is shown when it begins.

    changed : called where there are more corners, or fewer.
    """

    def __init__(
        self, view: ResultView, reference: Callable[[], Reference | None], changed: Callable[[], None]
    ) -> None:
        self._view, self._reference = view, reference
        self._changed = changed
        self._picks: list[SurfacePick] = []
        self._frame = -1
        gui = view.window.gui
        self._button = view.window.on(gui.add_button("Measure the lesion", visible=False), self._measure)
        self._found = gui.add_markdown("", visible=False)
        self._folder = gui.add_folder("Command", expand_by_default=False, visible=False)
        with self._folder:
            self._command = gui.add_markdown("")

    @property
    def count(self) -> int:
        """How many corners there are."""
        return len(self._picks)

    def begin(self, *, shown: bool) -> None:
        """Begin an outline in the frame that is shown, seen from there; or end it, where the mode is another one."""
        self._picks, self._frame = [], self._view.index
        if shown:
            if self._view.pose is None:
                self._view.note("This frame has no pose in this submap: choose a tracked frame first.")
            else:
                self._view.look_from_frame()
        self._show()

    def add(self, pick: SurfacePick) -> None:
        """Take a corner that was clicked; of another frame a new outline begins."""
        if self._view.index != self._frame:
            self._picks, self._frame = [], self._view.index
        pixel = corners_in(self._view.surface, self._frame, [pick])[0]
        camera = self._view.whole.camera
        if not (np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel < [camera.width, camera.height]).all()):
            self._view.note(f"Frame {self._frame} does not show this place: press Look from here, in Frames.")
            return
        self._picks.append(pick)
        self._show()

    def take_back(self, everything: bool) -> None:
        """Take back the last corner, or all."""
        self._picks = [] if everything else self._picks[:-1]
        self._show()

    def _show(self) -> None:
        view = self._view
        self._button.visible = len(self._picks) >= _FEWEST
        points = np.array([view.surface.position(pick) for pick in self._picks])
        draw_marks(view.window.scene, _OUTLINE, points, view.surface.size_mm)
        self._changed()

    def _measure(self) -> None:
        surface, frame = self._view.surface, self._frame
        corners = rounded(corners_in(surface, frame, self._picks))
        reference = self._reference()

        def measure() -> tuple[MeasuredLesion, str]:
            known, of_frame, length_mm = _reference_pixels(surface, reference, frame)
            found = measure_lesion(
                surface.run.folder,
                corners,
                frame,
                reference=known,
                reference_frame=of_frame,
                reference_mm=length_mm,
            )
            folder = Path(self._view.folder_words) / folder_in_whole(surface.run)
            words = ["scopemap", "measure", shlex.quote(str(folder)), "--frame", str(frame)]
            words += ["--lesion", f'"{pixels_in_words(corners)}"', *reference_words(known, length_mm)]
            words += [] if of_frame is None else ["--reference-frame", str(of_frame)]
            return found, " ".join(words)

        self._view.window.job("measuring the lesion", measure, self._say)

    def _say(self, measured: tuple[MeasuredLesion, str]) -> None:
        found, command = measured
        lines = [f"- {escaped(str(one))}" for one in found.measures]
        lines.append(f"\nFrom {len(found.masks)} frames; the scale rests on {escaped(found.scale)}.")
        self._found.content, self._command.content = "\n".join(lines), fenced(broken(command))
        self._found.visible = self._folder.visible = True
        self._view.note(str(found.measures[0]))


def corners_in(surface: ShownSurface, frame: int, picks: list[SurfacePick]) -> np.ndarray:
    """Return the pixels (N, 2) of places in a frame, NaN behind it. Raises `InputError` where it has no pose."""
    tracked = surface.run.tracked
    row = np.flatnonzero(tracked["index"] == frame)
    if not len(row):
        raise InputError(f"frame {frame} has no pose in this submap: choose a tracked frame")
    places = np.array([surface.position(pick) for pick in picks])
    return surface.run.camera.project(transform(inverse(tracked["T_world_camera"][row[0]]), places))


def _reference_pixels(
    surface: ShownSurface, reference: Reference | None, frame: int
) -> tuple[np.ndarray | None, int | None, float | None]:
    """Return the pixels (2, 2) of a reference, their frame where it is not `frame`, and its length, mm."""
    if reference is None:
        return None, None, None
    seen = frames_that_saw(surface, reference.picks)
    if not seen:
        raise InputError("no frame saw both ends of the reference: choose another one")
    best = next((sight for sight in seen if sight.frame == frame), seen[0])
    return rounded(best.pixels), None if best.frame == frame else best.frame, reference.length_mm
