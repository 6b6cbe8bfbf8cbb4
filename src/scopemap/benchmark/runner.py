"""Runs a plan: every entry in a process of its own, resumable, and a method that dies is a row that says so.

OUT/plan.json    OUT/runs/SEQUENCE/METHOD/{entry.json, run/, result.json, log.txt}    OUT/phantoms/
OUT/tables/      OUT/figures/     OUT/results.md
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from scopemap.benchmark.entry import Entry, entries_of
from scopemap.benchmark.methods.registry import create_method
from scopemap.benchmark.plan import Plan, found_sequences
from scopemap.benchmark.result import FILE_NAME, RunResult
from scopemap.benchmark.worker import RUN, failed, source_commit
from scopemap.errors import InputError, SettingsError

Listener = Callable[[Entry, RunResult, bool], None]


@dataclass(frozen=True)
class Benchmark:
    """What a plan gave: its entries in order with their results, and what there is to say of them."""

    plan: Plan
    entries: list[Entry]
    results: list[RunResult]
    notes: list[str]


def run_plan(
    plan: Plan,
    out: Path,
    *,
    data: Path | None = None,
    retry: bool = False,
    listener: Listener | None = None,
    timeout_s: float | None = None,
) -> Benchmark:
    """Run what is not done yet and return all rows.

    A row is done when its `result.json` bears the fingerprint of the entry: settings, sequence, method, protocol, seed.
    Failed rows are kept, too, unless `retry`. `listener` is told of each row, and whether it was there already.
    `timeout_s` ends a method that takes longer; it fails.

    Raises `InputError` where no sequence is there or `out` cannot be written.
    """
    out = Path(out).resolve()
    sequences, notes = found_sequences(plan, None if data is None else Path(data).resolve())
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write a benchmark to {out}: {error.strerror or error}") from None
    results, entries = [], list(entries_of(plan, sequences, None if data is None else Path(data).resolve(), out))
    _check(plan, entries, data)
    for entry in entries:
        known = _known(entry, retry=retry)
        result = known or _isolated(entry, timeout_s)
        results.append(result)
        if listener:
            listener(entry, result, known is not None)
    return Benchmark(plan, entries, results, notes + _mixed(results))


def _check(plan: Plan, entries: list[Entry], data: Path | None) -> None:
    """Raise `SettingsError` before anything runs for what would fail in every row, or let rows overwrite each other."""
    for method in plan.method:
        create_method(method, data)
    folders = Counter(entry.folder for entry in entries)
    for entry in entries:
        if folders[entry.folder] > 1:
            raise SettingsError(
                f"the plan '{plan.title}' has two sequences that are called '{entry.label}' (letters and digits "
                "count): give them names"
            )


def _known(entry: Entry, *, retry: bool) -> RunResult | None:
    """Return the row that an earlier run of the plan left, if it is this one."""
    try:
        result = RunResult.load(entry.folder)
    except InputError:  # none, or a damaged one
        return None
    stale = result.facts.get("key") != entry.key or (retry and result.status == "failed")
    return None if stale else result


def _isolated(entry: Entry, timeout_s: float | None) -> RunResult:
    """Run an entry in a process of its own; whatever becomes of it, there is a row."""
    (entry.folder / FILE_NAME).unlink(missing_ok=True)
    # What an interrupted run left would be refused, or be taken for this one's.
    shutil.rmtree(entry.folder / RUN, ignore_errors=True)
    file = entry.save()
    log = entry.folder / "log.txt"
    with log.open("w", encoding="utf-8") as output:
        code = _run_worker(file, output, timeout_s)
    # A row that was saved stands, even if foreign code crashed while the process came to its end.
    if (entry.folder / FILE_NAME).is_file():
        return RunResult.load(entry.folder)
    fault = f"took longer than {timeout_s:g} s" if code is None else "" if code == 0 else _cause(code, log)
    result = failed(entry, fault or "ended without a result")
    result.save(entry.folder)
    return result


def worker_command(file: Path) -> list[str]:
    """Return the command that runs the entry in `file`."""
    return [sys.executable, "-m", "scopemap.benchmark.worker", str(file)]


def _run_worker(file: Path, output: TextIO, timeout_s: float | None) -> int | None:
    """Return the worker's exit code, None where it had to be ended; it ends by itself when this process does."""
    # The open end of this pipe is how the worker knows that somebody still waits for it.
    with subprocess.Popen(
        worker_command(file), stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT
    ) as worker:
        try:
            return worker.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if worker.poll() is None:
                worker.kill()


def _cause(code: int, log: Path) -> str:
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
        return f"killed by {name}"
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1][:300] if lines else f"ended with exit code {code}"


def _mixed(results: list[RunResult]) -> list[str]:
    """Say so where rows were made by other code than this: figures of two commits are no comparison."""
    commits = sorted({str(result.facts.get("commit", "")) for result in results} | {source_commit()})
    if len(commits) < 2:
        return []
    return [f"rows come from different commits of scopemap ({', '.join(commits)}); a new --out folder redoes all"]
