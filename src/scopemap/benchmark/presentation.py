"""Tables and figures of finished runs, of a benchmark or of any folders: what `bench` and `compare` leave behind.

OUT/results.md    OUT/tables/NAME.{md,csv,tex}
OUT/figures/      ate.png, frames_until_loss.png, orb_bars.png; per sequence orb_pairs, orb_points, depth_change;
per run its mesh with both camera paths
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh

from scopemap.benchmark.plan import folder_name
from scopemap.benchmark.result import RunResult
from scopemap.benchmark.summary import Summary, summarise
from scopemap.benchmark.tables import write_tables
from scopemap.config import MaskSettings
from scopemap.errors import AlignmentError, InputError
from scopemap.evaluation.correspondences import FrameMatcher
from scopemap.evaluation.displacement import displacements
from scopemap.evaluation.poses import MatchedTrajectories, match
from scopemap.frame import Frame, Truth
from scopemap.geometry.align import AlignMode
from scopemap.io.datasets.reference import reference_trajectory
from scopemap.io.sequence import Sequence as Frames
from scopemap.masking.masker import Masker
from scopemap.reconstruction import DepthReader
from scopemap.report.benchmark_figures import (
    BarGrid,
    draw_ate,
    draw_displacement_bars,
    draw_displacement_scatter,
    draw_frames_until_loss,
    draw_matched_points,
)
from scopemap.report.depth_panels import DepthScene, draw_depth_differences
from scopemap.report.reconstruction_view import draw_reconstruction
from scopemap.trajectory.formats.opening import read_trajectory

_MOST_DEPTHS = 6
_WORLD = {"reference": "world, true poses", "estimated": "world, own poses"}


@dataclass(frozen=True)
class Shown:
    """A run that is to be shown.

    Attributes
    ----------
    result : its figures. folder : of the run. open : gives its frames and their truth; None where only poses are known.
    """

    result: RunResult
    folder: Path
    open: Callable[[], Frames] | None = None


def present(
    rows: Sequence[Shown],
    out: Path,
    *,
    title: str,
    notes: Sequence[str] = (),
    paper_units: bool = False,
) -> list[Path]:
    """Write all tables, and every figure that the runs have something for, below `out`; return the files.

    Raises `InputError` where they cannot be written.
    """
    results = [row.result for row in rows]
    files = list(write_tables(results, out, paper_units=paper_units, title=title, notes=notes))
    folder = out / "figures"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write figures to {folder}: {error.strerror or error}") from None
    files += _bars(results, folder)
    for sequence in dict.fromkeys(result.sequence for result in results):
        here = [row for row in rows if row.result.sequence == sequence and row.result.status == "done"]
        files += _pictures(sequence, here, folder)
    return files


def _bars(results: Sequence[RunResult], folder: Path) -> Iterator[Path]:
    grid = _Grid(results)
    if np.isfinite(ate := grid.values("poses", "ate_rmse_mm")).any():
        alignments = sorted({str(r.figures["poses"].get("align", "")) for r in results if "poses" in r.figures} - {""})
        file = folder / "ate.png"
        draw_ate(grid.bars(ate), file, alignment=", ".join(alignments))
        yield file
    lengths = grid.values("poses", "frames")
    if np.isfinite(lengths).any():
        longest = np.nanmax(lengths, axis=1, initial=0)
        file = folder / "frames_until_loss.png"
        draw_frames_until_loss(grid.bars(grid.values("poses", "frames_until_loss")), longest.astype(int).tolist(), file)
        yield file
    poses = _world_poses(results)
    medians = grid.values("consistency", f"orb_{poses}.median_mm")
    if np.isfinite(medians).any():
        file = folder / "orb_bars.png"
        means, spreads = (grid.values("consistency", f"orb_{poses}.{name}_mm") for name in ("mean", "std"))
        draw_displacement_bars(grid.bars(means, spreads), medians, file, where=_WORLD[poses])
        yield file


def _world_poses(results: Sequence[RunResult]) -> str:
    """Return whose poses bring matched points into the world: the true ones where any run has them, for all."""
    known = any(np.isfinite(result.figure("consistency", "orb_reference.median_mm")) for result in results)
    return "reference" if known else "estimated"


@dataclass(frozen=True)
class _Grid:
    """Figures of results as arrays: sequences by methods, the mean or median over the seeds as in the tables."""

    results: Sequence[RunResult]

    @cached_property
    def summaries(self) -> tuple[Summary, ...]:
        return summarise(self.results)

    @cached_property
    def sequences(self) -> list[str]:
        return list(dict.fromkeys(summary.sequence for summary in self.summaries))

    @cached_property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(summary.method for summary in self.summaries))

    def values(self, group: str, name: str) -> np.ndarray:
        values = np.full((len(self.sequences), len(self.methods)), np.nan)
        for summary in self.summaries:
            place = self.sequences.index(summary.sequence), self.methods.index(summary.method)
            values[place] = summary.value(group, name).mean
        return values

    def bars(self, values: np.ndarray, spreads: np.ndarray | None = None) -> BarGrid:
        return BarGrid(self.sequences, self.methods, values, spreads)


def _pictures(sequence: str, rows: Sequence[Shown], folder: Path) -> Iterator[Path]:
    """Draw what needs the frames of one sequence."""
    name = folder_name(sequence)
    poses = _world_poses([row.result for row in rows])
    pairs = {row.result.method: _pair_medians(row.result, poses) for row in rows}
    measured = {method: medians for method, medians in pairs.items() if np.isfinite(medians).any()}
    if measured:
        file = folder / f"orb_pairs_{name}.png"
        draw_displacement_scatter(measured, file, where=_WORLD[poses])
        yield file
    open_frames = next((row.open for row in rows if row.open is not None), None)
    if open_frames is None:
        return
    try:
        frames = open_frames()
    except InputError:  # the frames have gone since the run: what needs them is not drawn
        return
    if measured:
        yield from _two_frames(sequence, [row for row in rows if row.result.method in measured], frames, folder)
    for row in rows:
        file = folder / f"mesh_{name}_{folder_name(row.result.method)}.png"
        if _draw_mesh(row, frames, file):
            yield file


def _pair_medians(result: RunResult, poses: str) -> np.ndarray:
    medians = result.figures.get("consistency", {}).get(f"orb_{poses}", {}).get("pair_median_mm", [])
    return np.array([np.nan if value is None else value for value in medians], dtype=np.float64)


def _two_frames(sequence: str, rows: Sequence[Shown], frames: Frames, folder: Path) -> Iterator[Path]:
    """Draw the depth of the two frames in the middle, and where ORB's matches between them come to lie."""
    (previous, true_previous), (current, true_current) = _middle(frames)
    depths = {}
    for row in rows[:_MOST_DEPTHS]:
        reader = DepthReader(row.folder)
        before, now = reader.read(previous.index), reader.read(current.index)
        if before is not None and now is not None and before.shape == now.shape == previous.valid.shape:
            scale = row.result.figure("consistency", "scale")
            depths[row.result.method] = (scale * before, scale * now)
    if not depths:
        return
    name = folder_name(sequence)
    scene = DepthScene(f"{sequence}, frames {previous.index}, {current.index}", (previous.rgb, current.rgb), depths)
    file = folder / f"depth_change_{name}.png"
    draw_depth_differences([scene], file)
    yield file
    poses = _poses(true_previous, true_current)
    matcher = FrameMatcher(frames.camera)
    matcher.match(previous.rgb, previous.valid)
    link = matcher.match(current.rgb, current.valid)
    if poses is None or link is None:
        return
    found = {method: displacements(link.matches, *maps, frames.camera, poses) for method, maps in depths.items()}
    file = folder / f"orb_points_{name}.png"
    draw_matched_points({method: (ends.previous_mm, ends.current_mm) for method, ends in found.items()}, file)
    yield file


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


