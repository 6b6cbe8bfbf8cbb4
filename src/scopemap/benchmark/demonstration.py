"""The whole path on a phantom, measured against its truth: what `scopemap demo` does.

    OUT/phantom   frames, true poses, depth and surface     OUT/run   what `scopemap run` would write
    OUT/pictures  trajectory.png, mesh.png, depth.png

Needs no connection and no weights but the package's own: ScopeNet's depth, DIS flow, structural similarity.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.config import Config
from scopemap.errors import InputError
from scopemap.evaluation.depth import evaluate_depth, mean_depth_report
from scopemap.evaluation.poses import MatchedTrajectories, match, pose_report
from scopemap.evaluation.surface import compare_surfaces
from scopemap.io.opening import open_sequence
from scopemap.io.sequence import Sequence
from scopemap.phantom import PhantomSpec, write_phantom
from scopemap.pipeline import Step
from scopemap.reconstruction import Reconstruction, prepare_folder
from scopemap.report.pictures import draw_depths, draw_mesh, draw_trajectories
from scopemap.runner import Observer, reconstruct
from scopemap.trajectory.formats.opening import read_trajectory

PHANTOM = PhantomSpec(scene="colon", frames=60, width=320, height=256, seed=0)
"""The phantom of the demonstration."""

# RAFT and LPIPS would be used where their weights happen to lie; figures must not depend on that.
_WITHOUT_WEIGHTS = {"networks.flow": "dis", "networks.perceptual": "structure"}
_DRAWN_FRAMES = 4
_MISSING = float("nan")


@dataclass(frozen=True)
class Figures:
    """How far a run is from the truth; NaN where nothing could be measured.

    Attributes
    ----------
    frames, tracked : all frames and those not lost; path_mm : length of the true path.
    ate_sim3_mm, ate_origin_mm : RMSE of the position after Sim(3), and with only the first poses put onto each other.
    scale : factor that Sim(3) found, true over estimated.
    rotation_mean_deg, rotation_max_deg : rotation error since the first frame, no alignment.
    mesh_accuracy_mm, mesh_median_mm : distance of the mesh (moved by Sim(3)) to the true surface, mean and median.
    mesh_completeness_mm : mean distance of the true surface, as far as it was seen, to the mesh.
    depth_abs_rel, raw_depth_abs_rel : mean relative error of refined and of raw depth, each frame scaled by its median.
    """

    frames: int
    tracked: int
    path_mm: float
    ate_sim3_mm: float
    ate_origin_mm: float
    scale: float
    rotation_mean_deg: float
    rotation_max_deg: float
    mesh_accuracy_mm: float
    mesh_median_mm: float
    mesh_completeness_mm: float
    depth_abs_rel: float
    raw_depth_abs_rel: float


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
    def true_mesh(self) -> trimesh.Trimesh:
        """The surface that the camera saw, true world mm."""
        return trimesh.load_mesh(self.sequence.path / "mesh_truth.ply", process=False)


def demo_config(settings: dict[str, Any]) -> Config:
    """Return the default preset without anything that would look for weights, then `settings` (dotted names)."""
    return Config.load("default", settings=_WITHOUT_WEIGHTS | settings)


def prepare_out(out: Path, *, overwrite: bool) -> None:
    """Make the folders; an earlier demonstration's run and pictures go if `overwrite`, else `InputError`."""
    prepare_folder(out / "run", overwrite=overwrite)
    try:
        (out / "pictures").mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write pictures to {out}: {error.strerror or error}") from None


def render(out: Path, spec: PhantomSpec = PHANTOM, progress: Callable[[int, int], None] | None = None) -> bool:
    """Render the phantom into OUT/phantom, unless it is there already; return whether it had to be rendered."""
    if is_rendered(out / "phantom", spec):
        return False
    write_phantom(spec, out / "phantom", progress)
    return True


def run_on_phantom(out: Path, config: Config, observers: tuple[Observer, ...] = ()) -> Demonstration:
    """Reconstruct OUT/phantom into OUT/run; the estimators see its images and calibration only."""
    raw_mm: dict[int, np.ndarray] = {}
    refined_mm: dict[int, np.ndarray] = {}

    def keep_depth(step: Step) -> None:
        raw_mm[step.frame.index], refined_mm[step.frame.index] = step.raw_mm, step.refined.depth_mm

    sequence = open_sequence(out / "phantom")
    result = reconstruct(sequence, config, out=out / "run", overwrite=True, observers=(*observers, keep_depth))
    return Demonstration(sequence, result, raw_mm, refined_mm)


