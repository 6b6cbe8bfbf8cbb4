"""A lesion: its outline, clicked in the view of one frame, its name, and its sizes from all frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scopemap.apps.browser.hand_measures import Reference, frame_of_reference, line_on_surface
from scopemap.apps.browser.marks import draw_marks
from scopemap.apps.browser.seen_by import corners_in
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.apps.measure.hand_measure import HandMeasure, rounded
from scopemap.apps.measure.lesion import measure_lesion
from scopemap.report.measured_by_hand import folder_in_whole

_OUTLINE = "/page/lesion"
_FEWEST = 3


class LesionPart:
    """Controls of a lesion's outline in the frame that is shown when it begins.

    changed : called where there are more corners, or fewer. keep : takes the lesion, and its line on the surface.
    """

    def __init__(
        self,
        shown: ShownResult,
        reference: Callable[[], Reference | None],
        changed: Callable[[], None],
        keep: Callable[[HandMeasure, np.ndarray], None],
    ) -> None:
        self._shown, self._reference = shown, reference
        self._changed, self._keep = changed, keep
        self._picks: list[SurfacePick] = []
        self._frame = -1
        gui = shown.window.gui
        self._name = gui.add_text("Name of the lesion", "", visible=False)
        self._name.hint = "As it is to be found in the list and the report"
        self._button = shown.window.on(gui.add_button("Measure the lesion", visible=False), self._measure)

    @property
    def count(self) -> int:
        """How many corners there are."""
        return len(self._picks)

    def begin(self, *, shown: bool) -> None:
        """Begin an outline in the frame that is shown, seen from there; or end it, where the mode is another one."""
        self._picks, self._frame = [], self._shown.index
        if shown:
            if self._shown.pose is None:
                self._shown.note("This frame has no pose in this submap: choose a tracked frame first.")
            else:
                self._shown.look_from_frame()
                self._shown.note(f"A lesion is outlined in one frame: the view is now that of frame {self._frame}.")
        self._show()

    def add(self, pick: SurfacePick) -> None:
        """Take a corner that was clicked; of another frame a new outline begins."""
        if self._shown.index != self._frame:
            self._picks, self._frame = [], self._shown.index
        pixel = corners_in(self._shown.surface, self._frame, [pick])[0]
        camera = self._shown.whole.camera
        if not (np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel < [camera.width, camera.height]).all()):
            self._shown.note(f"Frame {self._frame} does not show this place: press Look from here, in Frames.")
            return
        self._picks.append(pick)
        self._show()

    def take_back(self, everything: bool) -> None:
        """Take back the last corner, or all."""
        self._picks = [] if everything else self._picks[:-1]
        self._show()

    def _show(self) -> None:
        shown = self._shown
        self._button.visible = self._name.visible = len(self._picks) >= _FEWEST
        points = np.array([shown.surface.position(pick) for pick in self._picks])
        draw_marks(shown.window.scene, _OUTLINE, points, shown.surface.size_mm)
        self._changed()

    def _measure(self) -> None:
        surface, frame, picks = self._shown.surface, self._frame, [*self._picks]
        reference, name = self._reference(), self._name.value.strip()

        def measure() -> tuple[HandMeasure, np.ndarray]:
            found = lesion_by_hand(surface, frame, picks, reference, name)
            return found, line_on_surface(surface, frame, found.world)

        def then(found: tuple[HandMeasure, np.ndarray]) -> None:
            self._picks, self._name.value = [], ""
            self._shown.note(str(found[0].found[0]))
            self._show()
            self._keep(*found)

        self._shown.window.job("measuring the lesion", measure, then)


def lesion_by_hand(
    surface: ShownSurface, frame: int, picks: list[SurfacePick], reference: Reference | None, name: str
) -> HandMeasure:
    """Return the sizes of a lesion with these corners in a frame, as `scopemap measure --lesion` finds them.

    Raises `InputError` where no frame saw both ends of the reference, and as `measure_lesion`.
    """
    corners, known, of_frame, length_mm = rounded(corners_in(surface, frame, picks)), None, None, None
    if reference is not None:
        sight, length_mm = frame_of_reference(surface, reference, frame), reference.length_mm
        known, of_frame = rounded(sight.pixels), None if sight.frame == frame else sight.frame
    found = measure_lesion(
        surface.run.folder, corners, frame, reference=known, reference_frame=of_frame, reference_mm=length_mm
    )
    world, folder = np.array([surface.position(pick) for pick in picks]), folder_in_whole(surface.run)
    return HandMeasure(
        folder, frame, corners, known, length_mm, found.measures, world, "lesion", name, reference_frame=of_frame
    )
