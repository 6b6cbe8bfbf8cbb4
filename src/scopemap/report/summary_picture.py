"""The picture of summary.png: a run on one sheet: the verdict, frames, their depth, the surface with the path, and
the submaps side by side where there are several.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import trimesh
from PIL import Image, ImageDraw, ImageFont

from scopemap.geometry.rendering import vertex_colours
from scopemap.io.decoding import read_decoded
from scopemap.io.run_folder import RunFolder
from scopemap.report.mesh_figures import (
    ESTIMATE_COLOUR,
    MeshView,
    cropped,
    draw_path,
    inside_view,
    mesh_picture,
    outside_views,
    view_from_behind,
)
from scopemap.report.submap_summaries import SubmapSummary, most_doubtful, submaps_in_time
from scopemap.report.verdict import Result, Verdict, verdict

_CELL_PX, _GAP_PX, _HEAD_PX, _LABEL_PX = 384, 12, 104, 26
_COLUMNS = 4
_MOST_REASONS = 2
_TONES = {"good": "#17794a", "doubtful": "#a35a00", "bad": "#b3261e"}
_INK, _SOFT, _GROUND = "#17202b", "#566373", "#ffffff"
_UNKNOWN = 32


def summary_picture(run: Result, meshes: Sequence[trimesh.Trimesh]) -> Image.Image:
    """Return the summary of a run as a picture.

    meshes : of its maps, the result's first, world mm, or some with fewer faces; maps beyond them are not drawn.
    """
    folder = run if isinstance(run, RunFolder) else None
    frames = [] if folder is None else _spread(folder)
    seen = [] if folder is None else [_frames_row(folder, frames), _depth_row(folder, frames)]
    rows = [*seen, _mesh_row(run, meshes[0]), *_piece_rows(run, meshes)]
    rows = [row for row in rows if row]
    heights = [max(picture.shape[0] for picture in row.values()) + _LABEL_PX for row in rows]
    width = _COLUMNS * (_CELL_PX + _GAP_PX) + _GAP_PX
    sheet = Image.new("RGB", (width, _HEAD_PX + sum(heights) + _GAP_PX), _GROUND)
    draw = ImageDraw.Draw(sheet)
    _write_head(draw, verdict(run), width)
    top = _HEAD_PX
    for row, height in zip(rows, heights, strict=True):
        for place, (title, picture) in enumerate(row.items()):
            left = _GAP_PX + place * (_CELL_PX + _GAP_PX)
            draw.text((left, top + 4), title, _INK, ImageFont.load_default(15))
            sheet.paste(Image.fromarray(picture), (left, top + _LABEL_PX))
        top += height
    return sheet


def _write_head(draw: ImageDraw.ImageDraw, found: Verdict, width_px: int) -> None:
    draw.rectangle((0, 0, width_px, 8), fill=_TONES[found.level])
    draw.text((_GAP_PX, 18), found.word.capitalize(), _TONES[found.level], ImageFont.load_default(38))
    draw.text((_GAP_PX, 66), "research software, not a medical device", _SOFT, ImageFont.load_default(14))
    left = 330
    draw.text((left, 16), found.advice, _INK, ImageFont.load_default(19))
    lines = [found.sentence, *(f"- {reason.text}" for reason in found.reasons[:_MOST_REASONS])]
    for place, line in enumerate(lines):
        draw.text((left, 42 + 18 * place), line, _SOFT, ImageFont.load_default(14))


def _spread(run: RunFolder) -> list[int]:
    """Return the numbers of at most four frames of the result, spread over it, that have a picture."""
    inside = set(run.frames["index"][run.frames.tracked].tolist())
    known = [index for index in run.pictured if index in inside]
    return sorted({known[round(place)] for place in np.linspace(0, len(known) - 1, _COLUMNS)}) if known else []


def _frames_row(run: RunFolder, frames: list[int]) -> dict[str, np.ndarray]:
    pictures = {f"frame {index}": read_decoded(run.picture_file(index), cv2.IMREAD_COLOR) for index in frames}
    return {title: _fitted(picture[..., ::-1]) for title, picture in pictures.items() if picture is not None}


def _depth_row(run: RunFolder, frames: list[int]) -> dict[str, np.ndarray]:
    """Return the depths in turbo, red near, blue far, of one range."""
    depths = [depth for index in frames if (depth := run.depth.read(index)) is not None]
    known = np.concatenate([np.empty(0, np.float32), *(depth[np.isfinite(depth)] for depth in depths)])
    if not known.size:
        return {}
    near, far = np.log(np.percentile(known, [1, 99]))
    titles = ["depth: red near, blue far, one range"] + [" " * place for place in range(1, len(depths))]
    return {title: _fitted(_turbo(depth, near, far)) for title, depth in zip(titles, depths, strict=True)}


def _turbo(depth_mm: np.ndarray, near: float, far: float) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        level = np.clip(255 * (1 - (np.log(depth_mm) - near) / max(far - near, 1e-6)), 0, 255)
    coloured = cv2.applyColorMap(np.nan_to_num(level).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(np.isnan(depth_mm)[..., None], np.uint8(_UNKNOWN), coloured)


def _mesh_row(run: Result, mesh: trimesh.Trimesh) -> dict[str, np.ndarray]:
    if not len(mesh.faces):
        return {}
    poses = run.frames["T_world_camera"][run.frames.tracked]
    path = poses[:, :3, 3]
    outside, other = outside_views(mesh, poses[0], path).values()
    views = {"surface and camera path": outside, "from the other side": other}
    views["from behind the start"] = view_from_behind(poses[0], path)
    pictures = {}
    for title, view in views.items():
        picture = mesh_picture(mesh if view is other else _opened(mesh, view), view, smooth=False)
        draw_path(picture, view, path, ESTIMATE_COLOUR, thickness_px=2)
        pictures[title] = _fitted(cropped(picture))
    middle = inside_view(poses[len(poses) // 2])
    inside = mesh_picture(_opened(mesh, middle), middle, smooth=False)
    return pictures | {"from the middle of the path": _fitted(inside)}


def _piece_rows(run: Result, meshes: Sequence[trimesh.Trimesh]) -> list[dict[str, np.ndarray]]:
    """Return the submaps of a run that has several, in order of time, in rows: each from outside with its path."""
    submaps = submaps_in_time(run.frames)
    if len(submaps) < 2:
        return []
    worst, shown = most_doubtful(submaps), {}
    for submap in submaps:
        if submap.number < len(meshes) and len(meshes[submap.number].faces):
            frames = run.submaps[submap.number].frames
            poses = frames["T_world_camera"][frames.tracked]
            view = outside_views(meshes[submap.number], poses[0], poses[:, :3, 3])["from outside"]
            picture = mesh_picture(_opened(meshes[submap.number], view), view, smooth=False)
            draw_path(picture, view, poses[:, :3, 3], ESTIMATE_COLOUR, thickness_px=2)
            shown[_submap_title(submap, is_worst=submap is worst)] = _fitted(cropped(picture))
    titles = list(shown)
    return [{t: shown[t] for t in titles[row : row + _COLUMNS]} for row in range(0, len(titles), _COLUMNS)]


def _submap_title(submap: SubmapSummary, *, is_worst: bool) -> str:
    facts = [f"{submap.name}: frames {submap.first} to {submap.last}", submap.inliers, "most doubtful" * is_worst]
    return ", ".join(filter(None, facts))


def _opened(mesh: trimesh.Trimesh, view: MeshView) -> trimesh.Trimesh:
    """Return a mesh without the faces that turn their backs to a view: near walls do not hide what is behind them."""
    to_view = view.T_world_camera[:3, 3] - np.asarray(mesh.triangles_center)
    kept = (np.asarray(mesh.face_normals) * to_view).sum(axis=1) > 0
    faces, colours = np.asarray(mesh.faces)[kept], vertex_colours(mesh)
    return trimesh.Trimesh(
        mesh.vertices, faces, vertex_colors=colours, vertex_normals=mesh.vertex_normals, process=False
    )


def _fitted(picture: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 as wide as a cell."""
    scale = _CELL_PX / picture.shape[1]
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return cv2.resize(
        np.ascontiguousarray(picture), (_CELL_PX, round(scale * picture.shape[0])), interpolation=interpolation
    )
