"""A film of a run: each picture of its video, and beside it the surface seen from the smoothed path."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from scopemap.actions.inputs import frames_again
from scopemap.errors import InputError
from scopemap.frame import Frame
from scopemap.fusion.agreement import lit_like
from scopemap.geometry.rendering import render_mesh
from scopemap.geometry.se3 import se3
from scopemap.io.run_folder import RunFolder
from scopemap.report.films import write_film
from scopemap.report.measured_surface import MOST_FACES
from scopemap.report.scale_bar import draw_scale_bar
from scopemap.report.sheet import Sheet
from scopemap.report.shown_mesh import simplified

_SMOOTH_S = 0.2  # standard deviation of the path's filter
_LEAST_SIDE_PX, _FOOT_PX, _TEXT_PX = 360, 30, 15
_SLOWEST_HZ, _FASTEST_HZ = 1, 60
_EMPTY = 58, 66, 76


def write_fly_through(folder: Path, file: Path, source: Path | None = None) -> None:
    """Write a film of a run's tracked frames at the video's rate: their pictures, and the surface along the path.

    Tissue that moves is in the state of each frame. The surface is lit as the lamp lights it, and exposed as the
    picture. Below: the time, and how far along the path the camera is; a scale bar where sizes are known, for what is
    as far away as the picture's median depth. source : where the run's input is now; else it is looked for. The end of
    the file's name chooses its kind: .mp4 (H.264), .mkv or .webm.

    Raises `InputError` where the folder holds no finished run or no surface, its input is gone, or the film cannot be
    written.
    """
    run = RunFolder(folder).checked()
    if not len(run.mesh.faces):
        raise InputError(f"{folder}: the run has no surface to fly through")
    time_s = run.frames.only(run.frames.tracked)["time_s"]
    gap_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    write_film(file, _pictures(run, source), min(max(round(1 / max(gap_s, 1e-3)), _SLOWEST_HZ), _FASTEST_HZ))


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


def _pictures(run: RunFolder, source: Path | None) -> Iterator[np.ndarray]:
    """Yield the pictures of the film, (H, W, 3) uint8."""
    tracked, mesh = run.frames.only(run.frames.tracked), simplified(run.mesh, MOST_FACES)
    indices, poses = tracked["index"].tolist(), tracked["T_world_camera"]
    smooth = dict(zip(indices, smoothed_poses(poses, tracked["time_s"]), strict=True))
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
    way = dict(zip(indices, along, strict=True))
    for frame in frames_again(run.path, set(indices), source):
        shown = mesh if run.states is None else run.states.moved(mesh, frame.index)
        depth_mm = run.depth.read(frame.index)
        known_mm = np.full(frame.valid.shape, np.nan) if depth_mm is None else np.where(frame.valid, depth_mm, np.nan)
        view = render_mesh(shown, frame.camera, smooth[frame.index])
        if run.config.fusion.colours == "albedo":
            view = lit_like(view, frame.camera, frame.rgb, known_mm)
        surface = np.where(np.isnan(view.depth_mm)[..., None], np.array(_EMPTY, np.uint8), view.rgb)
        share = way[frame.index] / max(along[-1], 1e-9)
        far = f"{way[frame.index]:.0f} mm" if run.scale_known else f"{share:.0%}"
        px_per_mm = frame.camera.fx / np.nanmedian(known_mm) if run.scale_known and (known_mm > 0).any() else np.nan
        yield _side_by_side(frame, surface, f"{frame.time_s:.1f} s, {far} along the camera's path", float(px_per_mm))


def _side_by_side(frame: Frame, surface: np.ndarray, words: str, px_per_mm: float) -> np.ndarray:
    """Return a picture and the surface beside it, with words below; both sides are even, as H.264 wants them."""
    larger = math.ceil(_LEAST_SIDE_PX / min(surface.shape[:2]))
    pair = np.hstack([frame.rgb, surface])
    pair = np.ascontiguousarray(cv2.resize(pair, None, fx=larger, fy=larger, interpolation=cv2.INTER_LINEAR))
    draw_scale_bar(pair, px_per_mm * larger, " at the median depth")
    height, width = pair.shape[:2]
    sheet = Sheet(width + width % 2, height + _FOOT_PX + (height + _FOOT_PX) % 2)
    sheet.picture(pair, (0, 0, width, height))
    sheet.text((8, height + 6), f"video | surface, {words}", _TEXT_PX)
    return sheet.rgb
