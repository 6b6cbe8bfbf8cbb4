"""Films, and one of a run's surface that turns once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import av
import numpy as np

from scopemap.engine.errors import InputError, reporting
from scopemap.report.mesh_figures import ESTIMATE_COLOUR, Viewpoint, draw_path, mesh_picture, view_of, zoomed
from scopemap.report.scale_bar import draw_scale_bar
from scopemap.report.sheet import Sheet
from scopemap.report.shown_mesh import MOST_FACES, simplified, textured_surface
from scopemap.result.result import Result

_FRAMES = 180
_FRAMES_PER_S = 24
_PITCH_RAD = -0.35
_FITTED = 36
"""Views all round, by which the picture is filled."""
_FILLED = 0.96
_QUALITY_BITS = 4_000_000


def write_film(file: Path, pictures: Iterable[np.ndarray], frames_per_s: int) -> None:
    """Write pictures (H, W, 3) uint8 of one even size as .mp4 or .mkv, H.264, or as .webm; `InputError` if that fails.

    Where making the pictures fails, no file is left.
    """
    try:
        with reporting(f"cannot write {file}"), av.open(str(file), "w") as film:
            stream = film.add_stream("libvpx-vp9" if file.suffix.lower() == ".webm" else "libx264", rate=frames_per_s)
            stream.pix_fmt, stream.bit_rate = "yuv420p", _QUALITY_BITS
            for number, picture in enumerate(pictures):
                if number == 0:
                    stream.height, stream.width = picture.shape[:2]
                film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
            film.mux(stream.encode())
    except BaseException:
        file.unlink(missing_ok=True)
        raise


def write_turntable(folder: Path | str, file: Path, frames: int = _FRAMES) -> None:
    """Write a film of so many frames, 24 a second, in which a run's surface with the camera's path turns once.

    The end of the file's name chooses its kind: .mp4, .mkv or .webm. With a scale bar where sizes are known.

    Raises `InputError` where the folder holds no finished run or no surface, or the film cannot be written.
    """
    run = Result(folder).checked()
    if not len(run.mesh.faces):
        raise InputError(f"{folder}: the run has no surface to turn")
    write_film(file, _turning(run, frames), _FRAMES_PER_S)


def _turning(run: Result, frames: int) -> Iterator[np.ndarray]:
    """Yield the pictures of a surface that turns once."""
    mesh, poses = simplified(run.mesh, MOST_FACES), run.frames["T_world_camera"][run.frames.tracked]
    mesh = textured_surface(run, run.main_segment, mesh) or mesh
    points = np.concatenate([np.asarray(mesh.bounds), poses[:, :3, 3]])
    centre, radius = (points.min(axis=0) + points.max(axis=0)) / 2, float(np.linalg.norm(np.ptp(points, axis=0))) / 2
    R, yaws_rad = poses[0][:3, :3], 2 * np.pi * np.arange(frames) / frames
    shown = np.concatenate([np.asarray(mesh.vertices), poses[:, :3, 3]])
    some = [view_of(R, centre, radius, yaw_rad, _PITCH_RAD) for yaw_rad in yaws_rad[:: max(1, frames // _FITTED)]]
    larger = min(_largest_zoom(view, shown) for view in some)
    for yaw_rad in yaws_rad:
        view = zoomed(view_of(R, centre, radius, yaw_rad, _PITCH_RAD), larger)
        picture = mesh_picture(mesh, view)
        draw_path(picture, view, poses[:, :3, 3], ESTIMATE_COLOUR)
        if run.scale_known:
            draw_scale_bar(picture, view.camera.fx / (4 * radius), " at its middle")
        sheet = Sheet.over(picture)
        sheet.legend((8, 8), {"camera path, dot: start": ESTIMATE_COLOUR}, 0)
        yield sheet.rgb


def _largest_zoom(view: Viewpoint, points: np.ndarray) -> float:
    """Return the factor by which the focal length of a view may grow until a point (N, 3), world mm, leaves it."""
    pixels = view.project(points)[1] - [view.camera.cx, view.camera.cy]
    return float(_FILLED * view.camera.cx / max(np.abs(pixels).max(), 1e-6))
