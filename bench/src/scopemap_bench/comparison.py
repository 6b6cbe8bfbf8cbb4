"""Runs side by side: scored without a plan for `compare`, and their tables and figures, also for `bench`.

OUT/results.md, OUT/tables/NAME.{md,csv,tex}, OUT/figures/: ate.png, frames_until_loss.png; per sequence orb_pairs,
orb_points, orb_bars, depth_change, clouds; per run its mesh with the camera paths. Without true poses, points and
meshes are drawn by the estimated ones, and the figures state so.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MaskSettings
from scopemap.engine.errors import AlignmentError, InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.mesh_files import read_mesh
from scopemap.engine.geometry.se3 import inverse, se3, transform
from scopemap.engine.masking.masker import Masker
from scopemap.evaluation.doubts import doubts
from scopemap.evaluation.poses import match
from scopemap.input.sequence import Sequence as Frames
from scopemap.input.trajectory.trajectory import Trajectory, Unit
from scopemap.result.depth_maps import DepthReader
from scopemap.result.input_part import part_of_input
from scopemap.result.reference import read_reference, reference_trajectory
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reread_frames import open_truth
from scopemap_bench import pictures
from scopemap_bench.entry import FILE_NAME as ENTRY
from scopemap_bench.entry import Entry
from scopemap_bench.evaluation.consistency import FrameMatcher, lifted_matches
from scopemap_bench.evaluation.failure import LIMIT_PX, LIMITS_PX
from scopemap_bench.plan import FigurePlan, ProtocolPlan, folder_name
from scopemap_bench.result import FILE_NAME, RunResult
from scopemap_bench.scene_pictures import draw_depth_change, draw_reconstruction, draw_registered_clouds
from scopemap_bench.scoring import default_protocol, pose_groups, score
from scopemap_bench.table import joined, summarise
from scopemap_bench.tables import write_tables

_MAX_DEPTHS = 6
_WORLD = {"reference": "world, true poses", "estimated": "world, own poses"}


@dataclass(frozen=True)
class FinishedRun:
    """A run whose figures are drawn; `open` opens its frames and their truth, None where only poses are known."""

    result: RunResult
    folder: Path
    open: Callable[[], Frames] | None = None
    figure: FigurePlan = field(default_factory=FigurePlan)


def write_results(
    runs: Sequence[FinishedRun], out: Path, *, title: str, notes: Sequence[str] = (), paper_units: bool = False
) -> list[Path]:
    """Write all tables, and every figure that the runs have values for, below `out`; return the files."""
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
        pictures.draw_ate(ate_mm, folder / "ate.png", alignment=joined(sorted(rows["alignment"])).replace("/", ", "))
        yield folder / "ate.png"
    if (lengths := of_all("poses.frames")).notna().any(axis=None):
        longest = lengths.max(axis=1).fillna(0).astype(int).tolist()
        pictures.draw_frames_until_loss(of_all("poses.frames_until_loss"), longest, folder / "frames_until_loss.png")
        yield folder / "frames_until_loss.png"
    until = {limit: of_all(f"poses.frames_until_contradicted_at_{limit:g}_px") for limit in LIMITS_PX}
    if until[LIMIT_PX].notna().any(axis=None):
        file, low, high = folder / "frames_until_contradicted.png", min(LIMITS_PX), max(LIMITS_PX)
        limits = f"limits of {low:g} to {high:g} px, bar: {LIMIT_PX:g} px"
        pictures.draw_frames_until_contradicted(until[LIMIT_PX], until[low], until[high], file, limits=limits)
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
        file = folder / f"orb_pairs_{name}.png"
        bar = "pair of consecutive frames, its median"
        pictures.draw_displacements(measured, file, bar=bar, where=_WORLD[poses])
        yield file
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
    """Draw two frames: their depth, their clouds by each method's poses, ORB's matches in space and as bars."""
    (previous, T_previous), (current, T_current) = frame_pair(frames, runs[0].figure.frame)
    tissue, depths, own_poses = (previous.valid, current.valid), {}, {}
    for run in runs[:_MAX_DEPTHS]:
        reader, scale = DepthReader(run.folder), run.result.figure("consistency", "scale")
        before, now = reader.read(previous.index), reader.read(current.index)
        if before is not None and now is not None and before.shape == now.shape == previous.valid.shape:
            # A run has depth of masked pixels, too: of highlights and the black surround, which show no tissue.
            masked = [np.where(seen, mm, np.nan) for seen, mm in zip(tissue, (before, now), strict=True)]
            depths[run.result.method] = (scale * masked[0], scale * masked[1])
            own_poses[run.result.method] = _poses_of(run, (previous.index, current.index), scale)
    if not depths:
        return
    name = folder_name(sequence)
    images = (previous.rgb, current.rgb)
    frames_shown = {f"frame {frame.index}": frame.rgb for frame in (previous, current)}
    draw_depth_change(frames_shown, tissue, depths, folder / f"depth_change_{name}.png")
    yield folder / f"depth_change_{name}.png"
    posed = {method: poses for method, poses in own_poses.items() if poses is not None}
    if posed:
        clouds = {method: _clouds(images, depths[method], poses, frames.camera) for method, poses in posed.items()}
        draw_registered_clouds(clouds, folder / f"clouds_{name}.png", where=_WORLD["estimated"])
        yield folder / f"clouds_{name}.png"
    matcher = FrameMatcher(frames.camera)
    matcher.match(previous.rgb, previous.valid)
    correspondence = matcher.match(current.rgb, current.valid)
    if correspondence is None:
        return
    where = "estimated" if T_previous is None or T_current is None else "reference"
    if T_previous is not None and T_current is not None:
        posed = dict.fromkeys(depths, (T_previous, T_current))
    if posed:
        points = {
            method: lifted_matches(correspondence.matches, *depths[method], frames.camera, poses)[:2]
            for method, poses in posed.items()
        }
        pictures.draw_matched_points(points, folder / f"orb_points_{name}.png", where=_WORLD[where])
        yield folder / f"orb_points_{name}.png"
        apart_mm = {method: np.linalg.norm(before - now, axis=1) for method, (before, now) in points.items()}
        file, bar = folder / f"orb_bars_{name}.png", f"matched point of frames {previous.index} and {current.index}"
        pictures.draw_displacements(apart_mm, file, bar=bar, where=_WORLD[where])
        yield file


def _poses_of(run: FinishedRun, indices: tuple[int, int], scale: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a run's poses (4, 4) of two frames, their translations scaled as its depth; None where one is lost."""
    trajectory = read_trajectory(run.folder)
    poses = [trajectory.T_world_camera[(trajectory.indices == index) & trajectory.tracked] for index in indices]
    if not all(len(found) for found in poses):
        return None
    first, second = (se3(found[0, :3, :3], scale * found[0, :3, 3]) for found in poses)
    return first, second


