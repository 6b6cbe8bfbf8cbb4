"""The rules of the CLiMB challenge for a submission, beyond its own self-check all that its evaluation relies on.

Source: EndoCartoScope/climb-challenge at 79d7435, submission_instructions/README.md, evaluation/validate_submission.py
and slam_utils.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from scopemap.errors import InputError
from scopemap.trajectory.formats.text import text_lines
from scopemap_bench.climb.submission import RUNS, RUNTIME_KEYS
from scopemap_bench.trajectories.climb import read_submap


def submission_problems(submission: Path, videos: Path | None = None) -> list[str]:
    """Return what breaks the rules, one sentence each; none for a submission that is valid.

    videos : folder of the `*.mp4` that must have been processed; without it the clips are the folders that are there.
    """
    clips = _folders(submission) if videos is None else sorted(file.stem for file in videos.glob("*.mp4"))
    if not clips:
        return [f"{videos or submission}: no clip"]
    return [problem for clip in clips for problem in _clip_problems(submission / clip)]


def _clip_problems(clip: Path) -> Iterator[str]:
    runs = _folders(clip)
    # The evaluation takes every folder for a run; a clip with one that it cannot read does not enter the mean.
    yield from (f"{clip / name}: not a run, which are 1 to {len(RUNS)}" for name in runs if name not in RUNS)
    for name in RUNS:
        yield from _run_problems(clip / name) if name in runs else [f"{clip / name}: missing"]


def _run_problems(run: Path) -> Iterator[str]:
    maps, trajectories = run / "3D_maps", run / "camera_trajectory"
    checks: list[tuple[Callable[[Path], object], Path]] = [(_check_runtime, run / "runtime.txt")]
    names, expected = _folders(maps), set[Path]()
    if not names:
        yield f"{maps}: no map"
    for name in names:
        if not (name.isascii() and name.isdecimal()):
            yield f"{maps / name}: the name of a map must be an integer"
            continue
        file = trajectories / f"cam_traj_map_{int(name):03d}.txt"
        if file in expected:
            yield f"{maps / name}: another map has this number"
        expected.add(file)
        checks += [(_check_points, maps / name / "points3D.txt"), (read_submap, file)]
    unpaired = sorted({*trajectories.glob("cam_traj_map_*")} - expected)
    yield from (f"{file}: no map in 3D_maps has this number of three digits" for file in unpaired)
    for check, file in checks:
        try:
            check(file)
        except InputError as error:
            yield str(error)


def _check_runtime(file: Path) -> None:
    lines = [line.replace(" ", "") for line in text_lines(file)]
    for key in RUNTIME_KEYS:
        if not any(re.fullmatch(rf"{key}=\d+(\.\d+)?(e[-+]?\d+)?", line) for line in lines):
            raise InputError(f"{file}: expected a line {key}=<seconds>")


def _check_points(file: Path) -> None:
    """Raise `InputError` unless the file holds points, `POINT3D_ID X Y Z R G B ERROR`, with different numbers."""
    numbers = set()
    for line_number, line in enumerate(text_lines(file), start=1):
        if line.startswith("#"):
            continue
        fields = line.split()
        try:
            number, colour = int(fields[0]), [int(field) for field in fields[4:7]]
            finite = all(math.isfinite(float(field)) for field in (*fields[1:4], fields[7]))
        except (IndexError, ValueError):
            finite = False
        if not finite or not all(0 <= value <= 255 for value in colour) or number in numbers:
            raise InputError(f"{file}, line {line_number}: expected POINT3D_ID X Y Z R G B ERROR, each number once")
        numbers.add(number)
    if not numbers:
        raise InputError(f"{file}: no point; the evaluation breaks off at a map without any")


def _folders(path: Path) -> list[str]:
    return sorted(folder.name for folder in path.iterdir() if folder.is_dir()) if path.is_dir() else []
