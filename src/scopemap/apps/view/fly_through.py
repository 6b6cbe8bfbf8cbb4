"""A film of a run: each picture of its video, and beside it the surface seen from the smoothed path."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from scopemap.apps.coverage.layout import Lumen, examined_space
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import lit_like
from scopemap.engine.geometry.centreline import Centreline
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import se3
from scopemap.report.films import write_film
from scopemap.report.scale_bar import draw_scale_bar
from scopemap.report.sheet import Sheet, rgb_of
from scopemap.report.shown_mesh import MOST_FACES, simplified, textured_surface
from scopemap.result.result import Result
from scopemap.runner.reread_frames import reread_frames

_SMOOTH_S = 0.2  # standard deviation of the path's filter
_LEAST_SIDE_PX = 360
_FOOT_PX = 54
_TEXT_PX = 15
_SLOWEST_HZ = 1
_FASTEST_HZ = 60
_EMPTY = "#3a424c"
_CLOCK_SHARE = 0.45
_LEAST_ALONG = 0.5


@dataclass(frozen=True)
class Painting:
    """A surface in colours that mean something: vertex colours, and the words of each by `legend`, "#rrggbb"."""

    mesh: trimesh.Trimesh
    legend: dict[str, str]


def write_fly_through(folder: Path, file: Path, source: Path | None = None, painting: Painting | None = None) -> None:
    """Write a film of a run's tracked frames at the video's rate: their pictures, and the surface along the path.

    The surface is lit as the lamp lights it, and exposed as the picture; where there is a painting, it shines through
    half. Below: the time, how far along the path the camera is, in a lumen how far along the centreline, and what
    colours mean; a clock around the lumen; a scale bar where sizes are known, for what is as far away as the picture's
    median depth. source : where the run's input is now; else it is looked for. The end of the file's name chooses its
    kind: .mp4 (H.264), .mkv or .webm.

    Raises `InputError` where the folder holds no finished run or no surface, its input is gone, or the film cannot be
    written.
    """
    run = Result(folder).checked()
    if not len(run.mesh.faces):
        raise InputError(f"{folder}: the run has no surface to fly through")
    time_s = run.frames.only(run.frames.tracked)["time_s"]
    gap_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    rate = min(max(round(1 / max(gap_s, 1e-3)), _SLOWEST_HZ), _FASTEST_HZ)
    write_film(file, _pictures(run, source, painting), rate)


def smoothed_poses(T_world_camera: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) whose positions and rotations are those filtered by a Gaussian of 0.2 s."""
    gap_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    sigma = _SMOOTH_S / max(gap_s, 1e-3)
    quaternions = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat()
    # q and -q are one rotation: neighbours must be on one side.
    signs = np.sign((quaternions[1:] * quaternions[:-1]).sum(1))
    quaternions[1:] *= np.cumprod(np.where(signs == 0, 1, signs))[:, None]
    values = np.column_stack([T_world_camera[:, :3, 3], quaternions])
    # Goes on at both ends as it came: they stay in place.
    margin = min(math.ceil(3 * sigma), len(values) - 1)
    longer = np.pad(values, ((margin, margin), (0, 0)), "reflect", reflect_type="odd")
    smooth = gaussian_filter1d(longer, sigma, axis=0)[margin : margin + len(values)]
    R = Rotation.from_quat(smooth[:, 3:]).as_matrix()
    return np.stack([se3(*motion) for motion in zip(R, smooth[:, :3], strict=True)])


