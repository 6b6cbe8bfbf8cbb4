"""Runs a plan, each entry in a process of its own, with a time limit; a second call continues an interrupted one.

OUT/runs/SEQUENCE/METHOD/{entry.json, run/, result.json, log.txt}    OUT/phantoms/    OUT/flows/    OUT/truths/

A method may use all memory, crash in foreign code or call exit: its row says so and the benchmark continues. The
process of an entry is `python -m scopemap_bench.runner ENTRY.json`, so peak memory is its own. `describe` tells what a
plan would run, without running it.
"""

from __future__ import annotations

import math
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError, ScopemapError, SettingsError
from scopemap.input.sequence import Sequence
from scopemap.runner.estimators import missing_weights
from scopemap_bench.entry import Entry, entries_of, worker_command
from scopemap_bench.forecast import measured_pace
from scopemap_bench.methods.method import Method, PipelineMethod, create_method, what_networks_lack
from scopemap_bench.plan import Plan, found_sequences, spec_of
from scopemap_bench.result import FILE_NAME, RunResult
from scopemap_bench.scoring import score

Listener = Callable[[Entry, RunResult, bool], None]


def describe(plan: Plan, out: Path, data: Path | None = None) -> Iterator[str]:
    """Yield the lines that `scopemap bench PLAN --dry-run` prints; raises as `run_plan`, but writes nothing."""
    entries, notes = planned(plan, out, data)
    lengths = {label: _length(entry) for label, entry in {entry.label: entry for entry in entries}.items()}
    pace = measured_pace()
    rows: defaultdict[str, list[str]] = defaultdict(list)
    hours: defaultdict[str, float] = defaultdict(float)
    waiting_hours: defaultdict[str, float] = defaultdict(float)
    lacking, rendered = set[str](), set[Path]()
    done = 0
    for entry in entries:
        frames, pixels, _ = lengths[entry.label]
        config, name = _config(entry), entry.method.name
        if kept_result(entry) is not None:
            done += 1
            continue
        taken = pace.seconds(config, frames, pixels, surface=entry.protocol.surface) / 3600
        if entry.sequence.phantom is not None and entry.source not in rendered and not entry.source.is_dir():
            rendered.add(entry.source)
            taken += pace.rendering_s(frames, pixels) / 3600
        if reason := what_is_missing(entry):
            rows[name].append(reason)
            waiting_hours[name] += taken
            flows = [entry.protocol.flow] * entry.protocol.consistency
            lacking |= set(missing_weights(config or Config(), *flows, verified=True))
        else:
            hours[name] += taken
    yield (
        f"{plan.title}: {len(lengths)} sequences, {sum(count for count, *_ in lengths.values())} frames, "
        f"{len(plan.method)} methods"
    )
    yield from (f"  {label}: {fault or f'{count} frames'}" for label, (count, _, fault) in lengths.items())
    yield from (f"note: {note}" for note in notes)
    yield "rows:"
    for method in dict.fromkeys(entry.method.name for entry in entries):
        expected = [_duration(hours[method])] if method in hours else []
        reasons = [*dict.fromkeys(rows[method])]
        reasons += [f"{_duration(waiting_hours[method])} when they are there"] if reasons else []
        yield f"  {method}: {'; '.join([*expected, *reasons]) or 'done'}"
    yield f"weights that are missing or damaged: {', '.join(sorted(lacking)) or 'none'}"
    waiting = sum(map(len, rows.values()))
    yield (
        f"{len(entries)} runs: {done} done, {waiting} missing, {len(entries) - done - waiting} to run in about "
        f"{_duration(sum(hours.values()))} on this machine's processors, with what is missing "
        f"{_duration(sum(hours.values()) + sum(waiting_hours.values()))}; networks take less on a GPU"
    )


def _duration(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.0f} min"


def _length(entry: Entry) -> tuple[int, int, str]:
    """Return the frames of an entry's sequence, 0 where its file does not state them, the pixels of each, and a fault.

    Pixels are those of the working size; the fault is why the sequence cannot be opened, or "".
    """
    if entry.sequence.phantom is not None:
        spec = spec_of(entry.sequence.phantom, entry.seed, entry.data)
        return spec.frames or 0, spec.width * spec.height, ""
    try:
        sequence = entry.open()
        return sequence.count or 0, sequence.camera.width * sequence.camera.height, ""
    except ScopemapError as error:
        return 0, 0, str(error)


