"""Writes the tables and figures of finished runs, of a benchmark or of any folders, for `bench` and `compare`.

OUT/results.md    OUT/tables/NAME.{md,csv,tex}
OUT/figures/      ate.png, frames_until_loss.png, orb_bars.png; per sequence orb_pairs, orb_points, depth_change;
per run its mesh with both camera paths
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from scopemap.benchmark.plan import folder_name
from scopemap.benchmark.result import RunResult
from scopemap.benchmark.summary import joined, summarise
from scopemap.benchmark.table import pd
from scopemap.benchmark.tables import write_tables
from scopemap.config import MaskSettings
from scopemap.errors import AlignmentError, InputError
from scopemap.evaluation.correspondences import FrameMatcher, displacements
from scopemap.evaluation.poses import match
from scopemap.frame import Frame, Truth
from scopemap.io.datasets.reference import reference_trajectory
from scopemap.io.sequence import Sequence as Frames
from scopemap.masking.masker import Masker
from scopemap.reconstruction import DepthReader
from scopemap.report.benchmark_figures import (
    draw_ate,
    draw_displacement_bars,
    draw_displacement_scatter,
    draw_frames_until_loss,
    draw_matched_points,
)
from scopemap.report.depth_figures import DepthScene, draw_depth_change
from scopemap.report.mesh_figures import draw_reconstruction
from scopemap.trajectory.formats.opening import read_trajectory

_MAX_DEPTHS = 6
_WORLD = {"reference": "world, true poses", "estimated": "world, own poses"}


@dataclass(frozen=True)
class FinishedRun:
    """A run whose figures are drawn.

    Attributes
    ----------
    result : its figures. folder : of the run.
    open : opens its frames and their truth; None where only poses are known.
    """

    result: RunResult
    folder: Path
    open: Callable[[], Frames] | None = None


def write_results(
    runs: Sequence[FinishedRun], out: Path, *, title: str, notes: Sequence[str] = (), paper_units: bool = False
) -> list[Path]:
    """Write all tables, and every figure that the runs have values for, below `out`; return the files.

    Raises `InputError` where they cannot be written.
    """
    results = [run.result for run in runs]
    files = list(write_tables(results, out, paper_units=paper_units, title=title, notes=notes))
    folder = out / "figures"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write figures to {folder}: {error.strerror or error}") from None
    files += _bars(results, folder)
    for sequence in dict.fromkeys(result.sequence for result in results):
        done = [run for run in runs if run.result.sequence == sequence and run.result.status == "done"]
        files += _figures_of_sequence(sequence, done, folder)
    return files


def _bars(results: Sequence[RunResult], folder: Path) -> Iterator[Path]:
    rows = summarise(results)

    def of_all(key: str) -> pd.DataFrame:
        """Return a figure by sequence and method, both in the order of the results."""
        table = rows.reindex(columns=[key, "sequence", "method"]).pivot(index="sequence", columns="method", values=key)
        return table.reindex(index=rows["sequence"].unique(), columns=rows["method"].unique()).astype(float)

    if (ate_mm := of_all("poses.ate_rmse_mm")).notna().any(axis=None):
        draw_ate(ate_mm, folder / "ate.png", alignment=joined(sorted(rows["alignment"])).replace("/", ", "))
        yield folder / "ate.png"
    if (lengths := of_all("poses.frames")).notna().any(axis=None):
        longest = lengths.max(axis=1).fillna(0).astype(int).tolist()
        draw_frames_until_loss(of_all("poses.frames_until_loss"), longest, folder / "frames_until_loss.png")
        yield folder / "frames_until_loss.png"
    orb = f"consistency.orb_{_world_poses(results)}"
    if (medians_mm := of_all(f"{orb}.median_mm")).notna().any(axis=None):
        means_mm, stds_mm = of_all(f"{orb}.mean_mm"), of_all(f"{orb}.std_mm")
        file = folder / "orb_bars.png"
        draw_displacement_bars(means_mm, stds_mm, medians_mm, file, where=_WORLD[_world_poses(results)])
        yield file


def _world_poses(results: Sequence[RunResult]) -> str:
    """Return whose poses take matched points into the world: the true ones for all runs where any run has them."""
    known = any(np.isfinite(result.figure("consistency", "orb_reference.median_mm")) for result in results)
    return "reference" if known else "estimated"


def _figures_of_sequence(sequence: str, runs: Sequence[FinishedRun], folder: Path) -> Iterator[Path]:
    """Draw the figures of one sequence; those that need its frames only where these are still there."""
    name = folder_name(sequence)
    poses = _world_poses([run.result for run in runs])
    pairs = {run.result.method: _pair_medians(run.result, poses) for run in runs}
    measured = {method: medians for method, medians in pairs.items() if np.isfinite(medians).any()}
    if measured:
        draw_displacement_scatter(measured, folder / f"orb_pairs_{name}.png", where=_WORLD[poses])
        yield folder / f"orb_pairs_{name}.png"
    open_frames = next((run.open for run in runs if run.open is not None), None)
    try:
        frames = None if open_frames is None else open_frames()
    except InputError:
        frames = None
    if frames is None:
        return
    if measured:
        yield from _two_frames(sequence, [run for run in runs if run.result.method in measured], frames, folder)
    for run in runs:
        file = folder / f"mesh_{name}_{folder_name(run.result.method)}.png"
        if _draw_mesh(run, frames, file):
            yield file


def _pair_medians(result: RunResult, poses: str) -> np.ndarray:
    medians = result.figures.get("consistency", {}).get(f"orb_{poses}", {}).get("pair_median_mm", [])
    return np.array([np.nan if value is None else value for value in medians], dtype=np.float64)


def _two_frames(sequence: str, runs: Sequence[FinishedRun], frames: Frames, folder: Path) -> Iterator[Path]:
    """Draw the depth of the two frames in the middle, and the 3D points of ORB's matches between them."""
    (previous, true_previous), (current, true_current) = _middle(frames)
    depths = {}
    for run in runs[:_MAX_DEPTHS]:
        reader = DepthReader(run.folder)
        before, now = reader.read(previous.index), reader.read(current.index)
        if before is not None and now is not None and before.shape == now.shape == previous.valid.shape:
            scale = run.result.figure("consistency", "scale")
            depths[run.result.method] = (scale * before, scale * now)
    if not depths:
        return
    name = folder_name(sequence)
    scene = DepthScene(f"{sequence}, frames {previous.index}, {current.index}", (previous.rgb, current.rgb), depths)
    draw_depth_change(scene, folder / f"depth_change_{name}.png")
    yield folder / f"depth_change_{name}.png"
    matcher = FrameMatcher(frames.camera)
    matcher.match(previous.rgb, previous.valid)
    correspondence = matcher.match(current.rgb, current.valid)
    T_previous, T_current = (None if truth is None else truth.T_world_camera for truth in (true_previous, true_current))
    if T_previous is None or T_current is None or correspondence is None:
        return
    poses = (T_previous, T_current)
    found = {
        method: displacements(correspondence.matches, *maps, frames.camera, poses) for method, maps in depths.items()
    }
    points = {method: (ends.previous_mm, ends.current_mm) for method, ends in found.items()}
    draw_matched_points(points, folder / f"orb_points_{name}.png")
    yield folder / f"orb_points_{name}.png"


