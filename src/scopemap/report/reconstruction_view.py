"""A reconstruction with the camera's path drawn over it: estimate green, truth red (the paper's experiment 4)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from scopemap.errors import check_shape
from scopemap.geometry.se3 import se3
from scopemap.report.canvas import ESTIMATE_COLOUR, TRUTH_COLOUR, new_figure
from scopemap.report.mesh_view import MeshView, draw_path, inside_view, outside_views, render_mesh

_MARGIN_PX = 15


def draw_reconstruction(
    mesh: trimesh.Trimesh,
    estimate_positions_mm: np.ndarray,
    reference_positions_mm: np.ndarray | None,
    file: Path,
    T_world_view: np.ndarray | None = None,
) -> None:
    """Draw a mesh with the estimated (N, 3) and the true (M, 3) camera positions, all in one world, mm, as a PNG.

    From behind `T_world_view` (4, 4), the first camera, and from two sides outside; without it from outside only. The
    mesh hides nothing of the paths. Rows of NaN (lost frames) are gaps; a dot is the start.
    """
    check_shape("estimate_positions_mm", estimate_positions_mm, (None, 3))
    paths = [("estimate", ESTIMATE_COLOUR, estimate_positions_mm, 2)]
    if reference_positions_mm is not None:
        check_shape("reference_positions_mm", reference_positions_mm, (None, 3))
        # Below and broader: where both agree, the truth is the estimate's edge.
        paths.insert(0, ("truth", TRUTH_COLOUR, reference_positions_mm, 5))
    everywhere = np.concatenate([positions for _, _, positions, _ in paths])
    views = [] if T_world_view is None else [("from behind the start", view_from_behind(T_world_view, everywhere))]
    outside = outside_views(mesh, T_world_view, everywhere)
    views += zip(("from outside", "from the other side"), outside, strict=True)
    figure = new_figure(4.6 * len(views), 5.2)
    for place, (title, view) in enumerate(views, start=1):
        picture = render_mesh(mesh, view)
        for _, colour, positions, thickness_px in paths:
            draw_path(picture, view, positions, colour, thickness_px=thickness_px)
        axes = figure.add_subplot(1, len(views), place)
        axes.imshow(_cropped(picture))
        axes.set_axis_off()
        axes.set_title(title)
    for name, colour, _, thickness_px in reversed(paths):
        figure.axes[0].plot([], [], color=colour, linewidth=thickness_px, label=name)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, title="dot: start")
    figure.savefig(file)


def _cropped(picture: np.ndarray) -> np.ndarray:
    """Return the square part of a square picture (H, H, 3) that holds all that is not white, and a margin."""
    rows, columns = np.nonzero((picture != 255).any(axis=-1))
    if not len(rows):
        return picture
    low, high = np.array([rows.min(), columns.min()]), np.array([rows.max(), columns.max()])
    side = min(int((high - low).max()) + 2 * _MARGIN_PX, len(picture))
    top, left = np.clip((low + high - side) // 2, 0, len(picture) - side)
    return picture[top : top + side, left : left + side]


def view_from_behind(T_world_camera: np.ndarray, positions_mm: np.ndarray) -> MeshView:
    """Return the view along a camera (4, 4), from so far behind that the positions (N, 3), mm, lie within it."""
    known = positions_mm[np.isfinite(positions_mm).all(axis=1)]
    R, centre = T_world_camera[:3, :3], T_world_camera[:3, 3]
    view = inside_view(T_world_camera)
    local = (known - centre) @ R
    # A point is in view where |x| and |y| stay below its distance times the tangent of half the angle; 0.8: a margin.
    reach = 0.8 * 0.5 * (view.camera.width - 1) / view.camera.fx
    needed_mm = np.abs(local[:, :2]).max(axis=1) / reach - local[:, 2] if len(local) else np.zeros(1)
    extent_mm = float(np.ptp(local, axis=0).max()) if len(local) else 0.0
    behind_mm = max(float(needed_mm.max()), 0.0) + 0.25 * extent_mm + 1.0
    return MeshView(se3(R, centre - behind_mm * R[:, 2]), view.camera)