def _pictures(run: Result, source: Path | None, painting: Painting | None) -> Iterator[np.ndarray]:
    """Yield the pictures of the film, (H, W, 3) uint8."""
    tracked, meshes = run.frames.only(run.frames.tracked), dict[int, trimesh.Trimesh]()
    painted = None if painting is None else simplified(painting.mesh, MOST_FACES)
    indices, poses = tracked["index"].tolist(), tracked["T_world_camera"]
    smooth = dict(zip(indices, smoothed_poses(poses, tracked["time_s"]), strict=True))
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
    way, lumen = dict(zip(indices, along, strict=True)), centreline_of(run)
    for frame in reread_frames(run.folder, set(indices), source):
        pose, segment = smooth[frame.index], run.segment_at(frame.index)
        if segment not in meshes:
            shown = simplified(run.surface(segment), MOST_FACES)
            meshes[segment] = textured_surface(run, segment, shown) or shown
        surface, known_mm = _surface(run, meshes[segment], frame, pose)
        if painted is not None:
            colours = render_mesh(painted, frame.camera, pose)
            half = (surface.astype(np.uint16) + colours.rgb) // 2
            surface = np.where(np.isnan(colours.depth_mm)[..., None], surface, half.astype(np.uint8))
        share = way[frame.index] / max(along[-1], 1e-9)
        far = f"{way[frame.index]:.0f} mm" if run.scale_known else f"{share:.0%}"
        words, clock = f"{frame.time_s:.1f} s, {far} along the camera's path", dict[str, np.ndarray]()
        if lumen is not None:
            place, clock = place_and_clock(*lumen, pose)
            words += f", {place:.0f} {'mm' if run.scale_known else 'units'} along the centreline"
        px_per_mm = frame.camera.fx / np.nanmedian(known_mm) if run.scale_known and (known_mm > 0).any() else np.nan
        legend = {} if painting is None else painting.legend
        yield _side_by_side(frame, surface, words, float(px_per_mm), clock, legend)


def _surface(run: Result, mesh: trimesh.Trimesh, frame: Frame, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface (H, W, 3) uint8 from a pose, lit and exposed as a frame, and the frame's depth (H, W), mm."""
    depth_mm = run.depth.read(frame.index)
    known_mm = np.full(frame.valid.shape, np.nan) if depth_mm is None else np.where(frame.valid, depth_mm, np.nan)
    view = render_mesh(mesh, frame.camera, pose)
    if run.config.fusion.without_light:
        view = lit_like(view, frame.camera, frame.rgb, known_mm)
    return np.where(np.isnan(view.depth_mm)[..., None], np.array(rgb_of(_EMPTY), np.uint8), view.rgb), known_mm


def centreline_of(run: Result) -> tuple[Centreline, int] | None:
    """Return the centreline of a lumen, and the number of its point where the examined part begins; None: no lumen."""
    try:
        space = examined_space(run)
    except InputError:  # nothing was seen enough
        return None
    return (space.layout.line, space.first) if isinstance(space.layout, Lumen) else None


def place_and_clock(line: Centreline, first: int, pose: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """Return the place of a camera (4, 4) along the centreline, as blind spots have it, and directions (2,) of hours.

    There are none where it looks across the lumen.
    """
    row = int(line.place(pose[None, :3, 3])[0][0])
    up, right = (axis[row] @ pose[:3, :2] for axis in line.axes)
    looks_along = min(np.linalg.norm(up), np.linalg.norm(right)) > _LEAST_ALONG
    hours = {"12": up, "3": right, "6": -up, "9": -right} if looks_along else {}
    return (row + 0.5 - first) * line.step_mm, hours


def _side_by_side(
    frame: Frame,
    surface: np.ndarray,
    words: str,
    px_per_mm: float,
    clock: dict[str, np.ndarray],
    legend: dict[str, str],
) -> np.ndarray:
    """Return a picture and the surface beside it, with words below; both sides are even, as H.264 wants them."""
    larger = math.ceil(_LEAST_SIDE_PX / min(surface.shape[:2]))
    pair = np.hstack([frame.rgb, surface])
    pair = np.ascontiguousarray(cv2.resize(pair, None, fx=larger, fy=larger, interpolation=cv2.INTER_LINEAR))
    draw_scale_bar(pair, px_per_mm * larger, " at the median depth")
    height, width = pair.shape[:2]
    sheet = Sheet(width + width % 2, height + _FOOT_PX + (height + _FOOT_PX) % 2)
    sheet.picture(pair, (0, 0, width, height))
    middle, radius = np.array([0.75 * width, 0.5 * height]), _CLOCK_SHARE * min(height, width / 2)
    for hour, direction in clock.items():
        x, y = middle + radius * direction / np.linalg.norm(direction)
        sheet.fill((x - 12, y - 10, 24, 20), "#101010")
        sheet.text((x, y), hour, _TEXT_PX, "#ffffff", "mm")
    sheet.text((8, height + 6), f"video | surface, {words}", _TEXT_PX)
    sheet.legend((8, height + 31), legend | {"no surface": _EMPTY}, width / (len(legend) + 1))
    return sheet.rgb
