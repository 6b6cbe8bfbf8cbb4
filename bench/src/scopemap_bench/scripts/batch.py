"""Batches that are disturbed: are their results those of single runs, and does the same command do nothing twice?

    python -m scopemap_bench.scripts.batch [--videos N] [--engines processes parts ray slurm s3]

Short phantom videos are run one by one, and as a batch by each engine with two workers. Meanwhile

- the process that runs the poisoned video is killed (SIGKILL) in each attempt, and that of one other video once;
- `processes`: the whole command is killed, and given again;
- `parts`: three commands at once, `--part 1/3`, `2/3` and `3/3`, of which the second is killed and given again;
- `ray`: of a cluster of a head and two nodes, all on this machine, one node (its raylet) is killed;
- `slurm`: jobs of submitit on this machine, of which one is killed with all it runs;
- `s3`: the videos are at an address of a local server (moto), the engine is `processes`.

Then the same command is given again. Exit code 1 where a result differs, a failure is not the one expected, or a file
of a finished result is touched again. Needs Linux, and the extra `dev`.
"""

from __future__ import annotations

import argparse
import csv
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.scripts import measuring
from scopemap_bench.scripts.demo_clip import write_clip

SIZE, CAMERA, POISONED = (160, 128), "80 80 79.5 63.5", "colon_03_poisoned"
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
    return {name: file.read_bytes() for name, file in files.items() if name not in OF_ITS_TIME}


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
    os.kill(process, signal.SIGKILL)
    time.sleep(2)


def by_processes(videos: Path, out: Path) -> str:
    """Run a batch of which the whole command is killed."""
    process = subprocess.Popen(command(videos, out))
    wait_for(2, out, process)
    kill(process.pid)
    process.wait()
    subprocess.run(command(videos, out), check=False)
    return "the command"


def by_parts(videos: Path, out: Path) -> str:
    """Run three parts at once, of which one is killed."""
    parts = [command(videos, out, "--part", f"{number}/3", workers=1) for number in (1, 2, 3)]
    running = [subprocess.Popen(part) for part in parts]
    wait_for(2, out, running[1])
    kill(running[1].pid)
    for process in running:
        process.wait()
    subprocess.run(parts[1], check=False)
    return "part 2"


@contextmanager
def ray_cluster() -> Any:
    """Yield the options for a Ray of a head without workers and two nodes, and what kills a node."""
    # A node that is killed refuses at once; one that a loaded machine delays is not dead.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_health_check_timeout_ms": "60000"}
    from ray.cluster_utils import Cluster

    given = {"include_dashboard": False, "object_store_memory": 100 << 20}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **given})
    try:
        nodes = [cluster.add_node(num_cpus=1, memory=2 << 30, **given) for _ in range(2)]
        options = ("--engine", "ray", "--address", cluster.address, "--worker-cores", "1", "--worker-memory", "1GB")
        yield options, lambda: nodes[0].kill_raylet(check_alive=False)
    finally:
        cluster.shutdown()


def by_ray(videos: Path, out: Path) -> str:
    """Run a batch on a Ray that loses a node."""
    with ray_cluster() as (options, kill_node):
        process = subprocess.Popen(command(videos, out, *options))
        wait_for(2, out, process)
        kill_node()
        process.wait()
    return "a node"


def by_slurm(videos: Path, out: Path) -> str:
    """Run a batch as jobs, of which one is killed."""
    process = subprocess.Popen(slurm_command(videos, out))
    wait_for(2, out, process)
    jobs = [job for controller in children(process.pid) for job in children(controller)]
    kill(jobs[0])
    process.wait()
    return "a job"


def slurm_command(videos: Path, out: Path) -> list[str]:
    """Return the command that runs a batch as jobs of submitit on this machine."""
    return [sys.executable, __file__, "--local-jobs", str(videos), str(out)]


def local_jobs(videos: str, out: Path) -> None:
    """Do what `scopemap batch --engine slurm` does, by jobs on this machine."""
    from scopemap.cli.batch import videos_of
    from scopemap.io.inputs import named_inputs
    from scopemap.runner.batch import run_batch
    from scopemap.runner.engines import WorkerNeeds
    from scopemap.runner.processes import ProcessLimits
    from scopemap.runner.slurm_engine import SlurmEngine

    chosen = videos_of(named_inputs([videos]), {"preset": "realtime", "camera": CAMERA}, {})
    engine = SlurmEngine(out, WorkerNeeds(cores=1), cluster="local")
    run_batch(chosen, out, ProcessLimits(2, seconds=120.0, retries=RETRIES), engine=engine)


def children(process: int) -> list[int]:
    """Return the processes that a process has begun."""
    try:
        return [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]
    except OSError:
        return []


@contextmanager
def s3_address(videos: Path) -> Any:
    """Yield the address of a folder of these videos on an S3 server at this machine's loopback address."""
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
        yield "s3://archive/2026"
    finally:
        server.stop()


def by_s3(videos: Path, out: Path) -> str:
    """Run a batch of videos at an address."""
    with s3_address(videos) as address:
        subprocess.run(command(f"{address}/*.mp4", out), check=False)
    return "nothing more"


def again(engine: str, videos: Path, out: Path) -> None:
    """Give the command of an engine again."""
    with ExitStack() as stack:
        if engine == "slurm":
            words = slurm_command(videos, out)
        elif engine == "ray":
            words = command(videos, out, *stack.enter_context(ray_cluster())[0])
        elif engine == "s3":
            words = command(f"{stack.enter_context(s3_address(videos))}/*.mp4", out)
        else:
            words = command(videos, out)
        subprocess.run(words, check=False)


ENGINES: dict[str, Callable[[Path, Path], str]] = {
    "processes": by_processes,
    "parts": by_parts,
    "ray": by_ray,
    "slurm": by_slurm,
    "s3": by_s3,
}


def trial(engine: str, videos: Path, out: Path, wanted: Wanted) -> tuple[list[str], bool]:
    """Return the row of an engine, and whether all is as it must be."""
    begun = time.monotonic()
    with Killer(out, once=True) as killer:
        further = ENGINES[engine](videos, out)
    seconds, before, found = time.monotonic() - begun, times(out), statuses(out)
    others_of = {name: dict(content(out / name).items() ^ files.items()) for name, files in wanted.items()}
    differ = [f"{name}/{file}" for name, differing in others_of.items() for file in differing]
    equal = sum(not differing for differing in others_of.values())
    failed = [f"{name}: {status}" for name, status in found.items() if status != "done"]
    others = sum(len(processes) for name, processes in killer.killed.items() if name != POISONED)
    with Killer(out, once=False):
        again(engine, videos, out)
    after = times(out)
    touched = sum(after.get(file) != when for file, when in before.items())
    left = [path.name for path in out.iterdir() if path.name.startswith(".")]
    attempts = len(killer.killed.get(POISONED, []))
    is_right = equal == len(wanted) and len(failed) == 1 and failed[0].startswith(f"{POISONED}: failed")
    is_right &= (touched, left, others) == (0, [], 1) and statuses(out).keys() == found.keys()
    killed = f"the poisoned {attempts} times, another process once, {further}" if others else "NOBODY"
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
    parser.add_argument("--local-jobs", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.local_jobs:
        local_jobs(given.local_jobs[0], Path(given.local_jobs[1]))
        return
    sys.exit(0 if print_trials(given.videos, given.engines) else 1)


if __name__ == "__main__":
    main()