def _config(entry: Entry) -> Config | None:
    """Return the settings of an entry's run; None for an imported trajectory, and for a run that will fail."""
    method = method_of(entry)
    with suppress(ScopemapError):
        return method.config(entry.shared_settings()) if isinstance(method, PipelineMethod) else None
    return None


@dataclass(frozen=True)
class Benchmark:
    """The entries of a plan in order, their results, and notes on both."""

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
    """Run the entries that are not done yet and return all rows.

    An entry is done when its `result.json` has its fingerprint; failed rows are run again with `retry` or where their
    input changed, those of status "missing" always. `listener` is called with each row, and whether it was kept. A
    method that takes longer than `timeout_s` is ended and fails. Raises `InputError` where no sequence is found or
    `out` cannot be written.
    """
    out = Path(out).resolve()
    entries, notes = planned(plan, out, data)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write a benchmark to {out}: {error.strerror or error}") from None
    results = []
    for entry in entries:
        kept = kept_result(entry, retry=retry)
        if kept is not None:
            results.append(kept)
        elif reason := what_is_missing(entry):
            results.append(_without_figures(entry, "missing", reason))
        else:
            results.append(_run_in_process(entry, timeout_s))
        if listener:
            listener(entry, results[-1], kept is not None)
    return Benchmark(plan, entries, results, notes + _commits_note(results))


def planned(plan: Plan, out: Path, data: Path | None = None) -> tuple[list[Entry], list[str]]:
    """Return the entries of a plan, and a note for each missing sequence; `SettingsError` for two of one folder."""
    data = None if data is None else Path(data).resolve()
    sequences, notes = found_sequences(plan, data)
    for method in plan.method:
        create_method(method, data)
    entries = list(entries_of(plan, sequences, data, out))
    folders = Counter(entry.folder for entry in entries)
    twice = next((entry.label for entry in entries if folders[entry.folder] > 1), None)
    if twice is not None:
        called = f"two sequences that are called '{twice}' (letters and digits count): give them names"
        raise SettingsError(f"the plan '{plan.title}' has {called}")
    return entries, notes


def run_entry(entry: Entry) -> RunResult:
    """Run a method on its sequence in this process, score it, and return the row; a `ScopemapError` is a failed row."""
    try:
        entry.render_phantom()
        sequence = entry.open()
        timing = method_of(entry).run(sequence, entry.shared_settings(), entry.run_folder)
        memory_mb = _peak_memory_mb()
        figures = score(entry.run_folder, sequence, entry.protocol, entry.sequence.align, entry.flows, entry.truths)
    except ScopemapError as error:
        return _without_figures(entry, "failed", str(error))
    return RunResult(
        entry.label,
        entry.method.name,
        entry.seed,
        figures=figures,
        timing=timing | {"peak_memory_mb": memory_mb},
        facts=_facts(entry) | {"truth": _quality_of_truth(sequence)},
    )


