"""What the parts of a result's page share: the result, the submap and frame that are shown, and who follows them."""

from __future__ import annotations

import html
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scopemap.apps.browser.scene import look_at, look_from
from scopemap.apps.browser.serving import NEXT_CLICK
from scopemap.apps.browser.shown_surface import ShownSurface
from scopemap.apps.browser.window import escaped
from scopemap.engine.errors import InputError
from scopemap.report.measured_by_hand import advice_with_sizes
from scopemap.report.page import PAGE, write_report
from scopemap.report.shown_maps import opening_row
from scopemap.report.summary_picture import NOT_A_DEVICE, TONES
from scopemap.result.frame_table import NOT_USED
from scopemap.result.result import Result
from scopemap.result.verdict import verdict

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow
    from scopemap.apps.browser.workspace import Workspace
    from scopemap.apps.coverage.coverage import Coverage

LOOKING = "A click shows which frames saw the place."
"""What a click is for where nothing is measured."""

MODEL = "/page/model"
"""Node of the scene that holds the surface and the camera's path."""

_NOTHING = "\u00a0"
"""Keeps a line's place."""
_WHOLE_FOV = 0.9
"""Vertical field of view from outside, rad."""


class ShownResult:
    """A result as it is looked at; `whole` is all of it, `run` the submap whose surface is shown.

    rows : of the frames that were used, in the table of the whole result. row : of the frame that is shown.
    """

    def __init__(self, window: BrowserWindow, whole: Result, workspace: Workspace | None) -> None:
        self.window, self.whole, self.workspace = window, whole, workspace
        self.rows = np.flatnonzero(whole.frames.submap != NOT_USED).tolist()
        self.row = opening_row(whole)
        self.number, self.surface = 0, ShownSurface(whole)
        self._surfaces: dict[tuple[int, int | None], ShownSurface] = {(0, None): self.surface}
        self._model = window.scene.add_frame(MODEL, show_axes=False)
        self._click_words = LOOKING
        self._of_note: list[Callable[[], None]] = []
        self._of_frame: list[Callable[[], None]] = []
        self._of_measuring: list[Callable[[], None]] = []
        self._of_submap: list[Callable[[], None]] = []
        self._of_sizes: list[Callable[[], None]] = []
        self._coverage: dict[int, Coverage] = {}

    @property
    def run(self) -> Result:
        """The result, or the submap, whose surface is shown."""
        return self.surface.run

    @property
    def index(self) -> int:
        """The number of the frame that is shown."""
        return int(self.whole.frames["index"][self.row]) if len(self.whole.frames) else -1

    @property
    def pose(self) -> np.ndarray | None:
        """The pose (4, 4) of the frame that is shown; None where it is not tracked in this submap."""
        frames = self.run.frames
        row = np.flatnonzero(frames["index"] == self.index)
        if not len(row) or not frames.tracked[row[0]]:
            return None
        return np.asarray(frames["T_world_camera"][row[0]])

    @property
    def folder_words(self) -> str:
        """The folder of the whole result as commands name it; no name where names are not shown."""
        return "RESULT" if self.window.anonymous else str(self.whole.folder)

    @cached_property
    def vertical_fov(self) -> float:
        """Of the frames, rad."""
        return float(2 * np.arctan(self.whole.camera.height / 2 / self.whole.camera.fy))

    @property
    def measuring(self) -> bool:
        """Whether clicks measure."""
        return self._click_words != LOOKING

    def follow(
        self,
        *,
        frame: Callable[[], None] | None = None,
        submap: Callable[[], None] | None = None,
        measuring: Callable[[], None] | None = None,
        note: Callable[[], None] | None = None,
        sizes: Callable[[], None] | None = None,
    ) -> None:
        """Call where another frame, submap or note is shown, where measuring begins or ends, or sizes change."""
        self._of_frame += [frame] if frame else []
        self._of_submap += [submap] if submap else []
        self._of_measuring += [measuring] if measuring else []
        self._of_note += [note] if note else []
        self._of_sizes += [sizes] if sizes else []

    def clicks_are_for(self, words: str) -> None:
        """Say over the scene what the next click does; `LOOKING`: nothing is measured."""
        changed = (words != LOOKING) != self.measuring
        self._click_words = words
        self._clicks.content = clicks_html(words, measuring=self.measuring)
        if changed:
            for call in self._of_measuring:
                call()

    def show_row(self, row: int) -> None:
        """Show the frame of a row, and the surface of its segment."""
        self.row = row
        if self.pose is not None and (segment := self.run.segment_at(self.index)) != self.surface.segment:
            self._show_surface(segment)
        for call in self._of_frame:
            call()

    def _show_surface(self, segment: int | None = None) -> None:
        """Show the surface of a segment of the submap that is shown; None: its main one."""
        if (self.number, segment) not in self._surfaces:
            run = self.whole.submaps[self.number]
            self._surfaces[self.number, segment] = ShownSurface(run, segment=segment)
        self.surface = self._surfaces[self.number, segment]
        for call in self._of_submap:
            call()

    def show_frame(self, index: int) -> None:
        """Show the frame with this number."""
        self.show_row(int(np.flatnonzero(self.whole.frames["index"] == index)[0]))

    def show_frame_of(self, number: int, index: int) -> None:
        """Show the frame with this number of a submap, and the surface of its segment."""
        if number != self.number:
            self.show_submap(number)
        self.show_frame(index)
        self.look_at_all()

    def show_submap(self, number: int) -> None:
        """Show the main surface of another submap, and its first frame."""
        self._show_part(number)

    def _show_part(self, number: int, segment: int | None = None) -> None:
        """Show the surface of a segment of a submap, None: its main one, and its first frame."""
        self.number = number
        self._show_surface(segment)
        frames = self.surface.frames
        if len(frames):
            self.show_frame(int(frames["index"][0]))
        else:
            self.show_row(self.row)
        self.look_at_all()

    def show_segment(self, segment: int) -> None:
        """Show the surface of a segment of the result, and its first frame."""
        self._show_part(0, segment)

    def show_model(self, *, shown: bool) -> None:
        """Show what is below `MODEL` in the scene, or hide it."""
        self._model.visible = shown

    def look_at_all(self) -> None:
        """Look at the whole surface from behind its first camera."""
        poses = self.surface.frames["T_world_camera"]
        points = np.asarray(self.surface.mesh.vertices)
        points = points if len(points) else poses[:, :3, 3]
        if len(poses):
            self._see_with(_WHOLE_FOV)
            look_at(self.window, poses[0], points)

    def look_from_frame(self) -> None:
        """Look from the camera of the frame that is shown."""
        if (pose := self.pose) is None:
            self.note("This frame has no pose in this submap: nothing can be seen from it.")
            return
        # Dragging turns about the target: nearer than the tissue, it would swing the tissue out of sight.
        depth_mm = self.run.depth.read(self.index)
        seen = np.array([]) if depth_mm is None else depth_mm[np.isfinite(depth_mm)]
        ahead = float(np.median(seen)) if seen.size else max(0.2 * self.surface.size_mm, 1e-3)
        self._see_with(self.vertical_fov, self.whole.camera.width / self.whole.camera.height)
        look_from(self.window, pose[:3, 3], pose[:3, 3] + ahead * pose[:3, 2], -pose[:3, 1])

    def look_from_spot(self, place: np.ndarray) -> None:
        """Look from the camera of the frame that is shown at a place (3,)."""
        if (pose := self.pose) is not None:
            self._see_with(_WHOLE_FOV)
            look_from(self.window, pose[:3, 3], place, -pose[:3, 1])

    def note(self, words: str) -> None:
        """Show a sentence that is always seen; "": none."""
        self._note.content = escaped(words) or _NOTHING
        for call in self._of_note:
            call()

    def add_note(self) -> None:
        """Make the places of the sentence and of what a click does."""
        self._clicks = self.window.gui.add_html(clicks_html(LOOKING, measuring=False))
        self._note = self.window.gui.add_markdown(_NOTHING)

    def say_sizes(self, words: str = "") -> None:
        """Show the verdict, with a sentence in place of what it says of sizes; "": as it is."""
        found = verdict(self.whole)
        advice = advice_with_sizes(found.advice, words) if words else found.advice
        self._head.content = f"### {found.word.capitalize()}\n{escaped(advice)}"
        for call in self._of_sizes:
            call()

    def add_headline(self) -> None:
        """Make the place of the verdict in a word, and of what the result may be used for."""
        gui, tone = self.window.gui, TONES[verdict(self.whole).level]
        gui.add_html(f'<div style="height:8px;margin:0 8px;border-radius:4px;background:{tone}"></div>')
        self._head = gui.add_markdown("")
        gui.add_markdown(f"*{NOT_A_DEVICE}*")
        self.say_sizes()

    def coverage(self, then: Callable[[Coverage], None]) -> None:
        """Call with what was not seen of the submap, which is found in a job, once."""
        number, folder = self.number, self.run.folder

        def found(result: Coverage) -> None:
            self._coverage[number] = result
            if number == self.number:
                then(result)

        if number in self._coverage:
            then(self._coverage[number])
            return
        self.window.job("looking for what was not seen", lambda: _kept_coverage(folder), found)

    def _see_with(self, fov_rad: float, aspect: float = 1.0) -> None:
        """Let all browsers see a vertical field of view, narrow ones all of its width, `aspect` times as wide."""
        self.window.server.initial_camera.fov = fov_rad
        for client in self.window.server.get_clients().values():
            narrow = max(1.0, aspect / max(client.camera.aspect, 1e-3))
            client.camera.fov = float(2 * np.arctan(np.tan(fov_rad / 2) * narrow))


def _kept_coverage(folder: Path) -> Coverage:
    """Return what was not seen of a result; it is kept beside that and in its report, where they can be written."""
    from scopemap.apps.coverage.coverage import coverage
    from scopemap.report.page_data import COVERAGE

    found = coverage(folder)
    with suppress(InputError):
        found.save(folder / COVERAGE)
        if (folder / PAGE).is_file():
            write_report(folder)
    return found


def clicks_html(words: str, *, measuring: bool) -> str:
    """Return what the next click does, as it stands over the scene."""
    kind = f"{NEXT_CLICK} measures" if measuring else NEXT_CLICK
    return f'<div class="{kind}" role="status">{html.escape(words)}</div>'
