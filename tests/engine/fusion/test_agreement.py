"""How far frames and the surface agree, at each vertex."""

from __future__ import annotations

import numpy as np
import trimesh

from scopemap.engine.fusion.agreement import rendered_frames, vertex_sigmas
from tests.support.drawn_surfaces import AHEAD, VIEW, plane_frame


def test_a_frame_sees_vertices_up_to_the_border_of_its_last_pixels() -> None:
    frame = plane_frame(AHEAD, 50.0)
    # Half a pixel around the centres of the outer ones, and a little less or more.
    pixels = [
        (x + dx, y + dy)
        for x, y, right, down in (
            (-0.5, 60.0, 1, 0),
            (VIEW.width - 0.5, 60.0, -1, 0),
            (80.0, -0.5, 0, 1),
            (80.0, VIEW.height - 0.5, 0, -1),
        )
        for dx, dy in ((0.2 * right, 0.2 * down), (-0.2 * right, -0.2 * down))
    ]
    beyond = 50.0 * VIEW.unproject(np.array([[-20.0, -20.0], [180.0, -20.0], [-20.0, 140.0], [180.0, 140.0]]))
    vertices = np.concatenate([beyond, 50.0 * VIEW.unproject(np.array(pixels))])
    wall = trimesh.Trimesh(vertices, [[0, 1, 2], [2, 1, 3]], process=False)
    sigmas = vertex_sigmas(len(vertices), rendered_frames(wall, [frame]))
    np.testing.assert_array_equal(np.isfinite(sigmas), [False] * 4 + [True, False] * 4)
