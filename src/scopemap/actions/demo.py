"""Reconstructs a phantom and measures the result against its truth, for `scopemap demo`.

    OUT/phantom   frames, true poses, depth and surface     OUT/run   what `scopemap run` would write
    OUT/pictures  trajectory.png, mesh.png, depth.png

Needs no network access and no weights but those of the package: ScopeNet's depth, DIS flow, structural similarity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from scopemap.config import Config
from scopemap.errors import InputError
from scopemap.evaluation.poses import MatchedTrajectories, match, pose_report
from scopemap.io.opening import open_sequence
from scopemap.io.result_folder import check_result_folder
from scopemap.io.sequence import Sequence
from scopemap.pipeline import Step
from scopemap.reconstruction import Reconstruction
from scopemap.report.depth_figures import draw_depths
from scopemap.report.frame_pictures import FramePictures
from scopemap.report.mesh_figures import draw_mesh, draw_trajectories
from scopemap.report.page import write_report
from scopemap.runner.preparation import Progress
from scopemap.runner.run import Observer, reconstruct
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap_bench.entry import render_once
from scopemap_bench.evaluation.depth import evaluate_depth, mean_depth_report
from scopemap_bench.evaluation.surface import compare_surfaces
from scopemap_bench.phantom.spec import PhantomSpec

PHANTOM = PhantomSpec(scene="colon", frames=60, width=320, height=256, seed=0)
"""The phantom of the demonstration."""

_DRAWN_FRAMES = 4


@dataclass(frozen=True)
class Demonstration:
    """A phantom, its reconstruction, and the depth of each frame, raw and refined, (H, W) float32 mm by frame index."""

    sequence: Sequence
    result: Reconstruction
    raw_mm: dict[int, np.ndarray]
    refined_mm: dict[int, np.ndarray]

    @property
    def matched(self) -> MatchedTrajectories:
        """Estimated and true poses after Sim(3)."""
        return match(self.result.trajectory, read_trajectory(self.sequence.path), "sim3")

    @property
    def aligned_mesh(self) -> trimesh.Trimesh:
        """The reconstructed surface after Sim(3), true world mm."""
        mesh = self.result.mesh.copy()
        mesh.vertices = self.matched.similarity.transform_points(np.asarray(mesh.vertices))
        return mesh

    @property
    def true_mesh(self) -> trimesh.Trimesh:
        """The surface that the camera saw, true world mm."""
        return trimesh.load_mesh(self.sequence.path / "mesh_truth.ply", process=False)


def prepare_out(out: Path, *, overwrite: bool) -> None:
    """Make the folder of pictures; an earlier demonstration's run is an `InputError`, unless `overwrite`."""
    check_result_folder(out / "run", overwrite=overwrite)
    try:
        (out / "pictures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write pictures to {out}: {error.strerror or error}") from None


def render(out: Path, spec: PhantomSpec = PHANTOM, progress: Callable[[int, int], None] | None = None) -> bool:
    """Render the phantom into OUT/phantom, unless it is there already; return whether it had to be rendered."""
    return render_once(spec, out / "phantom", progress)


def run_on_phantom(
    out: Path,
    config: Config,
    observers: tuple[Observer, ...] = (),
    progress: Progress = lambda doing, done, total: None,
) -> Demonstration:
    """Reconstruct OUT/phantom into OUT/run; the estimators see its images and calibration only."""
    raw_mm: dict[int, np.ndarray] = {}
    refined_mm: dict[int, np.ndarray] = {}

    def keep_depth(step: Step) -> None:
        raw_mm[step.frame.index], refined_mm[step.frame.index] = step.raw_mm, np.asarray(step.frame.depth_mm)

    sequence = open_sequence(out / "phantom")
    pictures = FramePictures()
    seen = (*observers, keep_depth, pictures.observe)
    result = reconstruct(sequence, config, out=out / "run", overwrite=True, observers=seen, progress=progress)
    write_report(out / "run", pictures)
    return Demonstration(sequence, result, raw_mm, refined_mm)


