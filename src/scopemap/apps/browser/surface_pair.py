"""Two surfaces in one scene, beside each other or one over the other: one camera looks at both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from scopemap.apps.browser.scene import look_from
from scopemap.apps.browser.shown_surface import MOST_FACES, facing_of
from scopemap.apps.browser.surface_colours import in_relief
from scopemap.apps.browser.unlit_mesh import unlit_glb
from scopemap.report.sheet import rgb_of
from scopemap.report.shown_mesh import simplified

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

TINTS = ("#466ec8", "#e07b1a")
"""Colours of the first and of the second."""
_TINTED = 0.65  # by hand: share of its tint in the colour of a surface that lies over another one
_GAP = 1.15
"""Distance of the two over their width."""


_ABOVE_SHARE = 0.4  # how far above their middle both are looked at from, over how far back
_FILLED = 0.9  # of the picture's width and height: the rest is its edge, and names
_UNKNOWN_ASPECT = 0.6  # of browsers that come later: of a window of 900 px, beside whose scene the panel is


class SurfacePair:
    """Surfaces of one world, simplified for display; poses : (N, 4, 4) of the cameras that saw them, by whose first
    both are looked at. names : that stand above them.

    nodes : of the scene, under which what belongs to each is drawn. shown : the surfaces as they are shown.
    overlaid : whether one is over the other.
    """

    nodes = ("/page/first", "/page/second")

    def __init__(
        self, window: BrowserWindow, surfaces: Sequence[trimesh.Trimesh], poses: np.ndarray, names: Sequence[str]
    ) -> None:
        self._window, self._pose = window, np.asarray(poses[0], float)
        self.shown = [simplified(surface, MOST_FACES // 2) for surface in surfaces]
        self._facing = [facing_of(surface, poses[:, :3, 3]) for surface in self.shown]
        self._points = [np.asarray(surface.vertices) for surface in self.shown]
        across = np.concatenate(self._points) @ self._pose[:3, 0]
        low, high = np.percentile(across, [1, 99])
        self._aside = _GAP * (high - low) * self._pose[:3, 0]
        window.scene.add_frame(self.nodes[0], show_axes=False)
        self._second = window.scene.add_frame(self.nodes[1], show_axes=False)
        for node, points, name in zip(self.nodes, self._points, names, strict=True):
            window.scene.add_label(f"{node}/name", name, position=self._above(points), anchor="bottom-center")
        self.place(overlaid=False)

    def place(self, overlaid: bool) -> None:
        """Put one over the other, or beside it, and look at both."""
        self.overlaid = overlaid
        aside = np.zeros(3) if overlaid else self._aside
        self._second.position = tuple(aside)
        first, second = self._points
        points = np.concatenate([first, second + aside])
        low, high = points.min(0), points.max(0)
        centre, towards = (low + high) / 2, self._pose[:3, 2] + _ABOVE_SHARE * self._pose[:3, 1]
        towards /= np.linalg.norm(towards)
        clients = self._window.server.get_clients().values()
        narrowest = min([client.camera.aspect for client in clients], default=_UNKNOWN_ASPECT)
        axes = np.stack([self._pose[:3, 0], np.cross(towards, self._pose[:3, 0]), towards])
        back = distance_to_see((points - centre) @ axes.T, self._window.server.initial_camera.fov, narrowest)
        look_from(self._window, centre - back * towards, centre, -self._pose[:3, 1])

    def _above(self, points: np.ndarray) -> tuple[float, ...]:
        """Return the place (3,) above the middle of points (N, 3)."""
        own = points @ self._pose[:3, :3]
        low, high = own.min(0), own.max(0)
        return tuple(self._pose[:3, :3] @ [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])

    def draw(self, colours: Sequence[np.ndarray]) -> None:
        """Draw both in colours (V, 3) uint8 of the vertices of `shown`."""
        with self._window.server.atomic():
            for node, surface, facing, of in zip(self.nodes, self.shown, self._facing, colours, strict=True):
                glb = unlit_glb(np.asarray(surface.vertices), np.asarray(surface.faces), in_relief(facing, of))
                self._window.scene.add_glb(f"{node}/surface", glb, cast_shadow=False, receive_shadow=False)


def tinted(colours: np.ndarray, tint: str) -> np.ndarray:
    """Return colours (V, 3) uint8, most of which is a tint "#rrggbb"."""
    mixed = (1 - _TINTED) * colours + _TINTED * np.array(rgb_of(tint))
    return np.round(mixed).astype(np.uint8)


def distance_to_see(points: np.ndarray, fov_rad: float, aspect: float) -> float:
    """Return from how far before their origin a camera has all points (N, 3), x right, y down, z ahead, in its picture.

    fov_rad : from the top of the picture to the bottom. aspect : its width over its height.
    """
    high = _FILLED * np.tan(fov_rad / 2)
    needed = np.abs(points[:, :2]) / [high * max(aspect, 0.1), high] - points[:, 2:]
    return float(needed.max()) or 1.0
