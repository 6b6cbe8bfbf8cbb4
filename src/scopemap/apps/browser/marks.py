"""Points and lines that are picked on the surface, in the scene."""

from __future__ import annotations

from typing import Any

import numpy as np

_POINT_SHARE = 0.008
_INK = (20, 90, 220)


def draw_marks(scene: Any, name: str, points: np.ndarray, size_mm: float, words: str = "") -> None:
    """Draw points (N, 3) as small balls, joined by lines, more than two as a polygon, with words at their middle.

    What was there by this name goes. size_mm : of the surface.
    """
    scene.remove_by_name(name)
    if not len(points):
        return
    for number, point in enumerate(points):
        scene.add_icosphere(
            f"{name}/{number}",
            _POINT_SHARE * size_mm,
            _INK,
            subdivisions=2,
            cast_shadow=False,
            receive_shadow=False,
            position=tuple(point),
        )
    if len(points) > 1:
        ends = np.roll(points, -1, axis=0) if len(points) > 2 else points[1:]
        lines = np.stack([points[: len(ends)], ends], axis=1).astype(np.float32)
        scene.add_line_segments(f"{name}/lines", lines, _INK, thickness=2.5, thickness_units="screen")
    if words:
        scene.add_label(f"{name}/words", words, position=tuple(points.mean(axis=0)), anchor="bottom-center")