def _poses(previous: Truth | None, current: Truth | None) -> tuple[np.ndarray, np.ndarray] | None:
    known = [truth.T_world_camera for truth in (previous, current) if truth is not None]
    return (known[0], known[1]) if len(known) == 2 and known[0] is not None and known[1] is not None else None


def _draw_mesh(row: Shown, frames: Frames, file: Path) -> bool:
    """Draw a run's mesh with both camera paths in the true world; False where there is no mesh or no truth."""
    mesh_file, reference = row.folder / "mesh.ply", reference_trajectory(frames)
    if reference is None or not mesh_file.is_file():
        return False
    mesh = trimesh.load_mesh(mesh_file, process=False)
    matched = _matched(row, frames)
    if matched is None or not len(mesh.faces):
        return False
    mesh.vertices = matched.similarity.transform_points(np.asarray(mesh.vertices))
    estimate_mm = np.where(matched.tracked[:, None], matched.aligned[:, :3, 3], np.nan)
    draw_reconstruction(mesh, estimate_mm, matched.reference[:, :3, 3], file, matched.reference[0])
    return True


def _matched(row: Shown, frames: Frames) -> MatchedTrajectories | None:
    reference = reference_trajectory(frames)
    align: AlignMode = row.result.figures.get("poses", {}).get("align", "sim3")
    try:
        return None if reference is None else match(read_trajectory(row.folder), reference, align)
    except AlignmentError:
        return None
