"""Figures of a sequence's runs: depth of two frames, their registered point clouds, meshes with camera paths."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh

from scopemap.engine.geometry.rendering import render_points
from scopemap.report.depth_figures import MASKED_GREY, colour_depth, colour_range, colour_share
from scopemap.report.mesh_figures import (
    ESTIMATE_COLOUR,
    TRUTH_COLOUR,
    Viewpoint,
    content,
    cropped,
    draw_path,
    mesh_picture,
    on_white,
    outside_views,
    view_from_behind,
    view_of,
)
from scopemap.report.sheet import Sheet, picture_grid
from scopemap_bench.pictures import BAR_COLOUR


def draw_depth_change(
    images: Mapping[str, np.ndarray],
    tissue: tuple[np.ndarray, np.ndarray],
    depths_mm: Mapping[str, tuple[np.ndarray, np.ndarray]],
    file: Path,
) -> None:
    """Draw two consecutive frames by name, and each method's depth (H, W), mm, of both and its absolute difference.

    The paper's experiments 1 and 2 (arXiv 2508.11282). tissue : (H, W) bool, the pixels of each frame that its mask
    leaves; the others are grey. Their depth is to be NaN, as unknown depth is, which is black: neither counts. Methods
    share the scales of depth and of difference, whose far end is the 98th percentile.
    """
    near_mm, far_mm = colour_range([depth for pair in depths_mm.values() for depth in pair])
    changes_mm = {method: np.abs(current - previous) for method, (previous, current) in depths_mm.items()}
    most_mm = colour_range(list(changes_mm.values()))[1]
    rows = [dict(images)]
    for method, depths in depths_mm.items():
        change_mm = changes_mm[method][np.isfinite(changes_mm[method])]
        mean = f"mean {change_mm.mean():.2f} mm" if len(change_mm) else "unknown"
        names = (f"{method}: previous", "current", f"|difference|: {mean}")
        pictures = [colour_depth(depth, near_mm, far_mm) for depth in depths]
        pictures.append(colour_share(changes_mm[method] / most_mm))
        for picture, seen in zip(pictures, (*tissue, tissue[0] & tissue[1]), strict=True):
            picture[~seen] = MASKED_GREY
        rows.append(dict(zip(names, pictures, strict=True)))
    depth = f"depth: red {near_mm:.0f} to blue {far_mm:.0f} mm"
    scales = f"{depth}; difference: blue 0 to red {most_mm:.1f} mm; black: unknown; grey: masked, not counted"
    picture_grid(rows, (300, 250), scales).save(file)


def draw_reconstruction(
    mesh: trimesh.Trimesh,
    estimate_positions_mm: np.ndarray,
    reference_positions_mm: np.ndarray | None,
    file: Path,
    T_world_view: np.ndarray,
    zoom: tuple[float, float, float] = (0.5, 0.5, 0.25),
) -> None:
    """Draw a mesh with the estimated (N, 3) and the true (M, 3) camera positions over it, all world mm, as a PNG.

    Views: from behind `T_world_view` (4, 4), the first camera, and from two sides outside. A dot marks the start; rows
    of NaN (lost frames) are gaps. The last picture enlarges the blue square of the first: its middle from left and top
    and its side, over the first one's side.
    """
    # The truth is drawn first and broader: where both agree it is the edge of the estimate.
    paths = [] if reference_positions_mm is None else [(reference_positions_mm, TRUTH_COLOUR, 5)]
    paths.append((estimate_positions_mm, ESTIMATE_COLOUR, 2))
    everywhere = np.concatenate([positions for positions, _, _ in paths])
    views = {"from behind the start": view_from_behind(T_world_view, everywhere)}
    views |= outside_views(mesh, T_world_view, everywhere)
    pictures = {}
    for title, view in views.items():
        picture = mesh_picture(mesh, view)
        for positions, colour, thickness_px in paths:
            draw_path(picture, view, positions, colour, thickness_px=thickness_px)
        pictures[title] = cropped(picture)
        if len(pictures) == 1:
            enlarged = _enlarged(mesh, view, picture, zoom)
    pictures["the square, enlarged"] = enlarged
    of_truth = "no true poses are known" if reference_positions_mm is None else "red: true path"
    picture_grid([pictures], (460, 460), f"green: estimated path, its start a dot; {of_truth}").save(file)


def _enlarged(
    mesh: trimesh.Trimesh, view: Viewpoint, picture: np.ndarray, zoom: tuple[float, float, float]
) -> np.ndarray:
    """Draw the square of `draw_reconstruction` on a view's picture (H, H, 3), in place, and return it as large."""
    left, top, shown = content(picture)
    side = max(2, round(zoom[2] * shown))
    x, y = (round(start + middle * shown - side / 2) for start, middle in ((left, zoom[0]), (top, zoom[1])))
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * side + [x - 0.5, y - 0.5]
    Sheet.over(picture).line(corners, BAR_COLOUR, 2)
    camera = view.camera.cropped(x, y, side, side).resized(view.camera.width, view.camera.height)
    return mesh_picture(mesh, Viewpoint(view.T_world_camera, camera))


def draw_registered_clouds(clouds: Mapping[str, tuple[np.ndarray, np.ndarray]], file: Path, *, where: str) -> None:
    """Draw the point clouds of two frames on each other as a PNG, one panel per method, from in front and aside.

    Each method gives points (N, 3), mm, in a camera of the clouds, and their colours (N, 3) uint8; `where` names the
    poses that registered them.
    """
    rows: list[dict[str, np.ndarray]] = [{}, {}]
    for method, (points, colours) in clouds.items():
        centre = np.median(points, axis=0)
        radius = float(np.percentile(np.linalg.norm(points - centre, axis=1), 95))
        for row, yaw_rad in zip(rows, (0.0, 0.8), strict=True):
            view = view_of(np.eye(3), centre, radius, yaw_rad, 0.0)
            rendering = render_points(points, colours, view.camera, view.T_world_camera)
            row[f"{method}\n{where}"] = cropped(on_white(rendering))
    picture_grid(rows, (360, 360)).save(file)
