"""Tasks on a Ray that runs already, a cluster or one machine: actors that do one task after the other."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from typing import Any

import cv2

from scopemap.apps.batch.engines import WorkerNeeds
from scopemap.engine.errors import InputError, reporting
from scopemap.runner.processes import NEW, THREADS, Outcome, ProcessLimits, attempt

_LONGEST_START_S = 300.0
_LONGEST_CONNECT_S = 10.0
_MOST_FAILED_STARTS = 3


@dataclass(frozen=True)
class RayEngine:
    """Runs tasks as `run_in_processes` does, in actors on Ray, which share a file system.

    needs : of each actor. address : as `ray.init` takes it; "auto": of the Ray that this machine is a node of.
    A task whose actor or node dies is tried again in another actor. Raises `InputError` where there is no Ray, and
    where no actor starts.
    """

    needs: WorkerNeeds
    address: str = "auto"

    def __call__(
        self,
        call: Callable[[Any], Any],
        tasks: Sequence[Any],
        limits: ProcessLimits,
        started: Callable[[int], None] = lambda number: None,
    ) -> Generator[tuple[int, Outcome], None, None]:
        """Yield (number, outcome) of each task, as they end; `limits.processes` bounds the actors."""
        waiting = deque((number, NEW) for number in range(len(tasks)))
        workers: list[_ActorHandle] = []
        failed_starts = 0
        with self._connected() as ray:
            actor = self._actor(ray)
            while waiting or any(worker.is_busy for worker in workers):
                # An actor that is placed nowhere yet holds no task: those that run do them all.
                starting = sum(not worker.is_busy for worker in workers)
                lacking = min(limits.processes - len(workers), len(waiting) - starting)
                workers += [_ActorHandle(ray, actor()) for _ in range(lacking)]
                for worker in _ready(ray, workers, limits.seconds):
                    was_busy, (outcome, again) = worker.is_busy, worker.end(limits.seconds)
                    if not was_busy:
                        failed_starts = failed_starts + 1 if outcome.fault else 0
                        if failed_starts > _MOST_FAILED_STARTS:
                            same = "is the same scopemap installed on its nodes?"
                            raise InputError(f"no worker starts on Ray: {outcome.fault}; {same}")
                    elif again and limits.allow_another(outcome):
                        waiting.append((worker.number, outcome))
                    else:
                        yield worker.number, outcome
                    if worker.is_alive and waiting:
                        number, before = waiting.popleft()
                        started(number)
                        worker.begin(call, number, tasks[number], before)
                    else:  # what it was given is free for those that wait for a place
                        worker.kill()
                        workers.remove(worker)

    def _actor(self, ray: Any) -> Callable[[], Any]:
        """Return what makes an actor."""
        needs = self.needs
        declared = {"num_cpus": needs.cores, "num_gpus": needs.gpus, "memory": int(needs.memory_gb * 1e9)}
        kind = ray.remote(_Tasks).options(**declared, max_restarts=0)
        return lambda: kind.remote(needs.cores)

    @contextmanager
    def _connected(self) -> Iterator[Any]:
        """Yield the module ray, connected; all its actors end with the connection."""
        try:
            import ray
        except ImportError:
            raise InputError("--engine ray needs the extra `cluster`: pip install -e '.[cluster]'") from None
        handler = signal.getsignal(signal.SIGTERM)
        with redirect_stdout(sys.stderr):  # what Ray thinks of workers that die goes to stdout otherwise
            try:
                with reporting(f"cannot connect to Ray at {self.address}; see docs/batch.md"):
                    _check_reached(self.address)
                    ray.init(self.address, log_to_driver=False, logging_level=logging.ERROR)
                if threading.current_thread() is threading.main_thread():
                    signal.signal(signal.SIGTERM, handler)  # Ray's own would replace that of the command
                yield ray
            finally:
                ray.shutdown()


class _Tasks:
    """What an actor does, in a process of its own."""

    def __init__(self, threads: int) -> None:
        # Before the first task is unpacked, which imports numba.
        for name in THREADS:
            os.environ.setdefault(name, str(threads))
        cv2.setNumThreads(threads)

    def start(self) -> tuple[None, str, bool]:
        return None, "", True

    def do(self, call: Callable[[Any], Any], task: Any) -> tuple[Any, str, bool]:
        return attempt(call, task)


class _ActorHandle:
    """An actor as it is seen from here: it starts, then it does tasks."""

    def __init__(self, ray: Any, actor: Any) -> None:
        self._ray, self._actor, self._before = ray, actor, NEW
        self.number, self.is_busy, self.is_alive, self.begun = -1, False, True, time.monotonic()
        self.answer = actor.start.remote()

    def begin(self, call: Callable[[Any], Any], number: int, task: Any, before: Outcome) -> None:
        """Give it a task, with the outcome of the attempts before."""
        self.number, self._before, self.is_busy, self.begun = number, before, True, time.monotonic()
        self.answer = self._actor.do.remote(call, task)

    def end(self, limit_s: float | None) -> tuple[Outcome, bool]:
        """Return the outcome of what it has done, and whether another attempt may help; one over time ends."""
        value, again = None, True
        if self._ray.wait([self.answer], timeout=0)[0]:
            try:
                value, fault, again = self._ray.get(self.answer)
            except self._ray.exceptions.RayError as error:
                fault, self.is_alive = _cause_of_death(error), False
        else:
            fault, again, self.is_alive = f"took longer than {limit_s:g} s", False, False
        seconds = self._before.seconds + time.monotonic() - self.begun
        return Outcome(value, fault, seconds, self._before.attempts + 1), again

    def kill(self) -> None:
        """End the actor, whatever it does."""
        self._ray.kill(self._actor)


def _ready(ray: Any, workers: list[_ActorHandle], limit_s: float | None) -> list[_ActorHandle]:
    """Return the workers that have started, answered, died or are over time, after waiting for the first of them."""
    busy = [worker for worker in workers if worker.is_busy]
    last_s = _LONGEST_START_S if not busy else limit_s
    until = min(worker.begun + last_s for worker in busy or workers) if last_s is not None else None
    left_s = None if until is None else max(until - time.monotonic(), 0.0)
    found, _ = ray.wait([worker.answer for worker in workers], timeout=left_s)
    over = [w for w in busy if limit_s is not None and time.monotonic() >= w.begun + limit_s]
    if not busy and not found:
        raise InputError(
            f"no worker has started on Ray in {_LONGEST_START_S:g} s: has a node the cores, memory and GPUs of one "
            "(--worker-cores, --worker-memory, --worker-gpus)?"
        )
    return [worker for worker in workers if worker.answer in found or worker in over]


def _check_reached(address: str) -> None:
    """Raise `OSError` where nobody listens at HOST:PORT: Ray itself asks for minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "//" not in host:
        socket.create_connection((host, int(port)), timeout=_LONGEST_CONNECT_S).close()


def _cause_of_death(error: Exception) -> str:
    """Return what Ray says of an actor that died, in one line."""
    message = " ".join(line.strip() for line in str(error).splitlines() if line and not line.startswith("\t"))
    detail = re.search(r"exit detail: (.+?)\. (End of file|Some)", message)
    return f"its process on Ray died: {(detail[1] if detail else message)[:200]}"
