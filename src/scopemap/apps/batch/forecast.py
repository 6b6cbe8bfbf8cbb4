"""What a batch will cost: one second of each video is run, and the rest of it is estimated from that."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from scopemap.apps.batch.batch import LOGS, Video, log_to
from scopemap.apps.batch.engines import Engine
from scopemap.engine.errors import reporting
from scopemap.input.inputs import RemoteFile
from scopemap.runner.forecast import RunCost, bytes_in, run_cost
from scopemap.runner.processes import ProcessLimits, run_in_processes


@dataclass(frozen=True)
class Forecast:
    """What running a video costs.

    fault : why its first second could not be run, or "". input_bytes : of its file or folder. cost : with one process;
    None where the number of frames is unknown, or the second failed.
    """

    name: str
    fault: str
    input_bytes: int
    cost: RunCost | None


@dataclass(frozen=True)
class _ForecastTask:
    video: Video
    out: Path


def forecast(
    videos: Sequence[Video],
    out: Path,
    limits: ProcessLimits,
    on_change: Callable[[Forecast, int], None] = lambda one, left: None,
    engine: Engine = run_in_processes,
) -> list[Forecast]:
    """Return the forecast of each video; what is written meanwhile is removed.

    engine : what runs their first seconds. on_change : called with each as it is found, and how many are left. Raises
    `InputError` where `out` cannot be written, and what the engine does.
    """
    is_new, found = not out.exists(), dict[int, Forecast]()
    with reporting(f"cannot write to {out}"):
        out.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".dry-run-", dir=out)).absolute()
        (folder / LOGS).mkdir()
    try:
        for number, outcome in engine(_measure, [_ForecastTask(video, folder) for video in videos], limits):
            video = videos[number]
            video.forget_fetched(folder)
            found[number] = Forecast(video.name, outcome.fault, _bytes(video.path), outcome.value)
            on_change(found[number], len(videos) - len(found))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if is_new:
            out.rmdir()
    return [found[number] for number in sorted(found)]


def _measure(task: _ForecastTask) -> RunCost | None:
    """Run the first second of a video, and return what all of it costs, as `scopemap run --dry-run` does."""
    log_to(task.out / LOGS / f"{task.video.name}.txt")
    video = task.video.fetched(task.out)
    return run_cost(video.open(), video.open, video.config, task.out / video.name)


def _bytes(path: Path | RemoteFile) -> int:
    return path.size or 0 if isinstance(path, RemoteFile) else bytes_in(path)
