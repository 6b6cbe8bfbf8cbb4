"""Time and memory of long runs, and of a live session that is played to at the clip's own speed.

    python -m scopemap_bench.scripts.long_runs [--frames 300 1200]
        [--clip CLIP [--count 18000] [--presets default realtime]] [--live CLIP [--minutes 1]]

First table: a phantom's frames there and back, one run of the command line each: memory at each tenth of the time, ATE
after a Sim(3) alignment. Second: the same of a clip at its own size, which is written as a video there and back; ATE
where the clip's folder has poses (`pose.txt`). Third: such a video, played as `scopemap live` plays it to a session
here.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
import time
from contextlib import suppress
from itertools import islice
from multiprocessing import Process
from pathlib import Path

import av
import numpy as np

from scopemap.apps.live.live import LiveSession, finished
from scopemap.engine.config import Config
from scopemap.engine.odometry import Step
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.live_source import LiveSource
from scopemap.input.opening import open_sequence, sequence_of
from scopemap.runner.reconstructor import Reconstructor
from scopemap_bench.scripts import measuring

PERIOD = 300  # frames of the phantom
EVERY_S = 1.0
PARTS = 5  # of a live session
FPS = 15  # of the session
CLIP_FPS = 30
MOST_READ = 300  # frames of the clip


def write_input(folder: Path, source: Path, count: int) -> None:
    """Link a phantom's pictures there and back under increasing numbers, with its camera; write its poses likewise."""
    pictures, poses = sorted(source.glob("*_color.png")), (source / "pose.txt").read_text().splitlines()
    order = measuring.there_and_back(count, len(pictures))
    folder.mkdir()
    for number, index in enumerate(order):
        (folder / f"{number:06d}_color.png").symlink_to(pictures[index])
    (folder / "pose.txt").write_text("".join(f"{poses[index]}\n" for index in order))
    for camera in source.glob("*.yaml"):
        (folder / camera.name).symlink_to(camera)


def print_run(source: Path, out: Path, count: int, truth: Path | None, *words: object) -> None:
    """Run a source, with more words of the command line, in a process that is watched, and print its row."""
    started, seen = time.perf_counter(), []
    process = subprocess.Popen(measuring.command_line("run", source, "--out", out, "--quiet", *words))
    while True:
        ended, status, used = os.wait4(process.pid, os.WNOHANG)
        if ended:
            break
        with suppress(OSError):  # it has just ended
            seen.append((measuring.memory_mb(process.pid), len(list(Path(f"/proc/{process.pid}/fd").iterdir()))))
        time.sleep(EVERY_S)
    if status:
        raise SystemExit(f"the run of {source} failed")
    tenths = [f"{seen[len(seen) * k // 10][0]:.0f}" for k in range(1, 10)]
    per_frame_ms = 1e3 * (used.ru_utime + used.ru_stime) / count
    figures = {} if truth is None else measuring.evaluated(out, "--truth", truth, "--align", "sim3")
    cells = [count, f"{time.perf_counter() - started:.0f}", f"{per_frame_ms:.0f}"]
    cells += [f"{used.ru_maxrss * 1024 / 1e6:.0f}", " ".join(tenths), max(files for _, files in seen)]
    measuring.print_row(*cells, measuring.cell(figures, ".2f", "ate_rmse_mm"))


def print_heads() -> None:
    """Print the head of a table of runs."""
    heads = ("frames", "seconds", "processor time a frame, ms", "peak MB", "MB each tenth")
    measuring.print_head(*heads, "open files at most", "ATE mm")


