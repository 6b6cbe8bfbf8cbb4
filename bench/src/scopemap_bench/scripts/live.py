"""Whether a live session keeps up and leaks: latency, drops and memory of a clip played there and back for minutes.

Run as `python -m scopemap_bench.scripts.live CLIP [--fps 15] [--minutes 10] [--camera FILE] [--file KEPT.mp4]`: a
video of CLIP,
there and back until it is long enough, is written (H.264, or KEPT.mp4 is used again) and played at its own speed to a
session in this process, as `scopemap live` plays it. Printed is a table of the tenths of the session: frames, drops,
latency from a frame's time to its pose, processor time, and the memory of this process at the end of the tenth.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from itertools import islice
from multiprocessing import Process
from pathlib import Path

import av
import numpy as np

from scopemap.config import Config
from scopemap.io.live_source import LiveSource
from scopemap.io.opening import open_sequence, sequence_of
from scopemap.odometry import Step
from scopemap.runner.live import LiveSession, finished
from scopemap.runner.reconstructor import Reconstructor

TENTHS = 10
MOST_READ = 250  # frames of the clip


def write_loop(clip: Path, file: Path, fps: int, count: int) -> None:
    """Write `count` frames of a clip, there and back, at a rate."""
    frames = [item.rgb for item in islice(open_sequence(clip).source.frames(slice(None)), MOST_READ)]
    loop = frames + frames[-2:0:-1]
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "16", "preset": "veryfast"})
        stream.height, stream.width = frames[0].shape[0] // 2 * 2, frames[0].shape[1] // 2 * 2
        stream.pix_fmt = "yuv420p"
        for index in range(count):
            picture = np.ascontiguousarray(loop[index % len(loop)][: stream.height, : stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def memory_mb() -> float:
    """Return the memory of this process that is in RAM."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Table:
    """Prints a row for each tenth of a session when its last frame has come."""

    def __init__(self, source: LiveSource, seconds: float) -> None:
        self._source, self._seconds, self._tenth = source, seconds, 0
        self._begin()

    def observe(self, step: Step, reconstructor: Reconstructor) -> None:
        """Count a step."""
        tenth = min(int(TENTHS * step.frame.time_s / self._seconds), TENTHS - 1)
        if tenth > self._tenth:
            self.end()
            self._tenth = tenth
        self._latencies_ms.append(1000 * (self._source.now_s() - step.frame.time_s))
        self._tracked += step.track.status != "lost"

    def end(self) -> None:
        """Print the row."""
        some = self._latencies_ms
        median, slow, slowest = np.percentile(some, [50, 95, 100])
        used_ms = 1000 * (time.process_time() - self._cpu_s) / len(some)
        rate, dropped = TENTHS * len(some) / self._seconds, self._source.dropped - self._dropped
        print(
            f"| {self._tenth + 1} | {len(some)} | {rate:.1f} | {dropped} | {self._tracked} | {median:.0f} | "
            f"{slow:.0f} | {slowest:.0f} | {used_ms:.0f} | {memory_mb():.0f} |",
            flush=True,
        )
        self._begin()

    def _begin(self) -> None:
        self._latencies_ms: list[float] = []
        self._tracked, self._dropped, self._cpu_s = 0, self._source.dropped, time.process_time()


def measure(file: Path, camera: Path | None, seconds: float) -> str:
    """Play a file to a session and print the table; return what became of it."""
    config = Config.load("realtime", settings={"input.focal": "assume"})
    source = LiveSource(str(file))
    table = Table(source, seconds)
    with tempfile.TemporaryDirectory() as folder:
        sequence = sequence_of(source, camera=camera, settings=config.input)
        session = LiveSession(source, sequence, config, observers=(table.observe,), snapshots=Path(folder))
        reconstructor = session.run()
        table.end()
        result = finished(reconstructor, source)
    facts, load = result.provenance, f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    return (
        f"{source.read} frames, {source.dropped} dropped, {facts['tracked']} of {facts['frames']} tracked, "
        f"{len(result.mesh.faces)} faces; load of the machine at the end: {load}"
    )


def main() -> None:
    """Write the file, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--fps", type=int, default=15)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--camera", type=Path)
    parser.add_argument("--file", type=Path)
    given = parser.parse_args()
    seconds = 60 * given.minutes
    with tempfile.TemporaryDirectory() as folder:
        file = given.file or Path(folder) / "loop.mp4"
        if not file.exists():
            writing = Process(target=write_loop, args=(given.clip, file, given.fps, round(seconds * given.fps)))
            writing.start()  # its memory is not that of the session
            writing.join()
        print(f"{given.clip.name} at {given.fps} frames/s for {given.minutes:g} minutes\n")
        print("| tenth | frames | frames/s | dropped | tracked | median ms | 95 % ms | most ms | CPU ms | memory MB |")
        print("|---|---|---|---|---|---|---|---|---|---|")
        print("\n" + measure(file, given.camera, seconds))


if __name__ == "__main__":
    main()
