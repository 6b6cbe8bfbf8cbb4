"""Time and memory of long runs: a phantom's frames there and back until they are long enough.

    python -m scopemap_bench.scripts.long_runs [--frames 300 6000 20000] [--size 320x256] [--preset default]

Each is one run of the command line. Printed are its seconds, its processor time per frame, its peak memory, its memory
at each tenth of the time (the last ones are the adjustment, the fusion and the writing), its open files, and the error
of its path after a Sim(3) alignment.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

PERIOD = 300  # frames of the phantom
EVERY_S = 1.0


def write_input(folder: Path, phantom: Path, count: int) -> None:
    """Link a phantom's pictures there and back under increasing numbers, with its camera; write its poses likewise."""
    pictures, poses = sorted(phantom.glob("*_color.png")), (phantom / "pose.txt").read_text().splitlines()
    loop = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
    folder.mkdir()
    for number in range(count):
        (folder / f"{number:06d}_color.png").symlink_to(pictures[loop[number % len(loop)]])
    (folder / "pose.txt").write_text("".join(f"{poses[loop[k % len(loop)]]}\n" for k in range(count)))
    for camera in phantom.glob("*.yaml"):
        (folder / camera.name).symlink_to(camera)


def memory_mb(process: int) -> float:
    """Return the resident memory of a process, MB; raises `OSError` where it has ended."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(source: Path, out: Path, arguments: list[str]) -> tuple[float, float, float, list[tuple[float, int]]]:
    """Return seconds, processor seconds, peak memory in MB, and (memory in MB, open files) every few seconds."""
    started = time.perf_counter()
    command = [sys.executable, "-m", "scopemap", "run", str(source), "--out", str(out), "--quiet", *arguments]
    process, seen = subprocess.Popen(command), []
    while True:
        ended, status, used = os.wait4(process.pid, os.WNOHANG)
        if ended:
            break
        with suppress(OSError):  # it has just ended
            seen.append((memory_mb(process.pid), len(list(Path(f"/proc/{process.pid}/fd").iterdir()))))
        time.sleep(EVERY_S)
    if status:
        raise SystemExit(f"the run of {source} failed")
    return time.perf_counter() - started, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6, seen


def error_mm(source: Path, out: Path) -> float:
    """Return the ATE RMSE after a Sim(3) alignment, mm."""
    command = [sys.executable, "-m", "scopemap", "evaluate", str(out), "--truth", str(source)]
    printed = subprocess.run([*command, "--align", "sim3", "--json"], capture_output=True, text=True).stdout
    return float(json.loads(printed)["ate_rmse_mm"])


def main() -> None:
    """Render, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[300, 6000, 20000], help="in increasing order")
    parser.add_argument("--size", default="320x256")
    parser.add_argument("--preset", default="default")
    options = parser.parse_args()
    print("| frames | seconds | processor time a frame, ms | peak MB | MB each tenth | open files | ATE mm |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as scratch:
        phantom = Path(scratch) / "phantom"
        render = ["phantom", str(phantom), "--frames", str(PERIOD), "--size", options.size, "--quiet"]
        subprocess.run([sys.executable, "-m", "scopemap", *render], check=True)
        for count in sorted(options.frames):
            source, out = Path(scratch) / f"input{count}", Path(scratch) / f"out{count}"
            write_input(source, phantom, count)
            seconds, cpu_s, peak_mb, seen = measure(source, out, ["--preset", options.preset])
            tenths = [f"{seen[len(seen) * k // 10][0]:.0f}" for k in range(1, 10)] if len(seen) >= 10 else []
            files = f"{max(n for _, n in seen)} at most"
            per_frame = 1e3 * cpu_s / count
            cells = [str(count), f"{seconds:.0f}", f"{per_frame:.0f}", f"{peak_mb:.0f}", " ".join(tenths), files]
            cells.append(f"{error_mm(source, out):.2f}")
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