def end_with_parent() -> None:
    """End this process soon after the process that started it: nobody would read the row."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        signal.raise_signal(signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def kept_result(entry: Entry, *, retry: bool = False) -> RunResult | None:
    """Return the row of an earlier call, if it belongs to this entry; None for a failed one to be run again."""
    try:
        result = RunResult.load(entry.folder)
    except InputError:  # none, or a damaged one
        return None
    stale = result.facts.get("key") != entry.key
    if result.status == "failed":
        stale |= retry or result.facts.get("inputs") != entry.inputs
    return None if stale else result


def what_is_missing(entry: Entry) -> str:
    """Return what an entry needs and this machine does not have, in one line; "" where it can run."""
    try:
        flows = [entry.protocol.flow] * entry.protocol.consistency
        if lacking := what_networks_lack(Config(), *flows):
            return f"its measure {lacking}"
        return method_of(entry).missing(entry.shared_settings())
    except ScopemapError:  # the run reports it
        return ""


def method_of(entry: Entry) -> Method:
    """Return the method of an entry."""
    return create_method(entry.method, entry.data, entry.sequence.name, entry.seed)


def _run_in_process(entry: Entry, timeout_s: float | None) -> RunResult:
    """Run an entry in a process of its own and return its row, whatever happens to the process."""
    (entry.folder / FILE_NAME).unlink(missing_ok=True)
    shutil.rmtree(entry.run_folder, ignore_errors=True)
    command, log = worker_command(entry.save()), entry.folder / "log.txt"
    with log.open("w", encoding="utf-8") as output:
        try:
            code = subprocess.run(  # noqa: S603 - this program, its arguments a list
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, timeout=timeout_s
            ).returncode
            error = _cause(code, log) if code else "ended without a result"
        except subprocess.TimeoutExpired:
            error = f"took longer than {timeout_s:g} s"
    # A saved row is valid even if foreign code crashed at the end of the process.
    if not (entry.folder / FILE_NAME).is_file():
        _without_figures(entry, "failed", error).save(entry.folder)
    return RunResult.load(entry.folder)


def _cause(code: int, log: Path) -> str:
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    return lines[-1][:300] if lines else f"ended with exit code {code}"


def _without_figures(entry: Entry, status: Literal["failed", "missing"], reason: str) -> RunResult:
    facts = _facts(entry) | ({"inputs": entry.inputs} if status == "failed" else {})
    return RunResult(entry.label, entry.method.name, entry.seed, status, reason, facts=facts)


def _facts(entry: Entry) -> dict[str, Any]:
    """Return where and with what an entry is run."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {
        "key": entry.key,
        "align": entry.sequence.align or entry.protocol.align,
        "depth": _depth_of(entry),
        "versions": {name: version(name) for name in ("scopemap", "numpy", "onnxruntime", "numba")},
        "commit": source_commit(),
        "machine": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, {cores} cores",
    }


def _depth_of(entry: Entry) -> str:
    """Return the depth that an entry's settings name and its anchor; "" for an import."""
    method = method_of(entry)
    if not isinstance(method, PipelineMethod):
        return ""
    if entry.sequence.depth:
        return entry.sequence.depth.partition(":")[0]
    depth = method.config(entry.settings | entry.sequence.settings).depth
    anchor = "" if depth.anchor in ("auto", depth.backend) else f", anchor {depth.anchor}"
    return depth.backend.partition(":")[0] + anchor


def _quality_of_truth(sequence: Sequence) -> str:
    """Return the source of the true poses ("exact", "kinematic", ...), "" where there are none."""
    source, stamps = sequence.source, sequence.source.stamps(sequence.selection)
    # Depth of a frame may take an archive's decompression to read.
    known = stamps and (source.pose(stamps[0][0]) is not None or source.truth(stamps[0][0]) is not None)
    return source.quality if known else ""


def _peak_memory_mb() -> float:
    """Return the peak memory of this process, MB; NaN where the system does not report it."""
    try:
        import resource
    except ImportError:  # not on Windows
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def source_commit() -> str:
    """Return the commit of the source tree of this package, "+" where it was changed; "" where it is in none."""
    try:
        # The package may be installed inside another project's repository, whose commits are unrelated.
        _git("ls-files", "--error-unmatch", Path(__file__).name)
        return _git("describe", "--always", "--abbrev=10", "--dirty=+", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(*arguments: str) -> str:
    folder = Path(__file__).resolve().parent
    command = ["git", *arguments]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)  # noqa: S603 - constants
    return ran.stdout.strip()


def _commits_note(results: list[RunResult]) -> list[str]:
    """Return a note where rows come from different commits: their figures do not compare."""
    commits = sorted({str(result.facts.get("commit", "")) for result in results} | {source_commit()})
    if len(commits) < 2:
        return []
    return [f"rows come from different commits of scopemap ({', '.join(commits)}); a new --out folder runs all again"]


if __name__ == "__main__":
    end_with_parent()
    given = Entry.load(Path(sys.argv[1]))
    run_entry(given).save(given.folder)