def _clouds(
    images: tuple[np.ndarray, np.ndarray],
    depths_mm: tuple[np.ndarray, np.ndarray],
    poses: tuple[np.ndarray, np.ndarray],
    camera: PinholeCamera,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (N, 3) of both frames, mm, in the camera of the first, and their colours (N, 3) uint8."""
    known = [np.isfinite(depth) for depth in depths_mm]
    local = [(camera.rays * depth[..., None])[k] for depth, k in zip(depths_mm, known, strict=True)]
    points = np.concatenate([local[0], transform(inverse(poses[0]) @ poses[1], local[1])])
    return points, np.concatenate([image[k] for image, k in zip(images, known, strict=True)])


def frame_pair(frames: Frames, wanted: int | None) -> list[tuple[Frame, np.ndarray | None]]:
    """Return the frame of number `wanted` (None: in the middle) after the one before it, each with its true pose.

    They are masked as for the measures.
    """
    stamps = frames.source.stamps(frames.selection) or []
    masker = Masker(MaskSettings())
    last: list[tuple[Frame, np.ndarray | None]] = []
    for place, frame in enumerate(frames.frames()):
        last = [*last[-1:], (masker(frame), frames.source.pose(frame.index))]
        if place and (place > len(stamps) // 2 if wanted is None else frame.index >= wanted):
            break
    if len(last) < 2 or wanted not in (None, last[-1][0].index):
        raise InputError(f"drawing frame {wanted} of {frames.path} and the one before: it has no such frames")
    return last


def _draw_mesh(run: FinishedRun, frames: Frames, file: Path) -> bool:
    """Draw a run's mesh with its camera path, and the true one where it is known; False where there is no mesh."""
    mesh, reference = read_mesh(run.folder / "mesh.ply"), reference_trajectory(frames)
    if not len(mesh.faces):
        return False
    estimate = read_trajectory(run.folder)
    if reference is None:
        tracked, poses = estimate.tracked, estimate.T_world_camera
        true_mm, T_view = None, poses[np.argmax(tracked)]
    else:
        try:
            matched = match(estimate, reference, run.result.figures["poses"].get("align", "sim3"))
        except AlignmentError:
            return False
        mesh.vertices = matched.similarity.transform_points(np.asarray(mesh.vertices))
        tracked, poses = matched.tracked, matched.aligned
        true_mm, T_view = matched.reference[:, :3, 3], matched.reference[0]
    positions_mm = np.where(tracked[:, None], poses[:, :3, 3], np.nan)
    draw_reconstruction(mesh, positions_mm, true_mm, file, T_view, run.figure.zoom)
    return True


def compare(
    paths: Sequence[Path],
    truth: Path | None,
    protocol: ProtocolPlan,
    *,
    names: Sequence[str] = (),
    unit: Unit | None = None,
) -> list[FinishedRun]:
    """Return the figures of each run's folder, benchmark's run or trajectory file against `truth`.

    A benchmark's run (a folder with result.json) brings its figures. The others are measured: against a data set's
    folder with their mesh and depth, against a trajectory file by their poses. `names` are by default those of the
    folders, `unit` is that of files that state none. Raises `InputError`, also where `truth` is needed.
    """
    if names and len(names) != len(paths):
        raise InputError(f"comparing {len(paths)} runs: {len(names)} names were given")
    runs = []
    for path, name in zip(paths, names or [""] * len(paths), strict=True):
        if (path / FILE_NAME).is_file():
            runs.append(_of_benchmark(path, name, protocol))
        elif truth is None:
            raise InputError(f"comparing {path}: name the true poses by --truth, or give two runs")
        else:
            runs.append(_scored(path, name or path.resolve().name, truth, protocol, unit))
    counts = Counter((run.result.sequence, run.result.method, run.result.seed) for run in runs)
    (sequence, method, _), count = counts.most_common(1)[0]
    if count > 1:
        raise InputError(f"comparing {count} runs that are all called '{method}' on '{sequence}': name them by --names")
    return runs


def _of_benchmark(path: Path, name: str, protocol: ProtocolPlan) -> FinishedRun:
    result = RunResult.load(path)
    if protocol.consistency and "consistency" not in result.figures and result.status == "done":
        raise InputError(f"comparing {path}: its benchmark measured no consistency; its figures are not measured again")
    result = replace(result, method=name or result.method)
    if not (path / ENTRY).is_file():
        return FinishedRun(result, path / "run")
    entry = Entry.load(path / ENTRY)
    return FinishedRun(result, path / "run", entry.open, entry.sequence.figure)


def _scored(path: Path, name: str, truth: Path, protocol: ProtocolPlan, unit: Unit | None) -> FinishedRun:
    if not path.exists():
        raise InputError(f"comparing {path}: no such file or folder")
    sequence = truth.stem if truth.is_file() else truth.resolve().name
    # A part is a sequence of its own: its frames are all it could track, and a shorter path has smaller errors.
    sequence = ", ".join(filter(None, (sequence, _part(path))))
    result = RunResult(sequence, name, timing=_timing(path))
    frames = _frames(path, truth)
    if frames is not None:
        usual = default_protocol(frames).depth_range_mm
        figures = score(path, frames, protocol.model_copy(update={"depth_range_mm": usual}))
        facts = {"input": str(path), "doubts": _doubts(read_trajectory(path), reference_trajectory(frames), protocol)}
        return FinishedRun(replace(result, figures=figures, facts=facts), path, lambda: frames)
    estimate, reference = read_trajectory(path, unit=unit), read_reference(truth, unit=unit)
    if reference is None:
        raise InputError(f"comparing {path}: {truth} has no true poses")
    figures = pose_groups(estimate, reference, protocol, protocol.align)[0]
    facts = {"input": str(path), "convention": estimate.source, "doubts": _doubts(estimate, reference, protocol)}
    return FinishedRun(replace(result, figures=figures, facts=facts), path)


def _doubts(estimate: Trajectory, reference: Trajectory | None, protocol: ProtocolPlan) -> list[str]:
    """Return in sentences how else the trajectories could be read; [] where they cannot be aligned."""
    if reference is None:
        return []
    try:
        return doubts(estimate, reference, match(estimate, reference, protocol.align))
    except AlignmentError:
        return []


def _frames(path: Path, truth: Path) -> Frames | None:
    """Return the frames of the truth's data set at the size of a run; None for poses alone on either side."""
    if not (path / "frames.csv").is_file() or not truth.is_dir() or (truth / "frames.csv").is_file():
        return None
    try:
        return open_truth(path, truth)
    except InputError:  # a folder of poses without images
        return None


def _part(path: Path) -> str:
    """Return which part of its input a run used, in words; "" for all of it, and for trajectory files."""
    try:
        return part_of_input(Result(path).provenance)
    except (InputError, ValueError, TypeError, AttributeError):
        return ""


def _timing(path: Path) -> dict[str, float]:
    """Return the times of a run's provenance; {} where there are none."""
    try:
        seconds = Result(path).provenance["seconds"].items()
        return {f"seconds_{stage.replace(' ', '_')}": float(s) for stage, s in seconds}
    except (InputError, ValueError, KeyError, TypeError, AttributeError):
        return {}
