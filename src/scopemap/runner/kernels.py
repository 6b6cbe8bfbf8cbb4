"""Compiles all kernels that a run can need, once for each machine, before its first frame and in several processes.

Numba compiles a kernel when it is first called, and one at a time in a process: a newcomer's first minute was spent on
that, and again with the first video of another kind.
"""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from scopemap.engine.geometry.kernels import KERNELS, compile_kernel, compiled_mark
from scopemap.engine.models.device import cpu_threads

_MOST_PROCESSES = 4  # guard: memory, 300 MB each
_IN_PROCESS = "from scopemap.runner.kernels import compile_some; compile_some({!r})"


def compile_kernels() -> None:
    """Have all kernels in the cache; those with which that fails are compiled when a run needs them."""
    # An application that Python is embedded in must not be started.
    if not Path(sys.executable or "").name.lower().startswith("python"):
        return
    # No process may be started, or the disk is full: the run goes on without.
    with suppress(OSError), TemporaryDirectory() as taken:
        # -P: what lies in the working folder is not imported.
        command = [sys.executable, "-P", "-c", _IN_PROCESS.format(taken)]
        processes: list[subprocess.Popen[bytes]] = []
        try:
            for _ in range(min(cpu_threads(), _MOST_PROCESSES)):
                processes.append(subprocess.Popen(command, stderr=subprocess.DEVNULL))
            failed = [process.wait() for process in processes]
        finally:
            for process in processes:
                process.kill()
        if not any(failed):
            compiled_mark().touch()


def compile_some(taken: str) -> None:
    """Compile each kernel that no other process has taken: its number is a file in the folder `taken`."""
    gc.disable()  # which takes a fifth of the time, and the process ends soon
    package = Path(__file__).parents[1]
    # In reverse order the one that takes longest comes first, and no process waits for it at the end.
    for file in sorted(package.rglob("*.py"), reverse=True):
        if re.search(r"^@kernel$", file.read_text(encoding="utf-8"), re.MULTILINE):
            import_module(".".join(("scopemap", *file.relative_to(package).with_suffix("").parts)))
    kernels = sorted(KERNELS, key=lambda kernel: (kernel.py_func.__module__, kernel.py_func.__name__), reverse=True)
    for number, kernel in enumerate(kernels):
        try:
            os.close(os.open(Path(taken) / str(number), os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            continue
        compile_kernel(kernel)
