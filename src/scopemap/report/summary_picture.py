"""The picture of summary.png: a run on one sheet: the verdict, frames, their depth, the surface with the path, and
the submaps side by side where there are several.
"""

from __future__ import annotations

import textwrap

import cv2
import numpy as np
import trimesh
from PIL import Image

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.rendering import render_mesh, vertex_colours
from scopemap.input.decoding import decoded
from scopemap.report.depth_figures import MASKED_GREY, colour_depth
from scopemap.report.facts import PicturedFrame, ReportFacts
from scopemap.report.frame_pictures import WHOLLY_USABLE
from scopemap.report.mesh_figures import (
    ESTIMATE_COLOUR,
    Viewpoint,
    cropped,
    draw_path,
    inside_view,
    mesh_picture,
    outside_views,
    view_from_behind,
)
from scopemap.report.scale_bar import draw_scale_bar
from scopemap.report.sheet import SOFT, Sheet, rgb_of
from scopemap.report.shown_mesh import textured_surface
from scopemap.result.result import Result
from scopemap.result.verdict import Verdict

_CELL_PX = 384
_GAP_PX = 12
_HEAD_PX = 50  # above its lines
_LINE_PX = 18
_LINE_LETTERS = 190
_LABEL_PX = 26
_COLUMNS = 4
_LEAST_REASONS = 2
NOT_A_DEVICE = "Research software, not a medical device."
TONES = {"good": "#17794a", "doubtful": "#a35a00", "bad": "#b3261e"}


def summary_picture(facts: ReportFacts) -> Image.Image:
    """Return the summary of a run as a picture."""
    run, frames = facts.run, _spread(facts)
    main = textured_surface(run, run.main_segment, facts.meshes[0]) or facts.meshes[0]
    seen = [_frames_row(run, frames), _depth_row(facts, frames)]
    rows = [*seen, _mesh_row(run, main), *_submap_rows(facts)]
    rows = [row for row in rows if row]
    heights = [max(picture.shape[0] for picture in row.values()) + _LABEL_PX for row in rows]
    width = _COLUMNS * (_CELL_PX + _GAP_PX) + _GAP_PX
    found = facts.verdict
    lines = _head_lines(found)
    top = _HEAD_PX + _LINE_PX * max(len(lines), _LEAST_REASONS + 1)
    sheet = Sheet(width, top + sum(heights) + _GAP_PX)
    _write_head(sheet, found, lines)
    for row, height in zip(rows, heights, strict=True):
        for place, (title, picture) in enumerate(row.items()):
            left = _GAP_PX + place * (_CELL_PX + _GAP_PX)
            sheet.text((left, top + 4), title, 15)
            rows_px = slice(top + _LABEL_PX, top + _LABEL_PX + picture.shape[0])
            sheet.rgb[rows_px, left : left + _CELL_PX] = picture
        top += height
    return Image.fromarray(sheet.rgb)


def _head_lines(found: Verdict) -> list[str]:
    """Return the main facts and every caution, as on the page; the first reasons where there is none."""
    cautions = [reason for reason in found.reasons if reason.level in ("bad", "doubtful")]
    shown = [f"- {reason}" for reason in cautions or found.reasons[:_LEAST_REASONS]]
    return [part for line in (found.sentence, *shown) for part in textwrap.wrap(line, _LINE_LETTERS)]


def _write_head(sheet: Sheet, found: Verdict, lines: list[str]) -> None:
    sheet.rgb[:9] = rgb_of(TONES[found.level])
    sheet.text((_GAP_PX, 18), found.word.capitalize(), 38, TONES[found.level])
    sheet.text((_GAP_PX, 66), NOT_A_DEVICE, 14, SOFT)
    sheet.text((330, 16), found.advice, 19)
    for place, line in enumerate(lines):
        sheet.text((330, 42 + _LINE_PX * place), line, 14, SOFT)


def _spread(facts: ReportFacts) -> list[PicturedFrame]:
    """Return at most four frames of the result, spread over it, that have a picture."""
    known = [frame for frame in facts.frames if facts.run.frames.tracked[frame.row]]
    return [known[round(n)] for n in np.linspace(0, len(known) - 1, min(len(known), _COLUMNS))] if known else []


def _frames_row(run: Result, frames: list[PicturedFrame]) -> dict[str, np.ndarray]:
    shown = {}
    for frame in frames:
        if (picture := decoded(frame.jpg, cv2.IMREAD_COLOR)) is not None:
            title = f"frame {frame.index}"
            shown[title] = _fitted(picture[..., ::-1])
            _scale_frame(run, frame.index, shown[title])
    return shown


def _scale_frame(run: Result, index: int, picture: np.ndarray) -> None:
    depth_mm = run.depth.read(index) if run.scale_known else None
    if depth_mm is not None:
        _scale_at_median(picture, run.camera, depth_mm)


def _scale_at_median(picture: np.ndarray, camera: PinholeCamera, depth_mm: np.ndarray) -> None:
    """Draw a scale bar that holds at the median depth of a camera's picture, which is as wide as a cell."""
    if np.isfinite(depth_mm).any():
        median_mm = float(np.nanmedian(depth_mm))
        draw_scale_bar(picture, camera.fx / median_mm * _CELL_PX / camera.width, f" at {median_mm:.3g} mm")


