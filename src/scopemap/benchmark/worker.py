"""Runs and scores one entry, in a process of its own: `python -m scopemap.benchmark.worker ENTRY.json`.

A method may take all memory, crash in foreign code or call exit: the benchmark goes on, and peak memory is its own.
"""

from __future__ import annotations

import math
import os
import platform
import signal
import subprocess
import sys
import threading
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scopemap.benchmark.entry import Entry, render_phantom
from scopemap.benchmark.methods.method import Task, Timing
from scopemap.benchmark.methods.registry import create_method
from scopemap.benchmark.result import RunResult
from scopemap.benchmark.scoring import score
from scopemap.errors import ScopemapError
from scopemap.io.sequence import Sequence

RUN = "run"


def run_entry(entry: Entry) -> RunResult:
    """Run a method on its sequence, score it, and return the row; a known error makes a failed row.

    The run's folder is `entry.folder / "run"`. Whatever is no `ScopemapError` is raised: the caller isolates.
    """
    try:
        render_phantom(entry)
        sequence = entry.open()
        method = create_method(entry.method, entry.data)
        task = Task(sequence, entry.shared_settings(), entry.seed, entry.sequence.name)
        timing = method.run(task, entry.folder / RUN)
        memory_mb = peak_memory_mb()
        figures = score(entry.folder / RUN, sequence, entry.protocol, entry.sequence.align, entry.flows)
    except ScopemapError as error:
        return failed(entry, str(error))
    return RunResult(
        entry.label,
        entry.method.name,
        entry.seed,
        figures=figures,
        timing=_timing(timing) | {"peak_memory_mb": memory_mb},
        facts=facts_of(entry) | {"truth": quality_of_truth(sequence)},
    )


def failed(entry: Entry, error: str) -> RunResult:
    """Return the row of a method that died."""
    return RunResult(entry.label, entry.method.name, entry.seed, "failed", error, facts=facts_of(entry))


def facts_of(entry: Entry) -> dict[str, Any]:
    """Return where and with what an entry is run."""
    return {
        "key": entry.key,
        "align": entry.sequence.align or entry.protocol.align,
        "versions": {name: version(name) for name in ("scopemap", "numpy", "torch", "numba")},
        "commit": source_commit(),
        "machine": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, {_cores()} cores",
    }


def quality_of_truth(sequence: Sequence) -> str:
    """Return how the truth of a sequence came about ("exact", "kinematic", ...), "" where there is none."""
    stamps = sequence.source.stamps(sequence.selection)
    truth = sequence.source.truth(stamps[0][0]) if stamps else None
    return truth.quality if truth else ""


def source_commit() -> str:
    """Return the commit of the source tree that this package runs from, "+" where it was changed; "" outside one."""
    folder = Path(__file__).resolve().parent
    try:
        # An environment may lie in some other repository, whose commits say nothing of this.
        _git(folder, "ls-files", "--error-unmatch", Path(__file__).name)
        head = _git(folder, "rev-parse", "--short=10", "HEAD")
        return head + ("+" if _git(folder, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def peak_memory_mb() -> float:
    """Return the most memory that this process held so far, MB; NaN where the system does not say."""
    try:
        import resource
    except ImportError:  # not on Windows
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _timing(timing: Timing) -> dict[str, float]:
    stages = {f"seconds_{stage.replace(' ', '_')}": seconds for stage, seconds in timing.seconds.items()}
    return {"ms_per_frame": timing.ms_per_frame, "track_ms_per_frame": timing.track_ms_per_frame, **stages}


def end_with_parent() -> None:
    """End this process when the benchmark that started it is gone: nobody would read the row."""

    def wait() -> None:
        sys.stdin.read()
        signal.raise_signal(signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    given = Entry.load(Path(sys.argv[1]))
    run_entry(given).save(given.folder)
