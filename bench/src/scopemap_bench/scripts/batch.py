"""Batches that are disturbed: are their results those of single runs, and does the same command do nothing twice?

    python -m scopemap_bench.scripts.batch [--videos N] [--engines processes parts ray s3]

Short phantom videos are run one by one, and as a batch by each engine with two workers, on this machine (`s3`: by a
local moto server). Meanwhile the process of the poisoned video is killed in each attempt, that of another video once,
and what the engine's function states. Then the same command is given again. Exit code 1 where a result differs, a
failure is not the one expected, or a file of a finished result is touched again. Needs Linux, and the extra `dev`.
"""

from __future__ import annotations

import csv
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.demo_clip import write_clip

SIZE = (160, 128)
CAMERA = "80 80 79.5 63.5"
POISONED = "colon_03_poisoned"
SETTINGS = ("--preset", "realtime", "--camera", CAMERA)
RETRIES = 2
# They hold times, or what holds times.
OF_ITS_TIME = {"provenance.json", "SHA256SUMS", "report.html", "frames/measures.csv"}
Wanted = dict[str, dict[str, bytes]]


def write_videos(folder: Path, count: int) -> None:
    """Write so many videos of 8 to 12 frames by the camera `CAMERA`, the fourth of them the poisoned one."""
    folder.mkdir(parents=True)
    for number in range(count):
        name = POISONED if number == 3 else f"colon_{number:02d}"
        spec = PhantomSpec(frames=8 + number % 5, width=SIZE[0], height=SIZE[1], seed=number)
        with tempfile.TemporaryDirectory() as scratch:
            write_clip(Path(scratch), spec)
            (folder / f"{name}.mp4").write_bytes((Path(scratch) / "colon.mp4").read_bytes())


def content(out: Path) -> dict[str, bytes]:
    """Return the files of a result by name, but those that state times."""
    files = {file.relative_to(out).as_posix(): file for file in out.rglob("*") if file.is_file()}
    # A run that was killed when its result was in place leaves `.unfinished`.
    wanted = (name for name in files if name not in OF_ITS_TIME and not name.startswith(".unfinished"))
    return {name: files[name].read_bytes() for name in wanted}


def times(out: Path) -> dict[Path, int]:
    """Return when each file of the finished results of a batch was written, ns."""
    done = [file.parent for file in out.glob("*/provenance.json")]
    return {file: file.stat().st_mtime_ns for folder in done for file in folder.rglob("*")}


def statuses(out: Path) -> dict[str, str]:
    """Return the status of each video of a batch, with the reason of a failure."""
    with (out / "batch.csv").open(newline="", encoding="utf-8") as table:
        return {row["folder"]: f"{row['status']} {row['reason']}".strip() for row in csv.DictReader(table)}


class Killer:
    """Kills what writes the result of the poisoned video, each time, and what writes another result first, once."""

    def __init__(self, out: Path, *, once: bool) -> None:
        self.killed: dict[str, list[int]] = {}
        self._out, self._once, self._ended = out, once, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Killer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.003):
            for lock in self._out.glob("*/.unfinished/process"):
                name = lock.parent.parent.name
                if name == POISONED or (self._once and not set(self.killed) - {POISONED}):
                    self._kill(name, lock)

    def _kill(self, name: str, lock: Path) -> None:
        try:
            process = int(lock.read_text().split()[0])
            if process not in self.killed.get(name, []):
                os.kill(process, signal.SIGKILL)
                self.killed.setdefault(name, []).append(process)
        except (OSError, ValueError, IndexError):  # it has ended meanwhile, or not written who it is
            return


def command(videos: object, out: Path, *options: str, workers: int = 2) -> list[str]:
    """Return the command of a batch."""
    fixed = ("--quiet", "--retries", RETRIES, "--workers", workers)
    return measuring.command_line("batch", videos, "--out", out, *SETTINGS, *fixed, *options)


