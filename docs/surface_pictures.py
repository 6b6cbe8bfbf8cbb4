"""One picture per run: a frame, the surface from there with and without texture, its confidence, and from outside.

    python docs/surface_pictures.py RUN ... --out FOLDER [--frame N]

RUN is a run's folder whose input is still where it was. Writes FOLDER/NAME.jpg, NAME being the run's folder. Pictures
of C3VD and most clinical video may not be kept in the project: their licences do not allow it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.engine.frame import Frame
from scopemap.engine.fusion.agreement import lit_like
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.report.mesh_figures import (
    ESTIMATE_COLOUR,
    Viewpoint,
    cropped,
    draw_path,
    mesh_picture,
    on_white,
    outside_views,
)
from scopemap.report.sheet import picture_grid
from scopemap.result.result import Result
from scopemap.runner.reread_frames import open_truth

MOST_BYTES = 200_000


def draw_surface(run: Result, frame: Frame, pose: np.ndarray, depth_mm: np.ndarray, file: Path) -> None:
    """Draw a frame, the surface from there by vertex colours and by texture, its confidence, and the path outside.

    Confidence is blue at 0, yellow at 1. pose : (4, 4) of the frame, world mm. depth_mm : (H, W) of the frame.
    """
    mesh, camera, positions_mm = run.mesh, frame.camera, run.frames["T_world_camera"][run.frames.tracked, :3, 3]
    view, outside = Viewpoint(pose, camera), outside_views(mesh, pose, positions_mm)["from outside"]

    def seen(surface: trimesh.Trimesh) -> np.ndarray:
        rendering = render_mesh(surface, camera, pose)
        lit = lit_like(rendering, camera, frame.rgb, depth_mm) if run.config.fusion.without_light else rendering
        return on_white(lit)

    pictures = {"frame": frame.rgb, "one colour per vertex": seen(mesh)}
    if run.textured is not None:
        pictures["texture"] = seen(run.textured)
    if "confidence" in mesh.vertex_attributes:
        levels = np.round(255 * np.clip(mesh.vertex_attributes["confidence"].reshape(-1, 1), 0, 1)).astype(np.uint8)
        colours = cv2.applyColorMap(levels, cv2.COLORMAP_CIVIDIS)[:, 0, ::-1]
        certain = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
        pictures["confidence, 0 blue to 1 yellow"] = mesh_picture(certain, view)
    path = mesh_picture(mesh, outside)
    draw_path(path, outside, positions_mm, ESTIMATE_COLOUR)
    pictures["from outside"] = cropped(path)
    picture_grid([pictures], (400, round(400 * camera.height / camera.width))).save(file)


def draw_run(folder: Path, file: Path, number: int | None = None) -> None:
    """Draw a run at a frame, by default the middle one of those tracked."""
    run = Result(folder)
    tracked = run.frames.rows[run.frames.tracked]
    row = tracked[len(tracked) // 2] if number is None else tracked[tracked["index"] == number][0]
    sequence = open_truth(folder, Path(run.provenance["input"]))
    frame = next(frame for frame in sequence.frames() if frame.index == row["index"])
    depth_mm, pose = run.depth.read(frame.index), row["T_world_camera"]
    if depth_mm is None:
        raise SystemExit(f"{folder} kept no depth of frame {frame.index}")
    draw_surface(run, frame, pose, depth_mm, file)
    if file.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{file} has {file.stat().st_size} bytes, over {MOST_BYTES}")


def main() -> None:
    """Draw all runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frame", type=int, help="number of the frame")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for run in options.runs:
        draw_run(run, options.out / f"{run.name}.jpg", options.frame)


if __name__ == "__main__":
    main()