def _depth_row(facts: ReportFacts, frames: list[PicturedFrame]) -> dict[str, np.ndarray]:
    """Return the depths in turbo, red near, blue far, of one range."""
    run, (near_mm, far_mm) = facts.run, facts.depth_range_mm
    ends = (f"{near_mm:.3g} mm", f"{far_mm:.3g} mm")
    if not run.scale_known:
        ends = ("near", f"{far_mm / near_mm:.3g} times as far")
    shown: dict[str, np.ndarray] = {}
    for frame in frames:
        if (depth_mm := run.depth.read(frame.index)) is not None:
            title = " " * len(shown) or f"depth: red {ends[0]}, blue {ends[1]}"
            shown[title] = _fitted(_without_masked(frame, colour_depth(depth_mm, near_mm, far_mm)))
            _scale_frame(run, frame.index, shown[title])
    return shown


def _without_masked(frame: PicturedFrame, picture: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 of a frame's depth, grey where its mask says that there is no tissue."""
    mask = decoded(frame.mask)
    if mask is not None:
        mask = cv2.resize(mask, picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        picture[mask != WHOLLY_USABLE] = MASKED_GREY
    return picture


def _mesh_row(run: Result, mesh: trimesh.Trimesh) -> dict[str, np.ndarray]:
    if not len(mesh.faces):
        return {}
    poses = run.frames["T_world_camera"][run.frames.tracked]
    path = poses[:, :3, 3]
    outside, other = outside_views(mesh, poses[0], path).values()
    views = {"surface and camera path": outside, "from the other side": other}
    views["from behind the start"] = view_from_behind(poses[0], path)
    pictures = {
        title: _with_path(mesh if view is other else _opened(mesh, view), view, path, run.scale_known)
        for title, view in views.items()
    }
    middle = inside_view(poses[len(poses) // 2])
    opened = _opened(mesh, middle)
    inside = _fitted(mesh_picture(opened, middle, smooth=False))
    if run.scale_known:
        seen = render_mesh(opened, middle.camera, middle.T_world_camera)
        _scale_at_median(inside, middle.camera, seen.depth_mm)
    return pictures | {"from the middle of the path": inside}


def _with_path(mesh: trimesh.Trimesh, view: Viewpoint, path_mm: np.ndarray, scaled: bool) -> np.ndarray:
    """Return a picture of a mesh and a path; scaled : with a scale bar that holds at the middle of the mesh."""
    picture = mesh_picture(mesh, view, smooth=False)
    draw_path(picture, view, path_mm, ESTIMATE_COLOUR)
    part = cropped(picture)
    shown = _fitted(part)
    if scaled:
        depth_mm = float(view.project(np.asarray(mesh.bounds).mean(axis=0))[0][2])
        draw_scale_bar(shown, view.camera.fx / depth_mm * shown.shape[1] / part.shape[1], " at its middle")
    return shown


def _submap_rows(facts: ReportFacts) -> list[dict[str, np.ndarray]]:
    """Return the submaps of a run that has several, in order of time, in rows: each from outside with its path."""
    run, shown = facts.run, {}
    for submap in facts.submaps if len(facts.submaps) > 1 else []:
        mesh = facts.submap_meshes.get(submap.number)
        if mesh is not None and len(mesh.faces):
            frames = run.submaps[submap.number].frames
            poses = frames["T_world_camera"][frames.tracked]
            view = outside_views(mesh, poses[0], poses[:, :3, 3])["from outside"]
            title = f"{submap.name}: frames {submap.first} to {submap.last}"
            title = ", ".join(filter(None, (title, facts.inliers[submap.number])))
            shown[title] = _with_path(_opened(mesh, view), view, poses[:, :3, 3], run.scale_known)
    titles = list(shown)
    return [{t: shown[t] for t in titles[row : row + _COLUMNS]} for row in range(0, len(titles), _COLUMNS)]


def _opened(mesh: trimesh.Trimesh, view: Viewpoint) -> trimesh.Trimesh:
    """Return a mesh without the faces that turn their backs to a view: near walls do not hide what is behind them."""
    to_view = view.T_world_camera[:3, 3] - np.asarray(mesh.triangles_center)
    kept = (np.asarray(mesh.face_normals) * to_view).sum(axis=1) > 0
    faces, visual = np.asarray(mesh.faces)[kept], mesh.visual
    if not isinstance(visual, trimesh.visual.TextureVisuals):
        visual = trimesh.visual.ColorVisuals(vertex_colors=vertex_colours(mesh))
    return trimesh.Trimesh(mesh.vertices, faces, vertex_normals=mesh.vertex_normals, visual=visual, process=False)


def _fitted(picture: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 as wide as a cell."""
    scale = _CELL_PX / picture.shape[1]
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return cv2.resize(
        np.ascontiguousarray(picture), (_CELL_PX, round(scale * picture.shape[0])), interpolation=interpolation
    )
