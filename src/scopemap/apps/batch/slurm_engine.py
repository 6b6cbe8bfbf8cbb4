"""Tasks as jobs of Slurm, by submitit: one job for each task."""

from __future__ import annotations

import math
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scopemap.apps.batch.engines import WorkerNeeds
from scopemap.engine.errors import InputError, reporting
from scopemap.runner.processes import NEW, Outcome, ProcessLimits, run_in_processes

_SECONDS_BETWEEN_LOOKS = 0.5
_MINUTES_AROUND = 5  # of a job, for its start and its end


@dataclass(frozen=True)
class SlurmEngine:
    """Runs tasks as `run_in_processes` does, each in a job that does so with one process.

    folder : shared by all nodes, in which the jobs leave what they need, until all have ended. needs : of each job.
    cluster : that of submitit; "local" runs jobs on this machine, as a test of the whole way. A job that is lost with
    its node is submitted again; its time is unknown and not counted. Raises `InputError` where a job cannot be
    submitted or `limits` has no seconds, by which Slurm plans.
    """

    folder: Path
    needs: WorkerNeeds
    cluster: str = "slurm"

    def __call__(
        self,
        call: Callable[[Any], Any],
        tasks: Sequence[Any],
        limits: ProcessLimits,
        started: Callable[[int], None] = lambda number: None,
    ) -> Generator[tuple[int, Outcome], None, None]:
        """Yield (number, outcome) as tasks end, `limits.processes` jobs at once; started : called when submitted."""
        if limits.seconds is None:
            raise InputError("Slurm plans by the time of jobs: limit the seconds for one video (--time-limit)")
        one = replace(limits, processes=1)
        waiting = deque((number, NEW) for number in range(len(tasks)))
        jobs: dict[int, tuple[Any, Outcome]] = {}
        with tempfile.TemporaryDirectory(prefix=".jobs-", dir=self.folder, ignore_cleanup_errors=True) as folder:
            executor = self._executor(folder, limits)
            try:
                while waiting or jobs:
                    while waiting and len(jobs) < limits.processes:
                        number, before = waiting.popleft()
                        with reporting("cannot submit a job to Slurm"):
                            jobs[number] = executor.submit(_run, call, tasks[number], one), before
                        started(number)
                    ended = [number for number, (job, _) in jobs.items() if job.done()]
                    for number in ended:
                        outcome, again = _outcome(*jobs.pop(number))
                        if again and limits.allow_another(outcome):
                            waiting.append((number, outcome))
                        else:
                            yield number, outcome
                    if not ended:
                        time.sleep(_SECONDS_BETWEEN_LOOKS)
            finally:
                for job, _ in jobs.values():
                    job.cancel(check=False)

    def _executor(self, folder: str, limits: ProcessLimits) -> Any:
        """Return what submits jobs."""
        try:
            import submitit
        except ImportError:
            raise InputError("--engine slurm needs the extra `cluster`: pip install -e '.[cluster]'") from None
        with reporting("cannot use Slurm here"):
            executor = submitit.AutoExecutor(folder, self.cluster)
            executor.update_parameters(
                name="scopemap",
                timeout_min=math.ceil((limits.seconds or 0.0) * (limits.retries + 1) / 60) + _MINUTES_AROUND,
                cpus_per_task=self.needs.cores,
                mem_gb=self.needs.memory_gb,
                gpus_per_node=math.ceil(self.needs.gpus),
            )
        return executor


def _run(call: Callable[[Any], Any], task: Any, limits: ProcessLimits) -> Outcome:
    """Do a task in a process of a job: what it does to its process, it does not do to the job."""
    ((_, outcome),) = run_in_processes(call, [task], limits)
    return outcome


def _outcome(job: Any, before: Outcome) -> tuple[Outcome, bool]:
    """Return what became of a task whose job has ended, and whether another job may help."""
    fault = job.exception()
    if fault is None:
        found: Outcome = job.result()
        attempts, seconds = before.attempts + found.attempts, before.seconds + found.seconds
        return replace(found, attempts=attempts, seconds=seconds), False
    lines = [line.strip() for line in str(job.stderr() or "").splitlines() if line.strip()]
    fault = f"its job ended without a result ({job.state})" + (f": {lines[-1][:300]}" if lines else "")
    return Outcome(None, fault, before.seconds, before.attempts + 1), True
