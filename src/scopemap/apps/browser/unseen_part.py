"""What was not seen: its share with an interval, and blind spots as a list that flies there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.window import escaped

if TYPE_CHECKING:
    from scopemap.apps.coverage.coverage import BlindSpot, Coverage

_MOST_LISTED = 20
_LEAST_SHARE = 0.05
"""Of what was not seen: smaller spots are folded away."""
_MAPS = {
    "lumen": "The wall cut open at 12 o'clock: along it, and by clock direction",
    "cavity": "The wall as the camera looks at it, its mean direction of view in the middle",
}
"""What the map is, by the kind of the space."""
_MARK = "/page/blind_spot"
_INK = (255, 190, 11)
_LIFT = 0.01
"""Of the way to the nearest camera: by so much borders are in front of the surface, which is drawn simplified."""


class UnseenPart:
    """Controls of what was not seen."""

    def __init__(self, shown: ShownResult) -> None:
        self._shown, gui = shown, shown.window.gui
        self._ask = shown.window.on(
            gui.add_button("What was not seen", disabled=shown.surface.is_empty),
            lambda: shown.coverage(self._list),
        )
        self._words = gui.add_markdown("It takes some seconds. Colour by coverage shows it on the surface.")
        self._outer = gui.add_folder(None, visible=False)
        with self._outer:
            self._place = gui.add_folder(None)
        self._number = shown.number
        shown.follow(submap=self._follow_surface)

    def _follow_surface(self) -> None:
        """Forget what is said of another submap; that of another segment's time stays: it is of the whole submap."""
        self._shown.window.scene.remove_by_name(_MARK)
        if self._number != self._shown.number:
            self._number = self._shown.number
            self._clear()

    def _clear(self) -> None:
        self._place.remove()
        with self._outer:
            self._place = self._shown.window.gui.add_folder(None, visible=False)
        self._shown.window.scene.remove_by_name(_MARK)
        self._ask.disabled, self._words.content = self._shown.surface.is_empty, ""
        self._outer.visible = False

    def _list(self, found: Coverage) -> None:
        self._clear()
        listed = found.spots[:_MOST_LISTED]
        largest = f" The largest {len(listed)}:" if len(found.spots) > len(listed) else ""
        self._words.content = escaped(f"{found.statement}{largest}")
        large = [spot for spot in listed if share_of(found, spot) >= _LEAST_SHARE]
        small = listed[len(large) :]
        self._outer.visible = self._place.visible = True
        with self._place:
            self._shown.window.gui.add_image(map_picture(found), label=_MAPS[found.layout.kind])
            self._add(found, large, 1)
            if small:
                with self._shown.window.gui.add_folder(f"{len(small)} smaller", expand_by_default=False):
                    self._add(found, small, len(large) + 1)

    def _add(self, found: Coverage, spots: Sequence[BlindSpot], first: int) -> None:
        along = found.facts["along_unit"]
        for number, spot in enumerate(spots, first):
            share = f"{100 * share_of(found, spot):.2g}"
            label = f"{number}. near frame {spot.frame}, {share} % of what was not seen"
            area = f"{np.format_float_positional(float(f'{spot.area:.3g}'), trim='-')} mm² "
            hint = f"{area if found.unit == 'mm' else ''}{spot.where(along)}"
            button = self._shown.window.gui.add_button(label, hint=hint, color="gray")
            self._shown.window.on(button, self._fly, number, spot, found)

    def _fly(self, number: int, spot: BlindSpot, found: Coverage) -> None:
        shown, place = self._shown, unseen_place(found, spot)
        shown.show_frame(spot.frame)
        shown.look_from_spot(place)
        scene = shown.window.scene
        lines = unseen_outline(found, place)
        scene.add_line_segments(f"{_MARK}/outline", lines, _INK, thickness=4.0, thickness_units="screen")
        scene.add_label(f"{_MARK}/words", f"blind spot {number}", position=tuple(place), anchor="bottom-center")
        shown.note(f"Blind spot {number}, seen from frame {spot.frame}, the nearest.")


def share_of(found: Coverage, spot: BlindSpot) -> float:
    """Return the share of a blind spot in all that was not seen, 0 to 1."""
    return min(1.0, spot.area / max(found.total.share * found.total.area, 1e-12))


def map_picture(found: Coverage) -> np.ndarray:
    """Return the map of what was not seen, (H, W, 3) uint8."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "map.png"
        found.draw(file)
        return np.asarray(Image.open(file).convert("RGB"))


def unseen_place(found: Coverage, spot: BlindSpot) -> np.ndarray:
    """Return the middle (3,) of the face that was not seen and is nearest to a spot's position, which may be in air."""
    middles = np.asarray(found.surface.triangles_center)[found.unseen_faces]
    position = np.array(spot.position_mm)
    return middles[np.linalg.norm(middles - position, axis=1).argmin()] if len(middles) else position


def unseen_outline(found: Coverage, place: np.ndarray) -> np.ndarray:
    """Return the border, segments (N, 2, 3), of the faces that were not seen and are connected around a place."""
    faces = np.asarray(found.surface.faces)
    hidden = np.flatnonzero(found.unseen_faces)
    if not len(hidden):
        return np.zeros((0, 2, 3))
    adjacent = np.asarray(found.surface.face_adjacency)
    inside = adjacent[found.unseen_faces[adjacent].all(axis=1)]
    middles = np.asarray(found.surface.triangles_center)
    nearest = hidden[np.linalg.norm(middles[hidden] - place, axis=1).argmin()]
    parts = trimesh.graph.connected_components(inside, nodes=hidden, min_len=1)
    patch = next(part for part in parts if nearest in part)
    edges = np.sort(faces[patch][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    border = trimesh.grouping.group_rows(edges, require_count=1)
    return np.asarray(found.surface.vertices)[edges[border]]


def unseen_borders(found: Coverage, cameras: np.ndarray) -> np.ndarray:
    """Return the borders, segments (N, 2, 3), of all faces that were not seen, a little on the side of the cameras.

    cameras : positions (M, 3).
    """
    surface = found.surface
    neighbours = found.unseen_faces[np.asarray(surface.face_adjacency)]
    edges = np.asarray(surface.face_adjacency_edges)[neighbours[:, 0] != neighbours[:, 1]]
    places = np.asarray(surface.vertices)[edges]
    if not len(places) or not len(cameras):
        return places
    away = cameras[cKDTree(cameras).query(places)[1]] - places
    return np.asarray(places + _LIFT * away)