def write_loop(clip: Path, file: Path, count: int, fps: int) -> None:
    """Write `count` frames of a clip, there and back, as H.264; beside it the camera, where it is known."""
    once, sequence = file.with_name("once.mp4"), open_sequence(clip)
    if sequence.calibrated:
        write_calibration(sequence.rectifier.source, file.with_suffix(".yaml"))
    frames = [item.rgb for item in islice(sequence.source.frames(slice(None)), MOST_READ)]
    order = measuring.there_and_back(2 * len(frames) - 2, len(frames))
    with av.open(str(once), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "16", "preset": "veryfast"})
        stream.height, stream.width = frames[0].shape[0] // 2 * 2, frames[0].shape[1] // 2 * 2
        stream.pix_fmt = "yuv420p"
        for index in order:
            picture = np.ascontiguousarray(frames[index][: stream.height, : stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    with av.open(str(file), "w") as container:
        stream, written, begin = None, 0, 0
        while written < count:
            with av.open(str(once)) as loop:
                stream = stream or container.add_stream_from_template(loop.streams.video[0])
                packets = [packet for packet in loop.demux(loop.streams.video[0]) if packet.dts is not None]
                for packet in packets[: count - written]:
                    packet.pts, packet.dts, packet.stream = packet.pts + begin, packet.dts + begin, stream
                    container.mux(packet)
                begin += sum(packet.duration for packet in packets)
                written += len(packets)
    once.unlink()


def written_loop(clip: Path, file: Path, count: int, fps: int) -> Path:
    """Write a loop in a process of its own, whose memory is not that of what is measured, and return it."""
    writing = Process(target=write_loop, args=(clip, file, count, fps))
    writing.start()
    writing.join()
    if writing.exitcode:
        raise SystemExit(f"the loop of {clip} could not be written")
    return file


def measure_clip(given: argparse.Namespace, folder: Path) -> None:
    """Write the clip's loop, run it with each preset, and print a row each."""
    file = written_loop(given.clip, folder / "clip.mp4", given.count, CLIP_FPS)
    poses, truth = given.clip / "pose.txt", None
    if poses.is_file():
        truth, lines = folder / "pose.txt", poses.read_text().splitlines()[:MOST_READ]
        truth.write_text("".join(f"{lines[index]}\n" for index in measuring.there_and_back(given.count, len(lines))))
    camera = ["--camera", file.with_suffix(".yaml")] if file.with_suffix(".yaml").is_file() else []
    for preset in given.presets:
        print(f"\n{given.clip.name} there and back, {given.count / CLIP_FPS / 60:.1f} minutes, {preset}\n")
        print_heads()
        print_run(file, folder / f"out-{preset}", given.count, truth, "--preset", preset, *camera)


class LiveTable:
    """Prints a row for each part of a session when its last frame has come."""

    def __init__(self, source: LiveSource, seconds: float) -> None:
        self._source, self._seconds, self._part = source, seconds, 0
        self._begin()
        heads = ("part", "frames", "dropped", "tracked", "latency ms, median / 95 %")
        measuring.print_head(*heads, "CPU ms a frame", "memory MB")

    def observe(self, step: Step, reconstructor: Reconstructor) -> None:
        """Count a step."""
        part = min(int(PARTS * step.frame.time_s / self._seconds), PARTS - 1)
        if part > self._part:
            self.end()
            self._part = part
        self._latencies_ms.append(1000 * (self._source.now_s() - step.frame.time_s))
        self._tracked += step.track.status != "lost"

    def end(self) -> None:
        """Print the row."""
        count = len(self._latencies_ms)
        latency = " / ".join(f"{value:.0f}" for value in np.percentile(self._latencies_ms, [50, 95]))
        used = (f"{1000 * (time.process_time() - self._cpu_s) / count:.0f}", f"{measuring.memory_mb():.0f}")
        counts = (count, self._source.dropped - self._dropped, self._tracked)
        measuring.print_row(f"{self._part + 1} of {PARTS}", *counts, latency, *used)
        self._begin()

    def _begin(self) -> None:
        self._latencies_ms: list[float] = []
        self._tracked, self._dropped, self._cpu_s = 0, self._source.dropped, time.process_time()


def print_live(file: Path, seconds: float) -> None:
    """Play a file to a session; print the table and what became of it."""
    config = Config.load("realtime", settings={"input.focal": "assume"})
    source = LiveSource(str(file))
    table = LiveTable(source, seconds)
    with tempfile.TemporaryDirectory() as folder:
        sequence = sequence_of(source, settings=config.input)
        session = LiveSession(source, sequence, config, observers=(table.observe,), snapshots=Path(folder))
        reconstructor = session.run()
        table.end()
        result = finished(reconstructor, source)
    load = f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    print(f"\n{source.read} frames, {source.dropped} dropped, {result.provenance['tracked']} tracked; load {load}")


def measure_live(given: argparse.Namespace, folder: Path) -> None:
    """Write the clip's loop and play it."""
    seconds = 60 * given.minutes
    file = written_loop(given.live, folder / "loop.mp4", round(seconds * FPS), FPS)
    print(f"\n{given.live.name} at {FPS} frames/s for {given.minutes:g} minutes\n")
    print_live(file, seconds)


def main() -> None:
    """Render, run, print."""
    parser = measuring.options_of(__doc__)
    parser.add_argument("--frames", type=int, nargs="*", default=[300, 1200])
    parser.add_argument("--clip", type=Path, metavar="CLIP")
    parser.add_argument("--count", type=int, default=18_000, help="frames of the clip's video")
    parser.add_argument("--presets", nargs="+", default=["default", "realtime"])
    parser.add_argument("--live", type=Path, metavar="CLIP")
    parser.add_argument("--minutes", type=float, default=1.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if given.frames:
            drawn = measuring.phantom(folder / "phantom", "--frames", PERIOD, "--size", "320x256")
            print_heads()
        for count in sorted(given.frames):
            write_input(folder / f"input-{count}", drawn, count)
            print_run(folder / f"input-{count}", folder / f"out-{count}", count, folder / f"input-{count}")
        if given.clip:
            measure_clip(given, folder)
        if given.live:
            measure_live(given, folder)


if __name__ == "__main__":
    main()
