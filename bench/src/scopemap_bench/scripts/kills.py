"""Runs killed at random instants, and runs whose writing fails: does the result equal that of an undisturbed one?

    python -m scopemap_bench.scripts.kills [--kills N] [--failures N] [--seed N]

A small phantom is reconstructed by the presets `default` and `realtime`. A process is killed (SIGKILL) at a random
instant, from its start to the end of its result, and run again, until one ends; then its files are compared with those
of an undisturbed run. After that the N-th call that writes, renames or syncs raises `OSError` (a full disk), for N
spread over all of them, and the run that follows is compared. Needs `fork`. A checkpoint is written as often as there
is time, where a user's run has one every five seconds at most.
"""

from __future__ import annotations

import argparse
import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scopemap.runner.checkpoints as checkpoints
from scopemap.config import Config
from scopemap.errors import ScopemapError
from scopemap.io.opening import open_sequence
from scopemap.runner.reconstruct import reconstruct

PRESETS = ("default", "realtime")
# Seconds and their checksums differ from run to run.
_OF_ITS_TIME = {"provenance.json", "SHA256SUMS"}
_WRITING = ("write_bytes", "write_text", "replace", "mkdir", "open")


def run(phantom: Path, out: Path, preset: str, broken_call: int | None = None) -> int:
    """Reconstruct in a process of its own; return what `os._exit` had: 0, 3 for a known error, 4 for another."""
    process = start(phantom, out, preset, broken_call)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def start(phantom: Path, out: Path, preset: str, broken_call: int | None = None) -> int:
    """Begin a run, and return its process."""
    process = os.fork()
    if process:
        return process
    code = 4
    try:
        checkpoints._LEAST_S, checkpoints._SHARE = 0.0, 0.5
        if broken_call is not None:
            break_call(broken_call)
        reconstruct(open_sequence(phantom), Config.load(preset), out=out)
        code = 0
    except ScopemapError as error:
        code = 3
        print(f"   {error}", file=sys.stderr)
    finally:
        os._exit(code)


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


def content(out: Path) -> dict[str, bytes]:
    """Return the files of a result by name."""
    files = [file for file in out.rglob("*") if file.is_file() and file.name not in _OF_ITS_TIME]
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


def kill_until(phantom: Path, folder: Path, wanted: dict[str, dict[str, bytes]], kills: int, seed: int) -> Counter[str]:
    """Return what became of runs that were killed so many times in all."""
    draw, found = random.Random(seed), Counter[str]()
    while found["kills"] < kills:
        preset, out = draw.choice(PRESETS), folder / "killed"
        shutil.rmtree(out, ignore_errors=True)
        most = draw.randint(1, 6)
        for _ in range(most):
            process = start(phantom, out, preset)
            time.sleep(draw.uniform(0.2, 1.2) * wanted_seconds[preset])
            if os.waitpid(process, os.WNOHANG)[0]:
                break
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)
            found["kills"] += 1
            if (out / "provenance.json").is_file() and content_without_unfinished(out) != wanted[preset]:
                found["taken for whole, but is not"] += 1
        if not (out / "provenance.json").is_file():
            code = run(phantom, out, preset)
            found[f"exit code {code}"] += 1
        found["runs"] += 1
        found["equal" if content_without_unfinished(out) == wanted[preset] else "NOT EQUAL"] += 1
        print(dict(found), flush=True)
    return found


def content_without_unfinished(out: Path) -> dict[str, bytes]:
    """Return the files of a result, without those of a run that was killed when it was in place."""
    return {name: value for name, value in content(out).items() if not name.startswith(".unfinished")}


def fail_writing(phantom: Path, folder: Path, wanted: dict[str, dict[str, bytes]], failures: int) -> Counter[str]:
    """Return what became of runs in which one call that writes failed."""
    found = Counter[str]()
    for n in range(failures):
        preset, out = PRESETS[n % 2], folder / "failed"
        shutil.rmtree(out, ignore_errors=True)
        code = run(phantom, out, preset, broken_call=n if n < 20 else 20 + 3 * (n - 20))
        found[{0: "the call was not reached", 3: "one sentence"}.get(code, f"EXIT CODE {code}")] += 1
        if (out / "provenance.json").is_file() and content_without_unfinished(out) != wanted[preset]:
            found["TAKEN FOR WHOLE, BUT IS NOT"] += 1
        if code:
            run(phantom, out, preset)
        found["equal afterwards" if content_without_unfinished(out) == wanted[preset] else "NOT EQUAL AFTERWARDS"] += 1
        print(dict(found), flush=True)
    return found


wanted_seconds: dict[str, float] = {}


def main() -> None:
    """Print counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--failures", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        phantom, wanted = folder / "phantom", {}
        ask = ("--scene", "colon", "--frames", "24", "--size", "160x128", "--quiet")
        subprocess.run([sys.executable, "-m", "scopemap", "phantom", str(phantom), *ask], check=True)
        for preset in PRESETS:
            run(phantom, folder / f"warm_{preset}", preset)  # compiles kernels where no cache has them
            started = time.monotonic()
            assert run(phantom, folder / preset, preset) == 0
            wanted_seconds[preset] = time.monotonic() - started
            wanted[preset] = content(folder / preset)
        killed = kill_until(phantom, folder, wanted, given.kills, given.seed)
        failed = fail_writing(phantom, folder, wanted, given.failures)
    print("| what | counts |\n|---|---|")
    print("| killed | " + ", ".join(f"{count} {what}" for what, count in killed.items()) + " |")
    print("| writing failed | " + ", ".join(f"{count} {what}" for what, count in failed.items()) + " |")


if __name__ == "__main__":
    main()
