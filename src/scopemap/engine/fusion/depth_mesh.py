"""The mesh of one frame's depth: a grid of triangles."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.mesh_faces import without_unused
from scopemap.engine.geometry.se3 import transform


def depth_mesh(frame: Frame, step_px: int, min_incidence: float) -> trimesh.Trimesh:
    """Return the surface of every `step_px`-th usable pixel of a frame, world mm, with its colours; it may be empty.

    min_incidence : cosine of incidence below which neighbours are two surfaces. Normals point to the camera.
    """
    assert frame.depth_mm is not None
    assert frame.T_world_camera is not None
    some = (slice(step_px // 2, None, step_px),) * 2
    depth_mm = np.where(frame.valid & (frame.depth_mm > 0), frame.depth_mm, np.nan)[some].astype(np.float64)
    rows, columns = depth_mm.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (number[i : rows - 1 + i, j : columns - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    # Counter-clockwise seen from the camera, which looks along z with y down.
    faces = np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])])
    corners_mm = depth_mm.ravel()[faces]
    largest_step = step_px * math.sqrt(1 / min_incidence**2 - 1) / min(frame.camera.fx, frame.camera.fy)
    with np.errstate(invalid="ignore"):
        near_mm, far_mm = corners_mm.min(1), corners_mm.max(1)
        faces = faces[far_mm - near_mm <= largest_step * near_mm]
    used, faces = without_unused(faces, rows * columns)
    points = (frame.camera.rays[some] * depth_mm[..., None]).reshape(-1, 3)[used]
    return trimesh.Trimesh(
        transform(frame.T_world_camera, points),
        faces,
        vertex_colors=frame.rgb[some].reshape(-1, 3)[used],
        process=False,
    )
