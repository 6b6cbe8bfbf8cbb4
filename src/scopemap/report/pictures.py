"""Pictures of a run: trajectories, depth maps and the mesh, drawn without a display and without OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.errors import check_shape
from scopemap.report.canvas import ESTIMATE_COLOUR, TRUTH_COLOUR, new_figure
from scopemap.report.mesh_view import inside_view, outside_views, render_mesh

_TURBO_LAST = 255


def colour_depth(depth_mm: np.ndarray, near_mm: float, far_mm: float) -> np.ndarray:
    """Return (H, W, 3) uint8 sRGB of depth (H, W) mm: `near_mm` blue, `far_mm` red (turbo), NaN black."""
    check_shape("depth_mm", depth_mm, (None, None))
    if not far_mm > near_mm:
        raise ValueError(f"colouring depth: far ({far_mm} mm) must lie beyond near ({near_mm} mm)")
    known = np.isfinite(depth_mm)
    share = (np.where(known, depth_mm, near_mm) - near_mm) / (far_mm - near_mm)
    level = np.round(_TURBO_LAST * np.clip(share, 0, 1)).astype(np.uint8)
    rgb = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1].copy()
    rgb[~known] = 0
    return rgb


def draw_trajectories(estimate_positions_mm: np.ndarray, reference_positions_mm: np.ndarray | None, file: Path) -> None:
    """Draw camera positions (N, 3) and, if given, the true ones (M, 3), mm, in three orthogonal views as a PNG.

    Estimate green, truth red, the start a dot; rows of NaN (lost frames) are gaps.
    """
    check_shape("estimate_positions_mm", estimate_positions_mm, (None, 3))
    figure = new_figure(12.0, 4.2)
    paths = [("estimate", ESTIMATE_COLOUR, estimate_positions_mm)]
    if reference_positions_mm is not None:
        check_shape("reference_positions_mm", reference_positions_mm, (None, 3))
        paths.insert(0, ("truth", TRUTH_COLOUR, reference_positions_mm))
    for place, (across, up) in enumerate([(0, 1), (0, 2), (2, 1)], start=1):
        axes = figure.add_subplot(1, 3, place, aspect="equal", adjustable="datalim")
        axes.set(xlabel=f"{'xyz'[across]} mm", ylabel=f"{'xyz'[up]} mm")
        axes.grid(alpha=0.3)
        for name, colour, positions in paths:
            axes.plot(positions[:, across], positions[:, up], color=colour, label=name, linewidth=1.6)
            known = positions[np.isfinite(positions).all(axis=1)]
            axes.plot(known[:1, across], known[:1, up], "o", color=colour, markersize=7, markeredgecolor="black")
        if up == 1:
            # The world's y points down.
            axes.invert_yaxis()
    figure.axes[0].legend(title="dot: start")
    figure.savefig(file)


def draw_depths(
    images: Sequence[np.ndarray],
    raw_mm: Sequence[np.ndarray],
    refined_mm: Sequence[np.ndarray],
    truth_mm: Sequence[np.ndarray | None] | None,
    file: Path,
) -> None:
    """Draw a contact sheet as a PNG: one row per frame with image, raw, refined and, where known, true depth.

    `images` are (H, W, 3) uint8, the depths (H, W) mm with NaN = unknown; all share one colour scale, its ends the
    2nd and 98th percentile. Raises `ValueError` when the lists are empty or of different length.
    """
    columns: dict[str, Sequence[np.ndarray | None]] = {"raw depth": raw_mm, "refined depth": refined_mm}
    if truth_mm is not None:
        columns["true depth"] = truth_mm
    if not images or any(len(depths) != len(images) for depths in columns.values()):
        raise ValueError(
            f"drawing depths of {len(images)} images: give one or more, and as many depth maps of each kind"
        )
    near_mm, far_mm = _depth_range([depth for depths in columns.values() for depth in depths if depth is not None])
    figure = new_figure(3.0 * (1 + len(columns)), 2.5 * len(images))
    for row, image in enumerate(images):
        cells = {"image": image}
        for name, depths in columns.items():
            depth = depths[row]
            cells[name] = np.zeros_like(image) if depth is None else colour_depth(depth, near_mm, far_mm)
        for column, (name, picture) in enumerate(cells.items()):
            axes = figure.add_subplot(len(images), len(cells), row * len(cells) + column + 1)
            axes.imshow(picture)
            axes.axis("off")
            if row == 0:
                axes.set_title(name)
    figure.suptitle(f"blue {near_mm:.0f} mm .. red {far_mm:.0f} mm, black unknown")
    figure.savefig(file)


def draw_mesh(
    mesh: trimesh.Trimesh,
    file: Path,
    T_world_view: np.ndarray | None = None,
    reference_mesh: trimesh.Trimesh | None = None,
) -> None:
    """Draw a mesh, world mm, as a PNG: from `T_world_view` (4, 4) looking in, and from two sides outside.

    A reference mesh (the truth) is drawn below from the same views. Without `T_world_view` only the outside views are
    drawn; an empty mesh gives empty views.
    """
    frame_of = reference_mesh if reference_mesh is not None and not len(mesh.faces) else mesh
    views = [] if T_world_view is None else [("from the camera", inside_view(T_world_view))]
    views += zip(("from outside", "from the other side"), outside_views(frame_of, T_world_view), strict=True)
    rows = [("", mesh)] + ([] if reference_mesh is None else [("truth, ", reference_mesh)])
    figure = new_figure(4.0 * len(views), 4.6 * len(rows))
    for row, (prefix, drawn) in enumerate(rows):
        for column, (title, view) in enumerate(views):
            axes = figure.add_subplot(len(rows), len(views), row * len(views) + column + 1)
            axes.imshow(render_mesh(drawn, view))
            axes.axis("off")
            axes.set_title(prefix + title)
    figure.savefig(file)


def _depth_range(depths: list[np.ndarray]) -> tuple[float, float]:
    known = np.concatenate([depth[np.isfinite(depth)] for depth in depths])
    if not len(known):
        return 0.0, 1.0
    near, far = np.percentile(known, [2, 98])
    return float(near), float(max(far, near + 1e-3))
