"""Writes runs of ours as a submission to the CLiMB challenge, and checks one by its rules.

SUBMISSION/CLIP/RUN/{runtime.txt, camera_trajectory/cam_traj_map_000.txt, 3D_maps/0/points3D.txt}; a file or folder per
submap; RUN is 1 to 5. The check holds all that the evaluation relies on. Source: EndoCartoScope/climb-challenge at
79d7435, submission_instructions/README.md, evaluation/validate_submission.py and slam_utils.py.
"""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.fusion.mesh_files import read_mesh
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.input.trajectory.text import text_lines
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.input.video import VideoFile
from scopemap.result.result import Result
from scopemap.result.trajectory_folders import read_run, submap_folders
from scopemap_bench.climb.figures import climb_score
from scopemap_bench.trajectories.climb import read_submap, submap_rows, write_submap

RUNS = ("1", "2", "3", "4", "5")
RUNTIME_KEYS = ("init_seconds", "processing_seconds")
_TIMES_REAL_TIME = 5.0

# Points serve to look at: a mesh's 100,000 vertices, five times a clip, would fill a disk.
_MOST_POINTS = 20_000


def write_submission(run: Path, out: Path, clip: str = "") -> str:
    """Write the run in folder `run` as five equal runs of a clip (default: its input's name) below `out`; return its
    name.

    Raises `InputError` where `run` is no run's folder, and where one of the clip's runs is there already.
    """
    try:
        facts = Result(run).provenance
        times, clip = zip(RUNTIME_KEYS, _times_s(facts), strict=True), clip or Path(facts["input"]).stem
    except (InputError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"exporting {run}: it is not the folder of a finished run ({error})") from None
    first, *others = (out / clip / number for number in RUNS)
    try:
        _write_maps(run, first)
        (first / "runtime.txt").write_text("".join(f"{key}={time_s:.3f}\n" for key, time_s in times))
        for folder in others:
            shutil.copytree(first, folder)
    except OSError as error:
        raise InputError(f"cannot write a submission: {error.filename}: {error.strerror}") from None
    return clip


def with_score(figures: dict[str, float], run: Path, estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
    """Return the protocol's figures with "climb_score" and "climb_rotation_score", where the folder says how long its
    run took; "climb_duration_share" is that time over the clip's duration.

    The clip is as long as the frames of both trajectories, at the intervals of the estimate's time stamps. Where these
    tell no interval, the share is infinite, and W_t the largest: the challenge, which knows the clip, reads no stamps.
    """
    try:
        file = run / "runtime.txt"
        processing_s = stated_s(file)[RUNTIME_KEYS[1]] if file.is_file() else _times_s(Result(run).provenance)[1]
    except (InputError, LookupError, ValueError, TypeError, AttributeError):
        return figures
    frames = np.concatenate([one.indices for one in (estimate, *estimate.others, reference)])
    timed = [one.rows(np.isfinite(one.times_s)) for one in (estimate, *estimate.others)]
    steps_s = np.concatenate([np.diff(one.times_s) / np.diff(one.indices) for one in timed])
    frame_s = float(np.median(steps_s)) if steps_s.size else 0.0
    share = processing_s / ((np.ptp(frames) + 1) * frame_s) if frame_s > 0 else math.inf
    named = (figures["climb_ate_mean_mm"], figures["climb_rpe_40_mean_deg"], figures["climb_tfr_percent"])
    score = climb_score(*named, share)
    scores = {"climb_score": score.ate, "climb_rotation_score": score.rotation, "climb_duration_share": share}
    return figures | scores


def _times_s(facts: dict[str, Any]) -> tuple[float, float]:
    """Return a run's time before the first frame, and that up to the last pose: the mesh comes after it."""
    seconds = facts["seconds"]
    prepare_s, fuse_s = seconds.get("prepare", 0.0), seconds.get("fuse", 0.0) + seconds.get("check surface", 0.0)
    return prepare_s, seconds["total"] - prepare_s - fuse_s


def _write_maps(run: Path, folder: Path) -> None:
    submaps = read_run(run, "mm")
    folder.mkdir(parents=True)
    (folder / "camera_trajectory").mkdir()
    for number, (place, submap) in enumerate(zip(submap_folders(run), (submaps, *submaps.others), strict=True)):
        write_submap(folder / "camera_trajectory" / f"cam_traj_map_{number:03d}.txt", submap)
        file = folder / "3D_maps" / str(number) / "points3D.txt"
        file.parent.mkdir(parents=True)
        rows = _points(place / "mesh.ply", submap)
        np.savetxt(file, rows, fmt="%d %.6f %.6f %.6f %d %d %d %g", header="POINT3D_ID X Y Z R G B ERROR")


def _points(mesh_file: Path, submap: Trajectory) -> np.ndarray:
    """Return rows number x y z r g b error of the mesh's vertices; without a mesh of the camera centres."""
    points = submap.positions_mm[submap.tracked]
    colours = np.zeros(points.shape)
    mesh = read_mesh(mesh_file)
    if len(mesh.vertices):
        points, colours = mesh.vertices, vertex_colours(mesh)[:, :3]
    rows = np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).astype(np.int64)
    return np.column_stack([np.arange(1, len(rows) + 1), points[rows], colours[rows], np.zeros(len(rows))])


