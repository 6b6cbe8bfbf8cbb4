"""What a batch needs of the engine that runs its tasks, and what an engine past one machine gives each worker."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from scopemap.runner.processes import Outcome, ProcessLimits


class Engine(Protocol):
    """Runs tasks, and tells the outcome of each as it ends: `run_in_processes`, or what does the same elsewhere."""

    def __call__(
        self,
        call: Callable[[Any], Any],
        tasks: Sequence[Any],
        limits: ProcessLimits,
        started: Callable[[int], None] = ...,
        /,
    ) -> Generator[tuple[int, Outcome], None, None]:
        """Yield (number, outcome) of each task; closed early, all that it has begun ends."""
        ...


@dataclass(frozen=True)
class WorkerNeeds:
    """What a worker is given on a cluster: cores, memory in GB (10^9 bytes), and GPUs, on Ray also a share of one."""

    cores: int = 2
    memory_gb: float = 4.0
    gpus: float = 0.0
