"""Two surfaces in one scene, beside each other or one over the other: one camera looks at both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from scopemap.apps.browser.scene import look_at
from scopemap.report.shown_mesh import simplified

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_MOST_FACES = 200_000
_GAP = 1.15
"""Distance of the two over their width."""


_BACK_SHARE = 0.35


class SurfacePair:
    """Surfaces of one world, looked at from behind a camera's pose (4, 4); simplified for display.

    nodes : of the scene, under which what belongs to each is drawn. shown : the surfaces as they are shown.
    """

    nodes = ("/page/first", "/page/second")

    def __init__(self, window: BrowserWindow, surfaces: Sequence[trimesh.Trimesh], pose: np.ndarray) -> None:
        self._window, self._pose = window, np.asarray(pose, float)
        self.shown = [simplified(surface, _MOST_FACES // 2) for surface in surfaces]
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
        look_at(self._window, self._pose, np.concatenate([self._points, self._points + aside]), _BACK_SHARE)

    def draw(self, colours: Sequence[np.ndarray]) -> None:
        """Draw both in colours (V, 3) uint8 of the vertices of `shown`."""
        with self._window.server.atomic():
            for node, surface, of in zip(self.nodes, self.shown, colours, strict=True):
                mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=of, process=False)
                self._window.scene.add_mesh_trimesh(f"{node}/surface", mesh, cast_shadow=False, receive_shadow=False)
