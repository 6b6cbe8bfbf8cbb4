"""Reconstructs the packaged clip of a phantom colon and compares the result with its truth, for `scopemap demo`.

    OUT/clip      colon.mp4, its camera.yaml, and its true poses, pose.txt
    OUT/run       what `scopemap run` would write
    OUT/pictures  trajectory.png, depth.png

Needs no network access and no weights but those of the package. `scopemap_bench/scripts/demo_clip.py` renders the clip.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.errors import reporting
from scopemap.engine.odometry import Step
from scopemap.evaluation.poses import MatchedTrajectories, match, pose_report
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.report.depth_figures import draw_depths
from scopemap.report.frame_pictures import FramePictures
from scopemap.report.mesh_figures import draw_trajectories
from scopemap.report.page import write_report
from scopemap.result.result import Result
from scopemap.result.result_folder import check_result_folder
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.observers import Observer, Progress
from scopemap.runner.reconstruct import reconstruct

CLIP = "colon.mp4"
CAMERA = "camera.yaml"
TRUTH = "pose.txt"
FRAMES = 60
"""Frames of the packaged clip."""

_DRAWN_FRAMES = 4


@dataclass(frozen=True)
class Demonstration:
    """A run of the clip, and the depth of some frames, raw and refined, (H, W) float32 mm by frame index."""

    clip: Path
    sequence: Sequence
    result: Result
    raw_mm: dict[int, np.ndarray]
    refined_mm: dict[int, np.ndarray]

    @property
    def matched(self) -> MatchedTrajectories:
        """Estimated and true poses after Sim(3)."""
        return match(self.result.trajectory, read_trajectory(self.clip / TRUTH), "sim3")


def prepare_out(out: Path, *, overwrite: bool) -> Path:
    """Copy the clip to OUT/clip and return this folder; an earlier run is an `InputError`, unless `overwrite`."""
    check_result_folder(out / "run", overwrite=overwrite)
    clip = out / "clip"
    with reporting(f"cannot write the demonstration to {out}"):
        for folder in (clip, out / "pictures"):
            folder.mkdir(parents=True, exist_ok=True)
        for name in (CLIP, CAMERA, TRUTH):
            with as_file(files("scopemap.apps.demo") / "clip" / name) as packaged:
                shutil.copyfile(packaged, clip / name)
    return clip


def run_clip(
    out: Path,
    config: Config,
    observers: tuple[Observer, ...] = (),
    progress: Progress = lambda doing, done, total: None,
    frames: slice | None = None,
) -> Demonstration:
    """Reconstruct OUT/clip into OUT/run; the estimators see its video and its calibration only."""
    clip = out / "clip"
    sequence = open_sequence(clip / CLIP, camera=clip / CAMERA, frames=frames)
    indices = range(FRAMES)[frames or slice(None)]
    drawn = {indices[place] for place in np.linspace(0, len(indices) - 1, _DRAWN_FRAMES).astype(int)}
    raw_mm: dict[int, np.ndarray] = {}
    refined_mm: dict[int, np.ndarray] = {}

    def keep_depth(step: Step) -> None:
        if step.frame.index in drawn:
            raw_mm[step.frame.index], refined_mm[step.frame.index] = step.raw_mm, np.asarray(step.frame.depth_mm)

    seen: tuple[Observer, ...] = (*observers, keep_depth, FramePictures())
    result = reconstruct(sequence, config, out=out / "run", overwrite=True, observers=seen, progress=progress)
    write_report(out / "run")
    return Demonstration(clip, sequence, result, raw_mm, refined_mm)


def measure(demo: Demonstration) -> dict[str, float]:
    """Return the errors of the run.

    frames, tracked : all frames and those not lost. path_mm : length of the true path.
    ate_sim3_mm, ate_origin_mm : RMSE of the position after Sim(3), and with only the first poses aligned.
    scale : factor of Sim(3), true over estimated.
    rotation_mean_deg, rotation_max_deg : rotation error since the first frame, no alignment.

    Raises `AlignmentError` where hardly a frame was tracked.
    """
    sim3, truth = pose_report(demo.matched), read_trajectory(demo.clip / TRUTH)
    return {
        "frames": sim3["frames"],
        "tracked": sim3["tracked"],
        "path_mm": truth.path_length_mm,
        "ate_sim3_mm": sim3["ate_rmse_mm"],
        "ate_origin_mm": pose_report(match(demo.result.trajectory, truth, "origin"))["ate_rmse_mm"],
        "scale": sim3["scale"],
        "rotation_mean_deg": sim3["rotation_unaligned_mean_deg"],
        "rotation_max_deg": sim3["rotation_unaligned_max_deg"],
    }


def draw(demo: Demonstration, folder: Path) -> list[Path]:
    """Draw trajectory.png (estimate green, truth red) and depth.png into `folder`; return the files."""
    drawings = [folder / name for name in ("trajectory.png", "depth.png")]
    matched = demo.matched
    estimate_mm = np.where(matched.tracked[:, None], matched.aligned[:, :3, 3], np.nan)
    draw_trajectories(estimate_mm, matched.reference[:, :3, 3], drawings[0])
    shown = [frame for frame, _ in demo.sequence if frame.index in demo.raw_mm]
    kinds = {"raw depth": demo.raw_mm, "refined depth": demo.refined_mm}
    depths = {kind: [depth_mm[frame.index] for frame in shown] for kind, depth_mm in kinds.items()}
    draw_depths([frame.rgb for frame in shown], depths, drawings[1])
    return drawings