def submission_problems(submission: Path, videos: Path | None = None) -> list[str]:
    """Return what breaks the rules, a sentence each; `videos` holds the clips (*.mp4) that must be there, None: any.

    With `videos` the times that the runs state are held to the time limit, too.
    """
    clips = _folders(submission) if videos is None else sorted(file.stem for file in videos.glob("*.mp4"))
    if not clips:
        return [f"{videos or submission}: no clip"]
    problems = [problem for clip in clips for problem in _clip_problems(submission / clip)]
    return problems if videos is None else problems + _time_problems(submission, videos)


def _time_problems(submission: Path, videos: Path) -> list[str]:
    """Return that the runs took longer than the limit: 5 times the duration of all clips times their 5 runs.

    Equal copies of a run took its time once.
    """
    stated: set[tuple[str, float, float]] = set()
    for file in submission.glob(f"*/[{RUNS[0]}-{RUNS[-1]}]/runtime.txt"):
        with suppress(InputError):  # a problem of its own
            times = stated_s(file)
            stated.add((file.parts[-3], times[RUNTIME_KEYS[0]], times[RUNTIME_KEYS[1]]))
    took_s = sum(init_s + processing_s for _, init_s, processing_s in stated)
    limit_s = _TIMES_REAL_TIME * len(RUNS) * sum(map(_duration_s, videos.glob("*.mp4")))
    if took_s <= limit_s:
        return []
    rule = f"{_TIMES_REAL_TIME:g} times the duration of all clips times {len(RUNS)} runs, {limit_s:.0f} s"
    return [f"{submission}: its runs state {took_s:.0f} s, and the limit is {rule}; a run beyond it is aborted"]


def _duration_s(video: Path) -> float:
    """Return how long a video is, s; infinite where it cannot be told, so that no limit is."""
    with suppress(InputError):
        source = VideoFile(video)
        if source.count:
            return source.count / source.rate_hz
    return math.inf


def _clip_problems(clip: Path) -> Iterator[str]:
    runs = _folders(clip)
    # The evaluation takes every folder for a run; a clip with one that it cannot read does not enter the mean.
    yield from (f"{clip / name}: not a run, which are 1 to {len(RUNS)}" for name in runs if name not in RUNS)
    for name in RUNS:
        yield from _run_problems(clip / name) if name in runs else [f"{clip / name}: missing"]


def _run_problems(run: Path) -> Iterator[str]:
    maps, trajectories = run / "3D_maps", run / "camera_trajectory"
    checks: list[tuple[Callable[[Path], object], Path]] = [(stated_s, run / "runtime.txt")]
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
        checks += [(_check_points, maps / name / "points3D.txt"), (_check_poses, file)]
    unpaired = sorted({*trajectories.glob("cam_traj_map_*")} - expected)
    yield from (f"{file}: no map in 3D_maps has this number of three digits" for file in unpaired)
    for check, file in checks:
        try:
            check(file)
        except InputError as error:
            yield str(error)


def stated_s(file: Path) -> dict[str, float]:
    """Return the times that runtime.txt states; raises `InputError` where one is missing."""
    lines = [line.replace(" ", "") for line in text_lines(file)]
    stated = {}
    for key in RUNTIME_KEYS:
        found = [line for line in lines if re.fullmatch(rf"{key}=\d+(\.\d+)?(e[-+]?\d+)?", line)]
        if not found:
            raise InputError(f"{file}: expected a line {key}=<seconds>")
        stated[key] = float(found[0].partition("=")[2])
    return stated


def _check_poses(file: Path) -> None:
    """Raise `InputError` for what `read_submap` refuses, and for a position without a rotation.

    The challenge leaves out positions that are not finite, and averages rotations as they are.
    """
    read_submap(file)
    for _, row, place in submap_rows(file):
        if np.isfinite(row[1:4]).all() and not np.isfinite(row[4:]).all():
            raise InputError(f"{place}: a rotation is not finite; leave out the row, or all rotation errors are NaN")


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
