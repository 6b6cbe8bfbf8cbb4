"""The surface in the scene: what colours it, the camera's path, keyframes, and which submap is shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from scopemap.apps.browser.legends import ramp_html, words_html
from scopemap.apps.browser.scene import PATH_COLOUR, draw_path, quaternion
from scopemap.apps.browser.shown_result import MODEL, ShownResult
from scopemap.apps.browser.shown_surface import facing_of
from scopemap.apps.browser.surface_colours import Colouring, colourings, in_relief, stops_of
from scopemap.apps.browser.unlit_mesh import unlit_glb, unlit_textured_glb
from scopemap.apps.browser.unseen_part import unseen_borders
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.report.coverage_picture import legend_of
from scopemap.report.pale_parts import faded
from scopemap.report.shown_mesh import simplified
from scopemap.report.video_parts import video_parts
from scopemap.result.verdict import level_of_submap
from scopemap.result.wording import LEVEL_WORDS

if TYPE_CHECKING:
    from scopemap.apps.coverage.coverage import Coverage

_SURFACE = f"{MODEL}/surface"
_PATH = f"{MODEL}/path"
_KEYFRAMES = f"{MODEL}/keyframes"
_MOST_FRUSTA = 60
_FRUSTUM_SHARE = 0.03
_COVERAGE = "coverage"
_BORDERS = f"{MODEL}/borders"
_BORDER = (255, 255, 255)
_MOST_FACES = 200_000
_MOST_SUBMAPS = 100
_CLOSED = (
    "Gaps of the surface are closed, but not the open ends of a lumen. Where you see the grey background, nothing was "
    "examined."
)
_BORDERED = "White lines: the borders of what was probably not seen."


@dataclass(frozen=True)
class _CoveredSurface:
    """The closed surface in the colours of what was seen, and the borders (N, 2, 3) of what was not."""

    mesh: trimesh.Trimesh
    colours: np.ndarray
    facing: np.ndarray
    borders: np.ndarray

    def glb(self, *, relief: bool) -> bytes:
        """Return the surface as it is drawn; relief : darker where it does not face a camera."""
        colours = in_relief(self.facing, self.colours) if relief else self.colours
        return unlit_glb(np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces), colours)


class SurfacePart:
    """Controls of the surface, which is drawn when they change."""

    def __init__(self, shown: ShownResult) -> None:
        self._shown, window, gui = shown, shown.window, shown.window.gui
        self._covered: _CoveredSurface | None = None
        if len(shown.whole.submaps) > 1:
            self._names = [_submap_words(shown, number) for number in range(len(shown.whole.submaps[:_MOST_SUBMAPS]))]
            window.on(gui.add_dropdown("Submap", self._names), self._choose_submap)
            gui.add_markdown(strip_words(shown))
        self._by = window.on(gui.add_dropdown("Colour by", self._options()), self._colour)
        self._words = gui.add_markdown("")
        self._legend = gui.add_html("", visible=False)
        self._relief = window.on(gui.add_checkbox("Shading", initial_value=True), lambda value: self._draw())
        self._relief.hint = "Darker where the surface does not face the camera; off: the colours as they are"
        self._path = window.on(gui.add_checkbox("Camera path", initial_value=True), lambda value: self._draw_path())
        self._frusta = window.on(
            gui.add_checkbox("Camera at keyframes", initial_value=False), lambda value: self._draw_path()
        )
        window.on(gui.add_button("Look at the whole surface", color="gray"), shown.look_at_all)
        shown.follow(submap=self._follow_submap)
        self._follow_submap()

    def _options(self) -> list[str]:
        found = list(colourings(self._shown.surface))
        return found if self._shown.surface.is_empty else [*found, _COVERAGE]

    def _choose_submap(self, name: str) -> None:
        self._shown.show_submap(self._names.index(name))

    def _follow_submap(self) -> None:
        self._by.options = self._options()
        self._by.value = self._by.options[0]
        self._colour(self._by.value)
        self._draw_path()

    def _colour(self, name: str) -> None:
        if name == _COVERAGE:
            self._shown.coverage(self._paint_coverage)
            return
        found = colourings(self._shown.surface)[name]()
        self._explain(found)
        self._covered, self._colouring = None, found
        self._draw()

    def _explain(self, found: Colouring) -> None:
        self._words.content, self._legend.visible = found.words, found.ramp is not None
        if found.ramp is not None:
            self._legend.content = ramp_html("", stops_of(found.ramp), found.ticks)

    def _paint_coverage(self, found: Coverage) -> None:
        # What was not examined would close the view into it.
        part = found.painted.submesh([np.flatnonzero(np.isfinite(found.unseen))], append=True, repair=False)
        assert isinstance(part, trimesh.Trimesh)
        painted = simplified(part, _MOST_FACES)
        self._legend.content, self._legend.visible = words_html(legend_of(found.classes)), True
        self._words.content = f"{_CLOSED} {_BORDERED}" if found.unseen_faces.any() else _CLOSED
        cameras = self._shown.run.tracked["T_world_camera"][:, :3, 3]
        colours = np.asarray(vertex_colours(painted)[:, :3])
        self._covered = _CoveredSurface(painted, colours, facing_of(painted, cameras), unseen_borders(found, cameras))
        self._draw()

    def _draw(self) -> None:
        surface, scene = self._shown.surface, self._shown.window.scene
        if surface.is_empty:
            scene.remove_by_name(_SURFACE)
            self._words.content = "There is no surface."
            return
        covered, relief = self._covered, self._relief.value
        content = self._coloured() if covered is None else covered.glb(relief=relief)
        scene.add_glb(_SURFACE, content, cast_shadow=False, receive_shadow=False)
        scene.remove_by_name(_BORDERS)
        if covered is not None and len(covered.borders):
            scene.add_line_segments(_BORDERS, covered.borders, _BORDER, thickness=2.0, thickness_units="screen")

    def _coloured(self) -> bytes:
        """Return the surface as GLB: with its texture, or with the colours that mean something."""
        surface, relief = self._shown.surface, self._relief.value
        found = self._colouring
        if found.picture and (textured := surface.textured) is not None:
            return unlit_textured_glb(textured, surface.texture(pale=found.pale, relief=relief))
        colours = faded(found.colours, surface.sure) if found.pale else found.colours
        return unlit_glb(surface.vertices, surface.faces, in_relief(surface.facing, colours) if relief else colours)

    def _draw_path(self) -> None:
        shown, scene = self._shown, self._shown.window.scene
        tracked = shown.run.tracked
        poses = tracked["T_world_camera"]
        scene.remove_by_name(_PATH)
        scene.remove_by_name(_KEYFRAMES)
        if self._path.value:
            draw_path(scene, _PATH, poses[:, :3, 3])
        if self._frusta.value:
            keyframes = np.flatnonzero(np.isin(tracked["index"], tracked["keyframe"]))
            for row in keyframes[:: -(-len(keyframes) // _MOST_FRUSTA) or 1]:
                scene.add_camera_frustum(
                    f"{_KEYFRAMES}/{row}",
                    shown.vertical_fov,
                    shown.whole.camera.width / shown.whole.camera.height,
                    scale=_FRUSTUM_SHARE * shown.surface.size_mm,
                    color=PATH_COLOUR,
                    thickness=1.5,
                    thickness_units="screen",
                    cast_shadow=False,
                    receive_shadow=False,
                    wxyz=quaternion(poses[row]),
                    position=poses[row, :3, 3],
                )


def strip_words(shown: ShownResult) -> str:
    """Return in words which part of the video is in which submap."""
    times_s = shown.whole.frames["time_s"]
    parts = [
        f"{times_s[part.first]:.1f} to {times_s[part.last]:.1f} s: submap {part.submap + 1}"
        for part in video_parts(shown.whole)
    ]
    return "Parts of the video: " + "; ".join(parts) + ". The submaps' relative poses are unknown."


def _submap_words(shown: ShownResult, number: int) -> str:
    count, submap = int((shown.whole.frames.submap == number).sum()), shown.whole.submaps[number]
    return f"{number + 1}: {count} frames, {LEVEL_WORDS[level_of_submap(submap)]}"