def _middle(frames: Frames) -> list[tuple[Frame, Truth | None]]:
    """Return the two frames in the middle, masked as for the measures, with their truth."""
    stamps = frames.source.stamps(frames.selection) or []
    masker = Masker(MaskSettings())
    last: list[tuple[Frame, Truth | None]] = []
    for number, (frame, truth) in enumerate(frames):
        last = [*last[-1:], (masker(frame), truth)]
        if number > len(stamps) // 2 and len(last) == 2:
            break
    return last


def _draw_mesh(run: FinishedRun, frames: Frames, file: Path) -> bool:
    """Draw a run's mesh with both camera paths in the true world; False where there is no mesh or no truth."""
    mesh_file, reference = run.folder / "mesh.ply", reference_trajectory(frames)
    if reference is None or not mesh_file.is_file():
        return False
    mesh = trimesh.load_mesh(mesh_file, process=False)
    try:
        matched = match(read_trajectory(run.folder), reference, run.result.figures["poses"].get("align", "sim3"))
    except AlignmentError:
        return False
    if not len(mesh.faces):
        return False
    mesh.vertices = matched.similarity.transform_points(np.asarray(mesh.vertices))
    estimate_mm = np.where(matched.tracked[:, None], matched.aligned[:, :3, 3], np.nan)
    draw_reconstruction(mesh, estimate_mm, matched.reference[:, :3, 3], file, matched.reference[0])
    return True