def measure(demonstration: Demonstration) -> Figures:
    """Compare poses, mesh and depth with the truth; raises `AlignmentError` where hardly a frame was tracked."""
    matched = demonstration.matched
    sim3 = pose_report(matched)
    truth = read_trajectory(demonstration.sequence.path)
    origin = pose_report(match(demonstration.result.trajectory, truth, "origin"))
    return Figures(
        frames=sim3.frames,
        tracked=sim3.tracked,
        path_mm=truth.path_length_mm,
        ate_sim3_mm=sim3.ate_rmse_mm,
        ate_origin_mm=origin.ate_rmse_mm,
        scale=sim3.scale,
        rotation_mean_deg=sim3.rotation_unaligned_mean_deg,
        rotation_max_deg=sim3.rotation_unaligned_max_deg,
        **_mesh_figures(demonstration, matched),
        depth_abs_rel=_abs_rel(demonstration.sequence, demonstration.refined_mm),
        raw_depth_abs_rel=_abs_rel(demonstration.sequence, demonstration.raw_mm),
    )


def draw(demonstration: Demonstration, folder: Path) -> list[Path]:
    """Draw trajectory.png (estimate green, truth red), mesh.png and depth.png into `folder`; return the files."""
    files = [folder / name for name in ("trajectory.png", "mesh.png", "depth.png")]
    matched = demonstration.matched
    estimate_mm = np.where(matched.tracked[:, None], matched.aligned[:, :3, 3], np.nan)
    draw_trajectories(estimate_mm, matched.reference[:, :3, 3], files[0])
    mesh = _moved_to_truth(demonstration, matched)
    draw_mesh(mesh, files[1], matched.reference[0], demonstration.true_mesh)
    _draw_some_depths(demonstration, files[2])
    return files


def is_rendered(folder: Path, spec: PhantomSpec) -> bool:
    """Whether `folder` holds this very phantom, whole; its mesh is what is written last."""
    try:
        description = json.loads((folder / "phantom.json").read_text())
    except (OSError, ValueError):
        return False
    wanted = json.loads(json.dumps(asdict(spec), default=str))
    same = description.get("spec") == wanted and description.get("made_by") == f"scopemap {version('scopemap')}"
    return same and (folder / "mesh_truth.ply").is_file()


def _moved_to_truth(demonstration: Demonstration, matched: MatchedTrajectories) -> trimesh.Trimesh:
    mesh = demonstration.result.mesh.copy()
    mesh.vertices = matched.similarity.transform_points(np.asarray(mesh.vertices))
    return mesh


def _mesh_figures(demonstration: Demonstration, matched: MatchedTrajectories) -> dict[str, float]:
    names = ("mesh_accuracy_mm", "mesh_median_mm", "mesh_completeness_mm")
    if not len(demonstration.result.mesh.faces):
        return dict.fromkeys(names, _MISSING)
    report = compare_surfaces(_moved_to_truth(demonstration, matched), demonstration.true_mesh)
    values = (report.accuracy.mean_mm, report.accuracy.median_mm, report.completeness.mean_mm)
    return dict(zip(names, values, strict=True))


def _abs_rel(sequence: Sequence, depth_mm: dict[int, np.ndarray]) -> float:
    pairs = [(depth_mm[frame.index], truth.depth_mm) for frame, truth in sequence if truth is not None]
    reports = [evaluate_depth(found, true, scaling="median") for found, true in pairs if true is not None]
    return mean_depth_report(reports).abs_rel


def _draw_some_depths(demonstration: Demonstration, file: Path) -> None:
    indices = np.array(sorted(demonstration.raw_mm))
    chosen = indices[np.linspace(0, len(indices) - 1, min(_DRAWN_FRAMES, len(indices))).astype(int)].tolist()
    shown = [(frame, truth) for frame, truth in demonstration.sequence if frame.index in chosen]
    draw_depths(
        [frame.rgb for frame, _ in shown],
        [demonstration.raw_mm[frame.index] for frame, _ in shown],
        [demonstration.refined_mm[frame.index] for frame, _ in shown],
        [None if truth is None else truth.depth_mm for _, truth in shown],
        file,
    )
