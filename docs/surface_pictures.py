"""One picture per run: a frame, the surface seen from there, its confidence, and the surface from outside.

    python docs/surface_pictures.py RUN ... --out FOLDER [--frame N]

RUN is a run's folder whose input is still where it was. Writes FOLDER/NAME.jpg, NAME being the run's folder. Pictures
of C3VD and most clinical video may not be kept in the project: their licences do not allow it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import trimesh

from scopemap.actions.inputs import open_truth
from scopemap.config import Config
from scopemap.fusion.agreement import compare_with_frame
from scopemap.reconstruction import DepthReader
from scopemap.report.mesh_figures import draw_surface
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.result import read_provenance

MOST_BYTES = 200_000


def confidence_of(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Return the vertex property `confidence` (V,) of a mesh read from PLY; None where it has none."""
    data = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    return None if data is None or "confidence" not in data.dtype.names else np.ravel(data["confidence"])


def draw_run(run: Path, file: Path, number: int | None = None) -> None:
    """Draw a run at a frame, by default the middle one of those tracked."""
    mesh, trajectory = trimesh.load_mesh(run / "mesh.ply", process=False), read_trajectory(run)
    tracked = np.flatnonzero(trajectory.tracked)
    row = tracked[len(tracked) // 2] if number is None else int(np.flatnonzero(trajectory.indices == number)[0])
    sequence = open_truth(run, Path(read_provenance(run)["input"]))
    frame = next(frame for frame in sequence.frames() if frame.index == trajectory.indices[row])
    depth_mm = DepthReader(run).read(frame.index)
    if depth_mm is None:
        raise SystemExit(f"{run} kept no depth of frame {frame.index}")
    albedo = Config.load(file=run / "config.toml").fusion.colours == "albedo"
    pose = trajectory.T_world_camera[row]
    _, rendering = compare_with_frame(mesh, frame.camera, pose, frame.rgb, depth_mm, albedo=albedo)
    positions_mm = trajectory.T_world_camera[tracked, :3, 3]
    draw_surface((frame.rgb, frame.camera, pose), rendering, mesh, positions_mm, file, confidence_of(mesh))
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
