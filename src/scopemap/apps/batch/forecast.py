"""What a batch will cost: one second of each video is run, and the rest of it is estimated from that."""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scopemap.apps.batch.batch import LOGS, Video, log_to
from scopemap.apps.batch.engines import Engine
from scopemap.engine.errors import reporting
from scopemap.input.inputs import RemoteFile
from scopemap.runner.processes import ProcessLimits, run_in_processes
from scopemap.runner.with_report import reconstruct_with_report

_FEWEST = 12  # frames of the second that is run
_MOST = 60
_ENDLESS = 1 << 40
_REPORTING = "writing the report"
_PER_FRAME = "depth*/*"


@dataclass(frozen=True)
class Forecast:
    """What running a video costs.

    fault : why its first second could not be run, or "". frames : those that would be used, None where only reading on
    tells. video_s : their time. input_bytes : of its file or folder. seconds, result_bytes : estimated for all frames,
    with one process; None where the number of frames is unknown, or the second failed.
    """

    name: str
    fault: str = ""
    frames: int | None = None
    video_s: float | None = None
    input_bytes: int = 0
    seconds: float | None = None
    result_bytes: int | None = None


@dataclass(frozen=True)
class _Part:
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
        for number, outcome in engine(_measure, [_Part(video, folder) for video in videos], limits):
            video = videos[number]
            video.forget_fetched(folder)
            known = outcome.value or {}
            found[number] = Forecast(video.name, outcome.fault, input_bytes=_bytes(video.path), **known)
            on_change(found[number], len(videos) - len(found))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if is_new:
            out.rmdir()
    return [found[number] for number in sorted(found)]


def _measure(part: _Part) -> dict[str, Any]:
    """Run the first second of a video, and return what its forecast says."""
    log_to(part.out / LOGS / f"{part.video.name}.txt")
    video, folder = part.video.fetched(part.out), part.out / part.video.name
    whole = video.open()
    rate_hz, chosen = whole.source.rate_hz, video.frames or slice(None)
    step = chosen.step or 1
    used = min(max(math.ceil(rate_hz / step), _FEWEST), _MOST)
    if whole.source.count is not None:
        start, stop, _ = chosen.indices(whole.source.count)
    else:
        start, stop = max(chosen.start or 0, 0), chosen.stop if (chosen.stop or -1) >= 0 else _ENDLESS
    times, begun = list[float](), time.perf_counter()
    written = [begun]

    def progress(doing: str, done: int, frames: int) -> None:
        if doing == _REPORTING:
            written[0] = time.perf_counter()

    first = video.open(slice(start, min(stop, start + used * step), step))
    seen = (lambda step: times.append(time.perf_counter()),)
    reconstruct_with_report(first, video.config, folder, observers=seen, progress=progress)
    ended, count = time.perf_counter(), whole.used_count
    if count is None or whole.count is None:
        return {}
    steady_s = (times[-1] - times[0]) / max(len(times) - 1, 1) + (written[0] - times[-1]) / len(times)
    fixed_s = times[0] - begun + ended - written[0]
    growing = sum(file.stat().st_size for file in folder.glob(_PER_FRAME))
    return {
        "frames": count,
        "video_s": whole.count * step / rate_hz,
        "seconds": fixed_s + steady_s * count,
        "result_bytes": _bytes(folder) + int(growing * (count / len(times) - 1)),
    }


def _bytes(path: Path | RemoteFile) -> int:
    """Return the size of a file, or of all files below a folder; 0 for what is not there."""
    if isinstance(path, RemoteFile):
        return path.size or 0
    try:
        files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
        return sum(file.stat().st_size for file in files)
    except OSError:
        return 0
