"""Tasks in processes of their own: failures, deaths, time limits, attempts; nobody else is touched."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from process_tasks import FAULTS, WHATS, act, soon

from scopemap.runner.processes import ProcessLimits, run_in_processes, usable_cores


def test_each_task_has_the_outcome_that_it_deserves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    files = [tmp_path / f"{number}" for number in range(len(WHATS))]
    started: list[int] = []
    limits = ProcessLimits(2, seconds=12.0, retries=1)
    found = dict(run_in_processes(act, list(zip(WHATS, files, strict=True)), limits, started.append))
    faults = [found[number].fault for number in range(len(WHATS))]
    assert faults[1] == "its process was ended by SIGKILL (out of memory?)"
    assert [*faults[:1], *faults[2:]] == [*FAULTS[:1], *FAULTS[2:]]
    attempts = [file.stat().st_size for file in files]
    assert attempts == [1, 2, 1, 1, 2, 2] == [found[number].attempts for number in range(len(WHATS))]
    assert len(started) == sum(attempts)
    assert found[3].seconds == pytest.approx(12, abs=3)
    assert found[0].value[1] == str(max(1, usable_cores() // 2))
    assert "NUMBA_NUM_THREADS" not in os.environ
    assert multiprocessing.active_children() == []


def test_a_process_does_one_task_after_the_other(tmp_path: Path) -> None:
    tasks = [("work", tmp_path / f"{number}") for number in range(3)]
    assert len({outcome.value[0] for _, outcome in run_in_processes(act, tasks, ProcessLimits(1))}) == 1


def test_processes_end_with_who_waits_for_them(tmp_path: Path) -> None:
    tasks = [("work", tmp_path / "a"), ("hang", tmp_path / "b")]
    with closing(run_in_processes(act, tasks, ProcessLimits(2))) as ended:
        assert next(ended)[0] == 0
    assert multiprocessing.active_children() == []


def test_processes_end_where_their_parent_is_killed(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\nfrom process_tasks import act\n"
        "from scopemap.runner.processes import ProcessLimits, run_in_processes\n"
        f"if __name__ == '__main__':\n    list(run_in_processes(act, [('hang', Path({str(tmp_path / 'a')!r}))], "
        "ProcessLimits(1)))\n"
    )
    (tmp_path / "parent.py").write_text(code)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    parent = subprocess.Popen([sys.executable, tmp_path / "parent.py"], env=environment)
    assert soon(lambda: (tmp_path / "a").exists() or parent.poll() is not None)
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    if not children.exists():
        parent.kill()
        pytest.skip("this system does not list the children of a process")
    pids = children.read_text().split()
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    assert pids
    assert soon(lambda: not any(_runs(pid) for pid in pids))


def _runs(pid: str) -> bool:
    """Whether a process is there, and not only waiting to be asked for its end."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