def wait_for(results: int, out: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until a batch has so many results, or ends."""
    while process.poll() is None and len(list(out.glob("*/provenance.json"))) < results:
        time.sleep(0.01)


def kill(process: int) -> None:
    """Kill a process of ours, and give those that end with it time to do so."""
    with suppress(ProcessLookupError):  # it has just ended
        os.kill(process, signal.SIGKILL)
    time.sleep(2)


def children(process: int) -> list[int]:
    """Return the processes that a process has begun."""
    try:
        return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]
    except OSError:
        return []


@dataclass(frozen=True)
class Disturbed:
    """The command of a batch, what is killed beside processes of its videos, and how, given the process."""

    command: list[str]
    what: str
    kill: Callable[[subprocess.Popen[bytes]], object]


@contextmanager
def by_processes(videos: Path, out: Path) -> Iterator[Disturbed]:
    """Yield a batch of which the whole command is killed."""
    yield Disturbed(command(videos, out), "the command", lambda process: kill(process.pid))


@contextmanager
def by_parts(videos: Path, out: Path) -> Iterator[Disturbed]:
    """Yield the second of three parts that run at once; it is killed."""
    parts = [command(videos, out, "--part", f"{number}/3", workers=1) for number in (1, 2, 3)]
    others = [subprocess.Popen(part) for part in (parts[0], parts[2])]
    yield Disturbed(parts[1], "part 2", lambda process: kill(process.pid))
    for process in others:
        process.wait()


@contextmanager
def by_ray(videos: Path, out: Path) -> Iterator[Disturbed]:
    """Yield a batch on a Ray of a head without workers and two nodes, of which it loses one."""
    # A node that is killed refuses at once; one that a loaded machine delays is not dead.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_health_check_timeout_ms": "60000"}
    from ray.cluster_utils import Cluster

    given = {"include_dashboard": False, "object_store_memory": 100 << 20}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **given})
    try:
        nodes = [cluster.add_node(num_cpus=1, memory=2 << 30, **given) for _ in range(2)]
        options = ("--engine", "ray", "--address", cluster.address, "--worker-cores", "1", "--worker-memory", "1GB")
        command_line = command(videos, out, *options)
        yield Disturbed(command_line, "a node", lambda process: nodes[0].kill_raylet(check_alive=False))
    finally:
        cluster.shutdown()


@contextmanager
def by_s3(videos: Path, out: Path) -> Iterator[Disturbed]:
    """Yield a batch of videos on an S3 server at this machine's loopback address; nothing more is killed."""
    import fsspec
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    of_server = {"AWS_ENDPOINT_URL": f"http://{host}:{port}", "AWS_DEFAULT_REGION": "us-east-1"}
    os.environ.update(of_server | {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any"})
    try:
        store = fsspec.filesystem("s3", skip_instance_cache=True)
        if not store.exists("archive"):
            store.mkdir("archive")
        store.put(str(videos) + "/", "archive/2026/", recursive=True)
        yield Disturbed(command("s3://archive/2026/*.mp4", out), "nothing more", lambda process: None)
    finally:
        server.stop()


ENGINES: dict[str, Callable[[Path, Path], AbstractContextManager[Disturbed]]] = {
    "processes": by_processes,
    "parts": by_parts,
    "ray": by_ray,
    "s3": by_s3,
}


def trial(engine: str, videos: Path, out: Path, wanted: Wanted) -> tuple[list[str], bool]:
    """Return the row of an engine, and whether all is as it must be."""
    begun = time.monotonic()
    with Killer(out, once=True) as killer, ENGINES[engine](videos, out) as batch:
        process = subprocess.Popen(batch.command)
        wait_for(2, out, process)
        batch.kill(process)
        if process.wait() < 0:
            subprocess.run(batch.command, check=False)
    seconds, before, found = time.monotonic() - begun, times(out), statuses(out)
    others_of = {name: dict(content(out / name).items() ^ files.items()) for name, files in wanted.items()}
    differ = [f"{name}/{file}" for name, differing in others_of.items() for file in differing]
    equal = sum(not differing for differing in others_of.values())
    failed = [f"{name}: {status}" for name, status in found.items() if status != "done"]
    others = sum(len(processes) for name, processes in killer.killed.items() if name != POISONED)
    with Killer(out, once=False), ENGINES[engine](videos, out) as batch:
        subprocess.run(batch.command, check=False)
    after = times(out)
    touched = sum(after.get(file) != when for file, when in before.items())
    left = [path.name for path in out.iterdir() if path.name.startswith(".")]
    attempts = len(killer.killed.get(POISONED, []))
    is_right = equal == len(wanted) and len(failed) == 1 and failed[0].startswith(f"{POISONED}: failed")
    is_right &= (touched, left, others) == (0, [], 1) and statuses(out).keys() == found.keys()
    killed = f"the poisoned {attempts} times, another process once, {batch.what}" if others else "NOBODY"
    equals = " but ".join([f"{equal} of {len(wanted)}", *differ[:3]])
    cells = [engine, equals, "; ".join(failed), killed, str(touched), f"{seconds:.0f}"]
    return cells, is_right


def single_runs(videos: Path, folder: Path) -> Wanted:
    """Return the content of the result of each video but the poisoned one."""
    wanted = {}
    for video in sorted(videos.glob("*.mp4")):
        if video.stem != POISONED:
            measuring.scopemap("run", video, "--out", folder / video.stem, *SETTINGS, "--quiet")
            wanted[video.stem] = content(folder / video.stem)
    return wanted


def print_trials(count: int, engines: list[str]) -> bool:
    """Print a row for each engine, by so many videos; return whether all is as it must be."""
    all_right = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_videos(folder / "videos", count)
        wanted = single_runs(folder / "videos", folder / "single")
        heads = ("engine", "equal to single runs", "failed", "killed", "touched again by the same command")
        measuring.print_head(*heads, f"s, {count} videos")
        for engine in engines:
            cells, is_right = trial(engine, folder / "videos", folder / engine, wanted)
            all_right &= is_right
            measuring.print_row(*cells[:-1], cells[-1] if is_right else f"{cells[-1]} WRONG")
    return all_right


def main() -> None:
    """Print a table."""
    parser = measuring.options_of(__doc__)
    parser.add_argument("--videos", type=int, default=24)
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    given = parser.parse_args()
    sys.exit(0 if print_trials(given.videos, given.engines) else 1)


if __name__ == "__main__":
    main()
