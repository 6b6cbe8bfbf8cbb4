"""Runs that are killed, runs whose writing fails, and a disturbed batch (`batch`).

    python -m scopemap_bench.scripts.robustness [--kills N] [--failures N] [--videos N] [--seed N]

Killed: a process that reconstructs a small phantom gets SIGKILL at a random instant and is run again, until one ends.
Writing fails: the N-th call that writes, renames or syncs raises `OSError` (a full disk), for N spread over all of
them. Each time the files of the run that follows are compared with those of an undisturbed run. A checkpoint is written
as often as there is time, where a user's run has one every ten seconds at most. Needs `fork`.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import scopemap.runner.checkpoints as checkpoints
from scopemap.engine.config import Config
from scopemap.engine.errors import ScopemapError
from scopemap.input.opening import open_sequence
from scopemap.runner.reconstruct import reconstruct
from scopemap_bench.scripts import batch, measuring

PRESETS = ("default", "realtime")
SMALL = ("--scene", "colon", "--frames", 24, "--size", "160x128")
_WRITING = ("write_bytes", "write_text", "replace", "mkdir", "open")


class Undisturbed(NamedTuple):
    """A phantom, and by preset the content of a run of it and its seconds."""

    phantom: Path
    wanted: dict[str, dict[str, bytes]]
    seconds: dict[str, float]


def start(source: Path, out: Path, preset: str, broken_call: int | None = None) -> int:
    """Begin a run in a process of its own, and return it; it ends with 0, 3 for a known error, 4 for another."""
    process = os.fork()
    if process:
        return process
    code = 4
    try:
        checkpoints._LEAST_S, checkpoints._SHARE = 0.0, 0.5
        if broken_call is not None:
            break_call(broken_call)
        reconstruct(open_sequence(source), Config.load(preset), out=out)
        code = 0
    except ScopemapError as error:
        code = 3
        print(f"   {error}", file=sys.stderr)
    finally:
        os._exit(code)


def run(source: Path, out: Path, preset: str, broken_call: int | None = None) -> int:
    """Reconstruct in a process of its own, and return its exit code."""
    return os.waitstatus_to_exitcode(os.waitpid(start(source, out, preset, broken_call), 0)[1])


def break_call(number: int) -> None:
    """Have the call of this number that writes, renames or syncs raise `OSError`."""
    count = iter(range(number))

    def breaking(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            reads = real.__name__ == "open" and not any(letter in str(arguments[1:2]) for letter in "wa+x")
            if not reads and next(count, None) is None:
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*arguments, **options)

        return call

    for name in _WRITING:
        setattr(Path, name, breaking(getattr(Path, name)))
    os.fsync = breaking(os.fsync)


def undisturbed(folder: Path) -> Undisturbed:
    """Draw the phantom and run it by each preset."""
    source, wanted, seconds = measuring.phantom(folder / "phantom", *SMALL), {}, {}
    for preset in PRESETS:
        run(source, folder / f"warm-{preset}", preset)  # compiles kernels where no cache has them
        started = time.monotonic()
        if run(source, folder / preset, preset):
            raise SystemExit(f"robustness: the undisturbed run by {preset} failed")
        seconds[preset], wanted[preset] = time.monotonic() - started, batch.content(folder / preset)
    return Undisturbed(source, wanted, seconds)


def kill_until(known: Undisturbed, out: Path, kills: int, seed: int) -> Counter[str]:
    """Return what became of runs that were killed so many times in all."""
    draw, found = random.Random(seed), Counter[str]()
    while found["kills"] < kills:
        preset = draw.choice(PRESETS)
        shutil.rmtree(out, ignore_errors=True)
        for _ in range(draw.randint(1, 6)):
            process = start(known.phantom, out, preset)
            time.sleep(draw.uniform(0.2, 1.2) * known.seconds[preset])
            if os.waitpid(process, os.WNOHANG)[0]:
                break
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            found["kills"] += 1
            if (out / "provenance.json").is_file() and batch.content(out) != known.wanted[preset]:
                found["TAKEN FOR WHOLE, BUT IS NOT"] += 1
        if not (out / "provenance.json").is_file():
            run(known.phantom, out, preset)
        found["runs"] += 1
        found["equal" if batch.content(out) == known.wanted[preset] else "NOT EQUAL"] += 1
    return found


def fail_writing(known: Undisturbed, out: Path, failures: int) -> Counter[str]:
    """Return what became of runs in which one call that writes failed."""
    found = Counter[str]()
    for n in range(failures):
        preset = PRESETS[n % 2]
        shutil.rmtree(out, ignore_errors=True)
        code = run(known.phantom, out, preset, broken_call=n if n < 20 else 20 + 3 * (n - 20))
        found[{0: "call not reached", 3: "ended with one sentence"}.get(code, f"EXIT CODE {code}")] += 1
        if (out / "provenance.json").is_file() and batch.content(out) != known.wanted[preset]:
            found["TAKEN FOR WHOLE, BUT IS NOT"] += 1
        if code:
            run(known.phantom, out, preset)
        found["equal afterwards" if batch.content(out) == known.wanted[preset] else "NOT EQUAL AFTERWARDS"] += 1
    return found


def words(counts: Counter[str]) -> str:
    """Return counts as text; what must not be is in capitals."""
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def main() -> None:
    """Disturb, compare, print; exit code 1 where something is not as it must be."""
    parser = measuring.options_of(__doc__)
    parser.add_argument("--kills", type=int, default=16)
    parser.add_argument("--failures", type=int, default=6)
    parser.add_argument("--videos", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        known = undisturbed(folder)
        killed = kill_until(known, folder / "killed", given.kills, given.seed)
        failed = fail_writing(known, folder / "failed", given.failures)
    measuring.print_head("disturbance", "what became of it")
    measuring.print_row("killed at random instants", words(killed))
    measuring.print_row("one call that writes failed", words(failed))
    print()
    all_right = batch.print_trials(given.videos, ["processes"])
    sys.exit(0 if all_right and words(killed + failed) == words(killed + failed).lower() else 1)


if __name__ == "__main__":
    main()
