"""Scores finished runs and trajectories of other systems side by side, without a plan, for `scopemap compare`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from scopemap.actions.inputs import open_truth
from scopemap.errors import InputError
from scopemap.io.reference import read_reference
from scopemap.io.run_folder import RunFolder
from scopemap.io.sequence import Sequence as Frames
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap.trajectory.trajectory import Unit
from scopemap_bench.entry import FILE_NAME as ENTRY
from scopemap_bench.entry import Entry
from scopemap_bench.figures import FinishedRun
from scopemap_bench.plan import ProtocolPlan
from scopemap_bench.result import FILE_NAME, RunResult
from scopemap_bench.scoring import default_protocol, pose_groups, score


def compare(
    paths: Sequence[Path], truth: Path | None, protocol: ProtocolPlan, *, names: Sequence[str] = (), unit: Unit = "mm"
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
            raise InputError(f"comparing {path}: name the true poses by --truth; only a benchmark's runs bring theirs")
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
    entry = Entry.load(path / ENTRY) if (path / ENTRY).is_file() else None
    return FinishedRun(result, path / "run", entry.open if entry else None)


def _scored(path: Path, name: str, truth: Path, protocol: ProtocolPlan, unit: Unit) -> FinishedRun:
    if not path.exists():
        raise InputError(f"comparing {path}: no such file or folder")
    result = RunResult(truth.stem if truth.is_file() else truth.resolve().name, name, timing=_timing(path))
    facts = {"input": str(path)}
    frames = _frames(path, truth)
    if frames is not None:
        usual = default_protocol(frames).depth_range_mm
        figures = score(path, frames, protocol.model_copy(update={"depth_range_mm": usual}))
        return FinishedRun(replace(result, figures=figures, facts=facts), path, lambda: frames)
    estimate, reference = read_trajectory(path, unit=unit), read_reference(truth, unit=unit)
    if reference is None:
        raise InputError(f"comparing {path}: {truth} has no true poses")
    figures = pose_groups(estimate, reference, protocol, protocol.align)[0]
    return FinishedRun(replace(result, figures=figures, facts=facts | {"convention": estimate.source}), path)


def _frames(path: Path, truth: Path) -> Frames | None:
    """Return the frames of the truth's data set at the size of a run; None for poses alone on either side."""
    if not (path / "frames.csv").is_file() or not truth.is_dir() or (truth / "frames.csv").is_file():
        return None
    try:
        return open_truth(path, truth)
    except InputError:  # a folder of poses without images
        return None


def _timing(path: Path) -> dict[str, float]:
    """Return the times of a run's provenance; {} where there are none."""
    try:
        seconds = RunFolder(path).provenance["seconds"].items()
        return {f"seconds_{stage.replace(' ', '_')}": float(s) for stage, s in seconds}
    except (InputError, ValueError, KeyError, TypeError, AttributeError):
        return {}
