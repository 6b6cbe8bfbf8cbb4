"""Points and lines that are picked on the surface, in the scene."""

from __future__ import annotations

from typing import Any

import numpy as np

_POINT_SHARE = 0.008
_MOST_POINTS = 200
"""Of one mark, when it is drawn with fewer again."""
INK = (20, 90, 220)
REFERENCE = (215, 105, 0)
PALE = (140, 140, 140)
"""Of what does not hold any more."""
CLICKED = (190, 0, 150)


def draw_marks(
    scene: Any,
    name: str,
    points: np.ndarray,
    size_mm: float,
    words: str = "",
    colour: tuple[int, int, int] = INK,
    line: np.ndarray | None = None,
) -> None:
    """Draw points (N, 3) as small balls, joined by lines, more than two as a polygon, with words at their middle.

    What was there by this name goes. size_mm : of the surface. line : (M, 3), that is drawn instead of straight ones.
    """
    if not len(points):
        scene.remove_by_name(name)
        return
    # A browser may lose nodes that are made right after their parent was removed: only what is too much goes.
    left = [str(number) for number in range(len(points), _MOST_POINTS)]
    for gone in (*left, *(["lines"] if len(points) < 2 else []), *([] if words else ["words"])):
        scene.remove_by_name(f"{name}/{gone}")
    for number, point in enumerate(points):
        scene.add_icosphere(
            f"{name}/{number}",
            _POINT_SHARE * size_mm,
            colour,
            subdivisions=2,
            cast_shadow=False,
            receive_shadow=False,
            position=tuple(point),
        )
    if len(points) > 1:
        closed = np.concatenate([points, points[: int(len(points) > 2)]]) if line is None else line
        lines = np.stack([closed[:-1], closed[1:]], axis=1).astype(np.float32)
        scene.add_line_segments(f"{name}/lines", lines, colour, thickness=3.0, thickness_units="screen")
    if words:
        middle = points.mean(axis=0) if line is None else line[len(line) // 2]
        scene.add_label(f"{name}/words", words, position=tuple(middle), anchor="bottom-center")
