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
from scopemap.report.shown_mesh import simplified

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_GAP = 1.15
"""Distance of the two over their width."""


_BACK_SHARE = 0.75
"""How far back from their middle both are looked at, over their size, where the picture has this aspect."""

_ASPECT = 1.1
_UNKNOWN_ASPECT = 0.8  # of browsers that come later
_ABOVE_SHARE = 0.3


class SurfacePair:
    """Surfaces of one world, simplified for display; poses : (N, 4, 4) of the cameras that saw them, by whose first
    both are looked at.

    nodes : of the scene, under which what belongs to each is drawn. shown : the surfaces as they are shown.
    """

    nodes = ("/page/first", "/page/second")

    def __init__(self, window: BrowserWindow, surfaces: Sequence[trimesh.Trimesh], poses: np.ndarray) -> None:
        self._window, self._pose = window, np.asarray(poses[0], float)
        self.shown = [simplified(surface, MOST_FACES // 2) for surface in surfaces]
        self._facing = [facing_of(surface, poses[:, :3, 3]) for surface in self.shown]
        self._points = np.concatenate([np.asarray(surface.vertices) for surface in self.shown])
        across = self._points @ self._pose[:3, 0]
        low, high = np.percentile(across, [1, 99])
        self._aside = _GAP * (high - low) * self._pose[:3, 0]
        self._second = window.scene.add_frame(self.nodes[1], show_axes=False)
        window.scene.add_frame(self.nodes[0], show_axes=False)
        self.place(overlaid=False)

    def place(self, overlaid: bool) -> None:
        """Put one over the other, or beside it, and look at both."""
        aside = np.zeros(3) if overlaid else self._aside
        self._second.position = tuple(aside)
        low, high = np.percentile(np.concatenate([self._points, self._points + aside]), [2, 98], axis=0)
        centre, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
        clients = self._window.server.get_clients().values()
        narrowest = min([client.camera.aspect for client in clients], default=_UNKNOWN_ASPECT)
        back = size * _BACK_SHARE * max(1.0, _ASPECT / max(narrowest, 0.1))
        position = centre - back * self._pose[:3, 2] - _ABOVE_SHARE * back * self._pose[:3, 1]
        look_from(self._window, position, centre, -self._pose[:3, 1])

    def draw(self, colours: Sequence[np.ndarray]) -> None:
        """Draw both in colours (V, 3) uint8 of the vertices of `shown`."""
        with self._window.server.atomic():
            for node, surface, facing, of in zip(self.nodes, self.shown, self._facing, colours, strict=True):
                glb = unlit_glb(np.asarray(surface.vertices), np.asarray(surface.faces), in_relief(facing, of))
                self._window.scene.add_glb(f"{node}/surface", glb, cast_shadow=False, receive_shadow=False)
