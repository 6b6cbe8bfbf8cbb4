"""What a run will cost: its first second is run, and the rest of it is estimated from that."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from scopemap.engine.config import Config
from scopemap.input.sequence import Sequence
from scopemap.runner.with_report import reconstruct_with_report

_FEWEST = 12  # frames of the second that is run
_MOST = 60
_ENDLESS = 1 << 40
_REPORTING = "writing the report"
_PER_FRAME = "depth*/*"


@dataclass(frozen=True)
class RunCost:
    """What a run costs.

    frames : those that would be used; video_s : their time. fixed_s : before the first frame, and for the report.
    frame_s : of each frame, what comes after the last one divided among all. result_bytes : of the result.
    lens_is_assumed : whether the run may begin again with another lens.
    """

    frames: int
    video_s: float
    fixed_s: float
    frame_s: float
    result_bytes: int
    lens_is_assumed: bool

    @property
    def seconds(self) -> float:
        """Time of the run."""
        return self.fixed_s + self.frame_s * self.frames


def run_cost(whole: Sequence, part: Callable[[slice], Sequence], config: Config, folder: Path) -> RunCost | None:
    """Run the first second of a sequence in a folder, and return what all of it costs.

    None where only reading on tells the number of frames. part : returns a part of the sequence. What is written to the
    folder stays. Raises what a run does.
    """
    rate_hz, chosen = whole.source.rate_hz, whole.selection
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

    first = part(slice(start, min(stop, start + used * step), step))
    seen = (lambda step: times.append(time.perf_counter()),)
    result = reconstruct_with_report(first, config, folder, observers=seen, progress=progress)
    ended, count = time.perf_counter(), whole.used_count
    if count is None or whole.count is None:
        return None
    growing = sum(file.stat().st_size for file in folder.glob(_PER_FRAME))
    return RunCost(
        frames=count,
        video_s=whole.count * step / rate_hz,
        fixed_s=times[0] - begun + ended - written[0],
        frame_s=(times[-1] - times[0]) / max(len(times) - 1, 1) + (written[0] - times[-1]) / len(times),
        result_bytes=bytes_in(folder) + int(growing * (count / len(times) - 1)),
        lens_is_assumed=result.provenance["camera"]["origin"] == "assumed",
    )


def bytes_in(path: Path) -> int:
    """Return the size of a file, or of all files below a folder; 0 for what is not there."""
    try:
        files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
        return sum(file.stat().st_size for file in files)
    except OSError:
        return 0
