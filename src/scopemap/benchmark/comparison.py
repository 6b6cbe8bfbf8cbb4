"""Finished runs and other people's trajectories side by side, without a plan: the work behind `scopemap compare`."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scopemap.benchmark.plan import ProtocolPlan
from scopemap.benchmark.presentation import Shown
from scopemap.benchmark.result import FILE_NAME, RunResult
from scopemap.benchmark.scoring import pose_groups, score, working_size
from scopemap.benchmark.worker import RUN
from scopemap.datasets import Sequence as Frames
from scopemap.datasets import open_sequence
from scopemap.errors import InputError
from scopemap.trajectory import Trajectory, Unit, read_trajectory


def compared(
    places: Sequence[Path], truth: Path | None, protocol: ProtocolPlan, *, names: Sequence[str] = (), unit: Unit = "mm"
) -> list[Shown]:
    """Return a row for each run's folder, benchmark's run or trajectory file, scored against `truth`.

    A benchmark's run (a folder with result.json) brings its figures; the others are measured here: against a data set's
    folder with their mesh and depth, against a trajectory file by their poses. `names` are for the table, by default
    those of the folders. `unit` is that of files that state none. Raises `InputError`, also where `truth` is needed.
    """
    if names and len(names) != len(places):
        raise InputError(f"comparing {len(places)} runs: {len(names)} names were given")
    rows = []
    for place, name in zip(places, names or _short_names(places), strict=True):
        if (place / FILE_NAME).is_file():
            rows.append(Shown(RunResult.load(place), place / RUN))
        elif truth is None:
            raise InputError(f"comparing {place}: name the true poses by --truth; only a benchmark's runs bring theirs")
        else:
            rows.append(_scored(place, name, truth, protocol, unit))
    return rows


def _scored(place: Path, name: str, truth: Path, protocol: ProtocolPlan, unit: Unit) -> Shown:
    if not place.exists():
        raise InputError(f"comparing {place}: no such file or folder")
    frames = _frames(place, truth)
    if frames is not None and (place / "frames.csv").is_file():
        figures = score(place, frames, protocol)
        return Shown(_result(place, truth.name, name, figures), place, lambda: frames)
    estimate, reference = read_trajectory(place, unit=unit), read_trajectory(truth, unit=unit)
    figures = pose_groups(estimate, reference, protocol, protocol.align)[0]
    return Shown(_result(place, truth.stem, name, figures, estimate), place)


def _frames(place: Path, truth: Path) -> Frames | None:
    """Return the frames of the truth's data set at the size of the run; None where the truth is poses alone."""
    if not truth.is_dir() or (truth / "frames.csv").is_file():
        return None
    run = (place / "provenance.json").is_file()
    return open_sequence(truth, size=working_size(place) if run else None)


def _result(
    place: Path, sequence: str, name: str, figures: dict[str, dict[str, Any]], estimate: Trajectory | None = None
) -> RunResult:
    facts = {"input": str(place)} | ({"convention": estimate.source} if estimate is not None else {})
    return RunResult(sequence, name, figures=figures, timing=_timing(place), facts=facts)


def _timing(place: Path) -> dict[str, float]:
    """Return what a run's provenance says of its time."""
    try:
        provenance = json.loads((place / "provenance.json").read_text(encoding="utf-8"))
        seconds, frames = provenance["seconds"], provenance["frames"]
        stages = {f"seconds_{stage.replace(' ', '_')}": float(value) for stage, value in seconds.items()}
        return {"ms_per_frame": 1e3 * float(seconds["total"]) / frames, **stages}
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        return {}


def _short_names(places: Sequence[Path]) -> list[str]:
    """Return the folders' own names, with their parents' where two are the same."""
    names = [place.resolve().name for place in places]
    count = Counter(names)
    pairs = zip(places, names, strict=True)
    return [name if count[name] == 1 else f"{place.resolve().parent.name}/{name}" for place, name in pairs]
