"""Whether the back end makes poses better where the camera is a real one; as Markdown.

    python -m scopemap_bench.scripts.camera_effects --data FOLDER [--paths t2v1 ...] [--effects clean ...] [--keep
            FOLDER]

Colon phantoms along true hand motion (FOLDER/endoscopy/c3vd_camera_paths), 320x256, 80 degrees, with motion blur,
H.264, automatic exposure that lags, and scattered light, one by one and together; also with faint texture. Depth is
scopenet's, flow DIS, and there is no surface. One run gives both: poses as tracked are what observers see, poses
adjusted are the result's. ATE in mm after Sim(3). Steps: length of the way between keyframes over its true length, in
the four quarters of the way, relative to the whole; all 1 without drift of scale. --keep renders phantoms there once
and uses them again.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scopemap import open_sequence, reconstruct
from scopemap.config import Config
from scopemap.evaluation.poses import match, pose_report
from scopemap.io.reference import read_reference
from scopemap.odometry import Step
from scopemap.trajectory.trajectory import Trajectory
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom
from scopemap_bench.scripts.accuracy import NO_SURFACE

# Seed and frames: those in which the camera moves.
PATHS = {"t2v1": (31, 110), "t2v2": (32, 103), "t3v3": (33, 110), "d4v2": (34, 110)}
EFFECTS: dict[str, dict[str, Any]] = {
    "clean": {},
    "blur": {"shutter": 0.8},
    "coding": {"h264_crf": 30},
    "exposure": {"auto_exposure": True, "exposure_lag_frames": 6.0},
    "indirect": {"indirect": 0.15},
}
EFFECTS["all"] = {key: value for effect in EFFECTS.values() for key, value in effect.items()}
EFFECTS["allfaint"] = EFFECTS["all"] | {"texture": 0.3}


def steps(trajectory: Trajectory, truth: Trajectory, keyframes: list[int]) -> str:
    """Lengths of steps between keyframes over the true ones, in the quarters of the way, over that of the whole."""
    lengths = []
    for some in (trajectory, truth):
        place = {int(index): n for n, index in enumerate(some.indices)}
        positions = some.T_world_camera[[place[index] for index in keyframes], :3, 3]
        lengths.append(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    found, true = lengths
    quarter = np.minimum(4 * (np.cumsum(true) - 0.5 * true) / true.sum(), 3.999).astype(int)
    share = [found[quarter == n].sum() / max(true[quarter == n].sum(), 1e-9) for n in range(4)]
    return " ".join(f"{part / (found.sum() / true.sum()):.2f}" if part else "-" for part in share)


def row(name: str, source: Path) -> str:
    """Reconstruct a phantom once; return the row with its errors as tracked and adjusted."""
    tracked: dict[int, np.ndarray] = {}

    def note(step: Step) -> None:
        if step.frame.T_world_camera is not None:
            tracked[step.frame.index] = step.frame.T_world_camera

    result = reconstruct(open_sequence(source), Config.load(settings=NO_SURFACE), observers=(note,))
    adjusted, truth = result.trajectory, read_reference(source)
    poses = np.stack([tracked.get(int(n), T) for n, T in zip(adjusted.indices, adjusted.T_world_camera, strict=True)])
    before = replace(adjusted, T_world_camera=poses)
    good = set(result.frames["index"][result.frames.tracked].tolist())
    keyframes = sorted(set(result.frames["keyframe"][result.frames.tracked].tolist()) & good)
    errors = [f"{pose_report(match(some, truth, 'sim3'))['ate_rmse_mm']:.3f}" for some in (before, adjusted)]
    drift = [steps(some, truth, keyframes) for some in (before, adjusted)]
    return f"| {name} | {len(good)} of {len(result.frames)} | {' | '.join(errors)} | {' | '.join(drift)} |"


def main() -> None:
    """Render, run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--paths", nargs="+", choices=PATHS, default=list(PATHS))
    parser.add_argument("--effects", nargs="+", choices=EFFECTS, default=list(EFFECTS))
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    print("| path, effects | frames tracked | ATE as tracked | ATE adjusted | steps as tracked | steps adjusted |")
    print("|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        for path in options.paths:
            for effect in options.effects:
                source = (options.keep or Path(scratch)) / f"{path}_{effect}"
                if not (source / "mesh_truth.ply").is_file():
                    seed, frames = PATHS[path]
                    file = options.data / f"endoscopy/c3vd_camera_paths/{path}.txt"
                    spec = PhantomSpec(frames=frames, seed=seed, fov_deg=80.0, path_file=file, **EFFECTS[effect])
                    write_phantom(spec, source)
                print(row(f"{path}, {effect}", source), flush=True)


if __name__ == "__main__":
    main()
