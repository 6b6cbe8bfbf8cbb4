"""What a large archive takes on a cluster: by figures of one machine, and by a simulation of many (discrete events).

    python -m scopemap_bench.scripts.cluster_simulation [--hours H] [--nodes N] [--seed S]

prints the tables of docs/scale.md. Each worker takes the next video when it is free, as with the engines of
`scopemap batch`, or the next of its share of the list, as with `--part`. No network and no shared file system is
simulated.
"""

from __future__ import annotations

import heapq
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from scopemap_bench.scripts.measuring import options_of, print_head, print_row

# Of the colonoscopy video (247 frames of 384x384 px at 25 frames/s), default settings, two cores.
FRAME_S, FRAME_MB, RESULT_MB = 1 / 4.0, 0.161, 42.8
VIDEO_MB_S, RATE_HZ = 0.184, 25.0
WAITING_MB = 5 * 384 * 384 / 1e6  # a frame that waits for its fusion, docs/faq.md
NODE_CORES, WORKER_CORES = 16, 2
WORKERS = NODE_CORES // WORKER_CORES
MEAN_VIDEO_MIN, SPREAD = 20.0, 0.6  # of a log-normal distribution
START_S, CHECKPOINT_S = 10.0, 30.0


@dataclass(frozen=True)
class Case:
    """What befalls a cluster.

    slow : share of nodes at half speed. deaths : of processes, per hour of work. losses : of nodes, per hour; a node is
    back after an hour. poisoned : share of videos whose process always dies. resumes : whether work goes on from a
    checkpoint. longest_first : whether the list is sorted. parts : whether each worker has a share of its own.
    """

    name: str
    slow: float = 0.0
    deaths: float = 0.0
    losses: float = 0.0
    poisoned: float = 0.0
    resumes: bool = True
    longest_first: bool = False
    parts: bool = False


@dataclass
class Task:
    """Seconds of work that a video still takes, attempts so far, and whether its process always dies."""

    left_s: float
    poisoned: bool
    attempts: int = 0


@dataclass
class Worker:
    """Two cores of a node; `serial` tells events of the present attempt from those of one that was cut off."""

    node: int
    speed: float
    queue: deque[Task]
    task: Task | None = None
    begun: float = 0.0
    serial: int = 0


