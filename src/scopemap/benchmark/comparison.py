"""Finished runs and other people's trajectories side by side, without a plan: the work behind `scopemap compare`."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from scopemap.benchmark.entry import FILE_NAME as ENTRY
from scopemap.benchmark.entry import Entry
from scopemap.benchmark.plan import ProtocolPlan
from scopemap.benchmark.presentation import Shown
from scopemap.benchmark.result import FILE_NAME, RunResult
from scopemap.benchmark.scoring import default_protocol, pose_groups, score
from scopemap.benchmark.truth import open_truth
from scopemap.benchmark.worker import RUN
from scopemap.errors import InputError
from scopemap.io.datasets.reference import read_reference
from scopemap.io.sequence import Sequence as Frames
from scopemap.trajectory.formats.opening import read_trajectory
from scopemap.trajectory.trajectory import Trajectory, Unit


def compared(
    places: Sequence[Path], truth: Path | None, protocol: ProtocolPlan, *, names: Sequence[str] = (), unit: Unit = "mm"
) -> list[Shown]:
    """Return a row for each run's folder, benchmark's run or trajectory file, scored against `truth`.

    A benchmark's run (a folder with result.json) brings its figures, measured by its own plan; the others are measured
    here: against a data set's folder with their mesh and depth, against a trajectory file by their poses. `names` are
    for the table, by default those of the folders. `unit` is that of files that state none. Raises `InputError`, also
    where `truth` is needed.
    """
    if names and len(names) != len(places):
        raise InputError(f"comparing {len(places)} runs: {len(names)} names were given")
    rows = []
    for place, name in zip(places, names or [""] * len(places), strict=True):
        if (place / FILE_NAME).is_file():
            rows.append(_of_benchmark(place, name, protocol))
        elif truth is None:
            raise InputError(f"comparing {place}: name the true poses by --truth; only a benchmark's runs bring theirs")
        else:
            rows.append(_scored(place, name or place.resolve().name, truth, protocol, unit))
    counts = Counter((row.result.sequence, row.result.method, row.result.seed) for row in rows)
    (sequence, method, _), count = counts.most_common(1)[0]
    if count > 1:
        raise InputError(f"comparing {count} runs that are all called '{method}' on '{sequence}': name them by --names")
    return rows


def _of_benchmark(place: Path, name: str, protocol: ProtocolPlan) -> Shown:
    """Return the row that a benchmark left; its entry, where it is still there, opens its frames."""
    result = RunResult.load(place)
    if protocol.consistency and "consistency" not in result.figures and result.status == "done":
        raise InputError(f"comparing {place}: its benchmark measured no consistency, and its figures stand")
    entry = Entry.load(place / ENTRY) if (place / ENTRY).is_file() else None
    return Shown(replace(result, method=name or result.method), place / RUN, entry.open if entry else None)


def _scored(place: Path, name: str, truth: Path, protocol: ProtocolPlan, unit: Unit) -> Shown:
    if not place.exists():
        raise InputError(f"comparing {place}: no such file or folder")
    sequence = truth.stem if truth.is_file() else truth.resolve().name
    frames = _frames(place, truth)
    if frames is not None:
        usual = default_protocol(frames).depth_range_mm
        figures = score(place, frames, protocol.model_copy(update={"depth_range_mm": usual}))
        return Shown(_result(place, sequence, name, figures), place, lambda: frames)
    estimate, reference = read_trajectory(place, unit=unit), read_reference(truth, unit=unit)
    if reference is None:
        raise InputError(f"comparing {place}: {truth} knows no true poses")
    figures = pose_groups(estimate, reference, protocol, protocol.align)[0]
    return Shown(_result(place, sequence, name, figures, estimate), place)


def _frames(place: Path, truth: Path) -> Frames | None:
    """Return the frames of the truth's data set at the size of a run; None for poses alone on either side."""
    if not (place / "frames.csv").is_file() or not truth.is_dir() or (truth / "frames.csv").is_file():
        return None
    try:
        return open_truth(place, truth)
    except InputError:  # a folder of poses without images
        return None


def _result(
    place: Path, sequence: str, name: str, figures: dict[str, dict[str, Any]], estimate: Trajectory | None = None
) -> RunResult:
    facts = {"input": str(place)} | ({"convention": estimate.source} if estimate is not None else {})
    return RunResult(sequence, name, figures=figures, timing=_timing(place), facts=facts)


def _timing(place: Path) -> dict[str, float]:
    """Return what a run's provenance says of its time."""
    try:
        provenance = json.loads((place / "provenance.json").read_text(encoding="utf-8"))
        return {f"seconds_{stage.replace(' ', '_')}": float(s) for stage, s in provenance["seconds"].items()}
    except (OSError, ValueError, KeyError, TypeError):
        return {}
