"""A run with its report: what `scopemap run` does, and `scopemap batch` with each video."""

from __future__ import annotations

from pathlib import Path

from scopemap.engine.config import Config
from scopemap.input.sequence import Sequence
from scopemap.report.frame_pictures import FramePictures
from scopemap.report.page import write_report
from scopemap.result.result import Result
from scopemap.runner.memory import share_arenas, trim_memory
from scopemap.runner.observers import Observer, Progress
from scopemap.runner.reconstruct import reconstruct


def reconstruct_with_report(
    sequence: Sequence,
    config: Config,
    out: Path,
    *,
    overwrite: bool = False,
    observers: tuple[Observer, ...] = (),
    progress: Progress = lambda doing, done, total: None,
) -> Result:
    """Write the result of a sequence to a folder, with report.html and summary.png; as `reconstruct` otherwise."""
    share_arenas()
    seen: tuple[Observer, ...] = (FramePictures(), *observers)
    result = reconstruct(sequence, config, out=out, overwrite=overwrite, observers=seen, progress=progress)
    trim_memory()
    progress("writing the report", 0, 0)
    write_report(out)
    return result
