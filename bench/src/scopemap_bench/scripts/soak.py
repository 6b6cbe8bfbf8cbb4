"""Does a long run grow? Memory, open files and disk of a run over thousands of frames, part by part.

    python -m scopemap_bench.scripts.soak [--frames 20000] [--preset default] [--size 160x128] [--end]

A phantom of 200 frames is seen there and back until there are so many. Printed is a row per twentieth of the run:
frames per second, the memory of this process in RAM, its open files, MB in the folder of the run; then the slope of
memory over the frames after the first 4,000 (half of a shorter run), the highest memory, and the share of the run that
its checkpoints took. The run ends after the last frame; with `--end` its keyframes are adjusted and its surface is
made, too.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from scopemap.config import Config
from scopemap.io.checkpoint import SavedState
from scopemap.io.opening import open_sequence
from scopemap.odometry import Step
from scopemap.report.frame_pictures import FramePictures
from scopemap.runner.reconstruct import reconstruct

PHANTOM_FRAMES, ROWS = 200, 20
# Until there are 400 keyframes, features of each are kept to find places again.
WARM_UP_FRAMES = 4000


class SoakedError(BaseException):
    """Ends a run after its last frame."""


def memory_kb() -> float:
    """Return the memory of this process that is in RAM."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e3


def warm_up(count: int) -> int:
    """Return after how many of so many frames the slope begins."""
    return min(WARM_UP_FRAMES, count // 2)


class Watch:
    """Takes each step, and prints a row where one is due."""

    def __init__(self, count: int, out: Path) -> None:
        self._count, self._out, self._seen, self._since = count, out, 0, time.perf_counter()
        self.frames: list[int] = []
        self.memory_kb: list[float] = []

    def observe(self, step: Step) -> None:
        """Count a step."""
        self._seen += 1
        if self._seen % 20 == 0:
            self.frames.append(self._seen)
            self.memory_kb.append(memory_kb())
        if self._seen % max(self._count // ROWS, 1) == 0:
            now, files = time.perf_counter(), len(os.listdir("/proc/self/fd"))
            rate = max(self._count // ROWS, 1) / (now - self._since)
            stored_mb = sum(file.stat().st_size for file in self._out.rglob("*") if file.is_file()) / 1e6
            print(f"| {self._seen} | {rate:.1f} | {memory_kb() / 1e3:.1f} | {files} | {stored_mb:.0f} |", flush=True)
            self._since = now

    def slope(self) -> float:
        """Return kB per frame after the warm-up, by least squares."""
        late = np.array(self.frames) > warm_up(self._count)
        return float(np.polyfit(np.array(self.frames)[late], np.array(self.memory_kb)[late], 1)[0])


def there_and_back(phantom: Path, folder: Path, count: int) -> None:
    """Link the frames of a phantom as a folder of so many images."""
    files = sorted(phantom.glob("*_color.png"))
    loop = files + files[-2:0:-1]
    folder.mkdir()
    (folder / "camera.yaml").symlink_to(phantom / "camera.yaml")
    for index in range(count):
        (folder / f"{index:06d}.png").symlink_to(loop[index % len(loop)])


def main() -> None:
    """Draw, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--size", default="160x128")
    parser.add_argument("--end", action="store_true")
    given = parser.parse_args()
    writing_s = [0.0]

    def timed(name: str) -> None:
        real = getattr(SavedState, name)

        def call(self: SavedState, *arguments: object) -> None:
            started = time.perf_counter()
            real(self, *arguments)
            writing_s[0] += time.perf_counter() - started

        setattr(SavedState, name, call)

    timed("put")
    timed("commit")
    with tempfile.TemporaryDirectory() as temporary:
        phantom, video, out = (Path(temporary) / name for name in ("phantom", "video", "run"))
        ask = ("--scene", "colon", "--frames", str(PHANTOM_FRAMES), "--size", given.size, "--quiet")
        subprocess.run([sys.executable, "-m", "scopemap", "phantom", str(phantom), *ask], check=True)
        there_and_back(phantom, video, given.frames)
        watch, pictures, started = Watch(given.frames, out), FramePictures(), time.perf_counter()

        def end(doing: str, done: int, total: int) -> None:
            if doing == "adjusting keyframes":
                print(f"tracked after {time.perf_counter() - started:.0f} s", flush=True)
                if not given.end:
                    raise SoakedError

        print("| frames | frames/s | memory, MB | open files | stored, MB |\n|---|---|---|---|---|")
        try:
            seen = (pictures.observe, watch.observe)
            reconstruct(open_sequence(video), Config.load(given.preset), out=out, observers=seen, progress=end)
        except SoakedError:
            pass
        spent_s = time.perf_counter() - started
    highest_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    print(f"\n{watch.slope():.2f} kB per frame after frame {warm_up(given.frames)}; highest {highest_mb:.0f} MB;")
    print(f"checkpoints took {writing_s[0]:.1f} of {spent_s:.0f} s ({writing_s[0] / spent_s:.1%})")


if __name__ == "__main__":
    main()