def simulate(case: Case, lengths_s: np.ndarray, nodes: int, seed: int) -> dict[str, float]:
    """Return hours until the end, hours of work, those done twice, and how many videos failed.

    lengths_s : (N,) seconds of work of each video, of a worker of full speed.
    """
    draw = np.random.default_rng(seed)
    order = np.sort(lengths_s)[::-1] if case.longest_first else lengths_s
    tasks = [Task(float(length), bool(draw.random() < case.poisoned)) for length in order]
    count, speeds = nodes * WORKERS, np.where(np.arange(nodes) < case.slow * nodes, 0.5, 1.0)
    shares = [deque(tasks[k::count]) for k in range(count)] if case.parts else [deque(tasks)] * count
    workers = [Worker(k // WORKERS, float(speeds[k // WORKERS]), shares[k]) for k in range(count)]
    events: list[tuple[float, int, int, int]] = []  # time, kind (0 ended, 1 died, 2 node lost, 3 free), whom, serial
    found, ended = {"work": 0.0, "twice": 0.0, "failed": 0.0}, 0.0

    def begin(number: int, now: float) -> None:
        worker = workers[number]
        worker.serial += 1
        if not worker.queue:
            worker.task = None
            return
        task = worker.task = worker.queue.popleft()
        task.attempts, worker.begun = task.attempts + 1, now
        takes = START_S + task.left_s / worker.speed
        dies = draw.exponential(3600 / case.deaths) if case.deaths else np.inf
        dies = draw.random() * takes if task.poisoned else dies
        heapq.heappush(events, (now + min(takes, dies), int(dies < takes), number, worker.serial))

    def cut_off(number: int, now: float) -> None:
        worker, task = workers[number], workers[number].task
        assert task is not None
        done = max(now - worker.begun - START_S, 0.0) * worker.speed
        kept = max(done - draw.random() * CHECKPOINT_S, 0.0) if case.resumes else 0.0
        task.left_s, found["twice"] = task.left_s - kept, found["twice"] + done - kept
        found["work"] += now - worker.begun
        if task.attempts < 2:
            worker.queue.append(task)
            for other in (k for k, w in enumerate(workers) if w.task is None and w.queue is worker.queue):
                heapq.heappush(events, (now, 3, other, workers[other].serial))
        else:
            found["failed"] += 1

    for node in range(nodes if case.losses else 0):
        heapq.heappush(events, (draw.exponential(3600 / case.losses), 2, node, 0))
    for number in range(count):
        begin(number, 0.0)
    while any(worker.task is not None for worker in workers) or any(worker.queue for worker in workers):
        now, kind, whom, serial = heapq.heappop(events)
        if kind == 2:
            for number in range(whom * WORKERS, (whom + 1) * WORKERS):
                if workers[number].task is not None:
                    cut_off(number, now)
                workers[number].task, workers[number].serial = None, workers[number].serial + 1
                heapq.heappush(events, (now + 3600.0, 3, number, workers[number].serial))
            heapq.heappush(events, (now + draw.exponential(3600 / case.losses), 2, whom, 0))
        elif serial == workers[whom].serial:
            if kind == 0:
                found["work"], ended = found["work"] + now - workers[whom].begun, now
            elif kind == 1:
                cut_off(whom, now)
            begin(whom, now)
    return {key: value if key == "failed" else value / 3600 for key, value in found.items()} | {"hours": ended / 3600}


ALL = Case("and 0.5 % of the videos always kill theirs", slow=0.1, deaths=0.01, losses=0.002, poisoned=0.005)
CASES = (
    Case("nothing happens"),
    Case("a tenth of the nodes have half the speed", slow=0.1),
    Case("and a process dies every 100 hours of work", slow=0.1, deaths=0.01),
    Case("and each node is lost every 500 hours", slow=0.1, deaths=0.01, losses=0.002),
    ALL,
    replace(ALL, name="all of these, longest videos first", longest_first=True),
    replace(ALL, name="all of these, without checkpoints", resumes=False),
    replace(ALL, name="all of these, by `--part`, one for each worker", parts=True),
)


def tables(hours: float, nodes: int, seed: int) -> None:
    """Print what an archive takes, then what befalls it on a cluster."""
    videos, frames = round(hours * 60 / MEAN_VIDEO_MIN), hours * 3600 * RATE_HZ
    lengths_s = np.random.default_rng(seed).lognormal(0.0, SPREAD, videos)
    lengths_s *= frames * FRAME_S / lengths_s.sum()
    work_h, flow_mb = frames * FRAME_S / 3600, (FRAME_MB + WAITING_MB) / FRAME_S
    waiting_gb = MEAN_VIDEO_MIN * 60 * RATE_HZ * WAITING_MB / 1e3
    rows = {
        "videos": f"{videos:,} of {MEAN_VIDEO_MIN:g} minutes on average, {frames / 1e6:,.0f} million frames",
        "input": f"{hours * 3600 * VIDEO_MB_S / 1e6:.1f} TB",
        "work": f"{work_h:,.0f} worker hours, {work_h / WORKERS:,.0f} hours of nodes of {NODE_CORES} cores",
        "a node": f"{WORKERS / FRAME_S:.0f} frames/s, {WORKERS / FRAME_S / RATE_HZ:.1f} hours of video an hour",
        "results": f"depth {frames * FRAME_MB / 1e6:,.0f} TB, the rest at least {videos * RESULT_MB / 1e6:.1f} TB",
        "frames that wait on disk": f"{waiting_gb:.0f} GB beside each worker for a video of average length",
        "writing": f"{flow_mb:.1f} MB/s a worker; 1 GB/s carries {1000 / flow_mb:.0f} workers",
    }
    print_head("what", "how much")
    for what, how_much in rows.items():
        print_row(what, how_much)
    print()
    print_head(
        f"{nodes} nodes, {nodes * WORKERS} workers", "hours", "node hours", "busy", "work done twice, h", "failed"
    )
    for case in CASES:
        found = simulate(case, lengths_s, nodes, seed)
        h, node_h = found["hours"], found["hours"] * nodes
        busy, twice, failed = found["work"] / (node_h * WORKERS), found["twice"], found["failed"]
        print_row(case.name, f"{h:.0f}", f"{node_h:,.0f}", f"{busy:.1%}", f"{twice:.1f}", f"{failed:.0f}")


def main() -> None:
    """Print tables, or measure."""
    parser = options_of(__doc__)
    parser.add_argument("--hours", type=float, default=10_000)
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    tables(given.hours, given.nodes, given.seed)


if __name__ == "__main__":
    main()
