"""What changed between two examinations: a list that flies to each change, with the frames of both that show it."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from scopemap.apps.browser.files_part import video_name
from scopemap.apps.browser.legends import words_html
from scopemap.apps.browser.marks import draw_marks
from scopemap.apps.browser.scene import draw_path, look_from
from scopemap.apps.browser.surface_pair import TINTS, SurfacePair, tinted
from scopemap.apps.browser.window import escaped
from scopemap.apps.exams.change import Change
from scopemap.apps.exams.change_painting import COMPARED
from scopemap.apps.exams.compare_exams import ExamComparison
from scopemap.apps.exams.examination import as_compared, to_mm
from scopemap.apps.exams.exams_page import comparison_page, pictures_of, pictures_of_view
from scopemap.apps.exams.fit import ExamFit
from scopemap.apps.exams.wording import seen_words, summary
from scopemap.apps.measure.hand_measure import HandMeasure, kept_measures
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.report.sheet import rgb_of
from scopemap.result.result import Result

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_MOST = 12
_MARK_SHARE = 0.02
_MARK = (255, 208, 0)
_CHANGED = "what changed"
_PICTURE = "picture"
_COMPARED = "compared"
"""Attribute of a vertex, as in `ExamComparison`."""

_NO_FRAME = "Choose a place that both examinations show, or a change."


class ShownChanges:
    """The part of the page that shows two examinations."""

    def __init__(
        self, window: BrowserWindow, found: ExamComparison, folders: tuple[Path, Path], names: tuple[str, str]
    ) -> None:
        runs = as_compared(folders[0]), Result(folders[1])
        self._window, self._found, self._runs, self._folders, self._names = window, found, runs, folders, names
        self._poses = runs[0].frames["T_world_camera"][runs[0].frames.tracked]

    def open(self) -> None:
        """Make the elements."""
        window, gui, found, first = self._window, self._window.gui, self._found, self._runs[0]
        judged, *lines = (escaped(line) for line in summary(found, first.scale, self._names))
        gui.add_markdown("\n".join([f"**{judged}**\n", *(f"- {line}" for line in lines)]))
        surfaces = [_compared(*one) for one in zip((first.mesh, found.second), found.compared, strict=True)]
        self._pair = SurfacePair(window, surfaces, self._poses, self._names)
        draw_path(window.scene, f"{self._pair.nodes[0]}/path", self._poses[:, :3, 3])
        self._draw_lesions()
        unit = "mm" if first.scale_known else "units"
        for number, change in enumerate(found.changes[:_MOST], 1):
            seen = "" if change.seen_in == "both" else f", in {seen_words(change, self._names)} alone"
            label = f"{number}: {change.what}, {change.area_mm2:.1f} {unit}²{seen}"
            window.on(gui.add_button(label), self._fly, number, change)
        if found.views:
            names = [f"frames {one} and {other}" for one, other in found.views]
            window.on(gui.add_dropdown("The same place", names), self._show_view, names)
        self._words = gui.add_markdown(_NO_FRAME)
        self._pictures = [gui.add_image(np.zeros((8, 10, 3), np.uint8), visible=False) for _ in range(2)]
        is_judged = found.fit is not ExamFit.NONE
        if is_judged:
            window.on(gui.add_dropdown("Colours", (_CHANGED, _PICTURE)), self._colour)
        self._legend = gui.add_html("")
        if is_judged:
            window.on(gui.add_checkbox("One over the other", initial_value=False), self._overlay)
        button = gui.add_button("Download the comparison")
        button.on_click(lambda event: window.do(self._send, event.client))
        gui.add_markdown("It is one file to keep, print or send, with the table and the pictures.")
        if not window.anonymous:
            command = shlex.join(["scopemap", "compare-exams", *map(str, self._folders), "--out", "comparison"])
            gui.add_markdown(f"The same as a page:\n```\n{command}\n```")
        self._colour(_CHANGED if is_judged else _PICTURE)

    def _draw_lesions(self) -> None:
        """Draw the lesions that are kept with either, where they lie in the world of the first."""
        factor, S = to_mm(Result(self._folders[0])), self._found.registration.S_first_second
        size_mm = float(self._runs[0].mesh.scale)
        for node, folder, is_first in zip(self._pair.nodes, self._folders, (True, False), strict=True):
            for number, one in enumerate(_lesions_of(folder)):
                world = one.world * factor if is_first else S.transform_points(one.world)
                draw_marks(self._window.scene, f"{node}/lesion/{number}", world, size_mm, one.name or "lesion")

    def _overlay(self, is_over: bool) -> None:
        self._pair.place(is_over)
        self._colour(self._chosen)

    def _colour(self, chosen: str) -> None:
        """Show both in the chosen colours; over each other they have a tint each, but where they changed."""
        self._chosen, is_over, legend = chosen, self._pair.overlaid, dict[str, str]()
        colours = [np.asarray(vertex_colours(surface)[:, :3]) for surface in self._pair.shown]
        if is_over:
            colours = [tinted(*each) for each in zip(colours, TINTS, strict=True)]
            legend = dict(zip(self._names, TINTS, strict=True))
        if chosen == _CHANGED:
            meanings = dict([*COMPARED.items()][-1:]) if is_over else COMPARED
            table = np.array([rgb_of(colour) for colour in COMPARED.values()], np.uint8)
            for number, surface in enumerate(self._pair.shown):
                attribute: Any = surface.vertex_attributes[_COMPARED]
                of = np.round(attribute).astype(int)
                shown = of == len(COMPARED) - 1 if is_over else np.ones(len(of), bool)
                colours[number] = np.where(shown[:, None], table[of], colours[number])
            legend |= meanings
        self._pair.draw(colours)
        self._legend.content = words_html(legend) if legend else ""

    def _fly(self, number: int, change: Change) -> None:
        """Look at a change from where the first camera saw it best, and show the frames of both."""
        place, index = change.place_mm, self._runs[0].frames["index"][self._runs[0].frames.tracked]
        row = np.flatnonzero(index == change.frames[0])
        nearest = np.linalg.norm(self._poses[:, :3, 3] - place, axis=1).argmin()
        pose = self._poses[row[0] if len(row) else nearest]
        radius = _MARK_SHARE * float(np.linalg.norm(pose[:3, 3] - place))
        scene, (node, _) = self._window.scene, self._pair.nodes
        scene.add_icosphere(f"{node}/change", radius, _MARK, position=tuple(place), cast_shadow=False)
        look_from(self._window, pose[:3, 3], place, -pose[:3, 1])
        nearer = f"{abs(change.rise_mm):.2f} {'mm' if self._runs[0].scale_known else 'units'}"
        nearer += f" {'nearer to' if change.rise_mm > 0 else 'farther from'} the camera in {escaped(self._names[1])}"
        words = f"**{number}: {change.what}**, {nearer}; {change.sigmas:.0f} sigmas, in {change.views} views of "
        words += escaped(seen_words(change, self._names))
        self._show(words, pictures_of(self._runs, self._names, self._found, change, number))

    def _show_view(self, chosen: str, names: list[str]) -> None:
        self._show(f"**{chosen}**", pictures_of_view(self._runs, self._names, self._found.views[names.index(chosen)]))

    def _send(self, client: Any) -> None:
        """Send the page of the comparison to a browser, under the names of both videos."""
        page = comparison_page(self._found, self._runs, self._names).encode("utf-8")
        one, other = (video_name(self._window, run) for run in self._runs)
        if client is not None:
            client.send_file_download(f"{one}_and_{other}.html", page, save_immediately=True)

    def _show(self, words: str, pictures: dict[str, np.ndarray]) -> None:
        self._words.content = words
        for handle, (name, picture) in zip(self._pictures, pictures.items(), strict=True):
            handle.image, handle.label, handle.visible = picture, ", ".join(name.split("\n")).removeprefix(", "), True


def _lesions_of(folder: Path) -> list[HandMeasure]:
    """Return the lesions that are kept for the surface of a result that is compared: that of its main segment."""
    run = Result(folder)
    tracked = set(run.tracked["index"].tolist())
    lesions = [one for one in kept_measures(folder) if (one.kind, one.folder) == ("lesion", ".")]
    return [one for one in lesions if one.frame in tracked and run.segment_at(one.frame) == run.main_segment]


def _compared(mesh: trimesh.Trimesh, compared: np.ndarray) -> trimesh.Trimesh:
    """Return a surface with what was compared of its vertices."""
    shown = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=vertex_colours(mesh), process=False)
    shown.vertex_attributes[_COMPARED] = compared.astype(float)
    return shown