def measure(demo: Demonstration) -> dict[str, float]:
    """Return the errors of the run, NaN where nothing could be measured.

    frames, tracked : all frames and those not lost. path_mm : length of the true path.
    ate_sim3_mm, ate_origin_mm : RMSE of the position after Sim(3), and with only the first poses aligned.
    scale : factor of Sim(3), true over estimated.
    rotation_mean_deg, rotation_max_deg : rotation error since the first frame, no alignment.
    mesh_accuracy_mm, mesh_median_mm : distance of the mesh (moved by Sim(3)) to the true surface, mean and median.
    mesh_completeness_mm : mean distance of the seen part of the true surface to the mesh.
    depth_abs_rel, raw_depth_abs_rel : mean relative error of refined and of raw depth, each frame scaled by its median.

    Raises `AlignmentError` where hardly a frame was tracked.
    """
    sim3, truth = pose_report(demo.matched), read_trajectory(demo.sequence.path)
    mesh = dict.fromkeys(("mesh_accuracy_mm", "mesh_median_mm", "mesh_completeness_mm"), float("nan"))
    if len(demo.result.mesh.faces):
        surface = compare_surfaces(demo.aligned_mesh, demo.true_mesh)
        mesh = {"mesh_accuracy_mm": surface["accuracy_mean_mm"], "mesh_median_mm": surface["accuracy_median_mm"]}
        mesh |= {"mesh_completeness_mm": surface["completeness_mean_mm"]}
    return {
        "frames": sim3["frames"],
        "tracked": sim3["tracked"],
        "path_mm": truth.path_length_mm,
        "ate_sim3_mm": sim3["ate_rmse_mm"],
        "ate_origin_mm": pose_report(match(demo.result.trajectory, truth, "origin"))["ate_rmse_mm"],
        "scale": sim3["scale"],
        "rotation_mean_deg": sim3["rotation_unaligned_mean_deg"],
        "rotation_max_deg": sim3["rotation_unaligned_max_deg"],
        **mesh,
        "depth_abs_rel": _abs_rel(demo.sequence, demo.refined_mm),
        "raw_depth_abs_rel": _abs_rel(demo.sequence, demo.raw_mm),
    }


def draw(demo: Demonstration, folder: Path) -> list[Path]:
    """Draw trajectory.png (estimate green, truth red), mesh.png and depth.png into `folder`; return the files."""
    files = [folder / name for name in ("trajectory.png", "mesh.png", "depth.png")]
    matched = demo.matched
    estimate_mm = np.where(matched.tracked[:, None], matched.aligned[:, :3, 3], np.nan)
    draw_trajectories(estimate_mm, matched.reference[:, :3, 3], files[0])
    draw_mesh(demo.aligned_mesh, files[1], matched.reference[0], demo.true_mesh)
    indices = sorted(demo.raw_mm)
    chosen = {indices[place] for place in np.linspace(0, len(indices) - 1, _DRAWN_FRAMES).astype(int)}
    shown = [(frame, truth) for frame, truth in demo.sequence if frame.index in chosen]
    depths: dict[str, list[np.ndarray | None]] = {
        "raw depth": [demo.raw_mm[frame.index] for frame, _ in shown],
        "refined depth": [demo.refined_mm[frame.index] for frame, _ in shown],
        "true depth": [None if truth is None else truth.depth_mm for _, truth in shown],
    }
    draw_depths([frame.rgb for frame, _ in shown], depths, files[2])
    return files


def _abs_rel(sequence: Sequence, depth_mm: dict[int, np.ndarray]) -> float:
    pairs = [(depth_mm[frame.index], truth.depth_mm) for frame, truth in sequence if truth is not None]
    reports = [evaluate_depth(found, true, scaling="median") for found, true in pairs if true is not None]
    return float(mean_depth_report(reports)["abs_rel"])
