"""Tasks by processes and Ray: outcomes, deaths, time limits, attempts; batches that lose processes and nodes."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from front_door import refused
from process_tasks import FAULTS, LIMIT_S, WHATS, act, soon

from scopemap.apps.batch.engines import Engine, WorkerNeeds
from scopemap.apps.batch.ray_engine import RayEngine
from scopemap.engine.errors import InputError
from scopemap.runner.processes import ProcessLimits, run_in_processes, usable_cores
from scopemap_bench.scripts.batch import POISONED, single_runs, trial, write_videos

NEEDS = WorkerNeeds(cores=1, memory_gb=0.5)
CLUSTER = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("ray", "moto", "s3fs")),
    reason="needs the extras cluster and dev",
)


@pytest.fixture(params=["processes", pytest.param("ray", marks=CLUSTER)])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Engine:
    """An engine whose workers find the modules of these tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    return {"processes": run_in_processes, "ray": RayEngine(NEEDS)}[request.param]


def test_each_task_has_the_outcome_that_it_deserves(engine: Engine, tmp_path: Path) -> None:
    files = [tmp_path / f"{number}" for number in range(len(WHATS))]
    started: list[int] = []
    limits = ProcessLimits(2, seconds=LIMIT_S, retries=1)
    found = dict(engine(act, list(zip(WHATS, files, strict=True)), limits, started.append))
    faults = [found[number].fault for number in range(len(WHATS))]
    assert faults[1].startswith(("its process on Ray died", "its process was ended by SIGKILL (out of memory?)"))
    assert [*faults[:1], *faults[2:]] == [*FAULTS[:1], *FAULTS[2:]]
    attempts = [file.stat().st_size for file in files]
    assert attempts == [1, 2, 1, 1, 2, 2] == [found[number].attempts for number in range(len(WHATS))]
    assert set(started) == set(found)
    assert found[3].seconds == pytest.approx(LIMIT_S, abs=4)
    assert multiprocessing.active_children() == []


def test_workers_switch_telemetry_off_by_themselves(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node need not have the environment of the machine that a batch was started on."""
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY")
    ((_, outcome),) = engine(os.getenv, ["ORT_DISABLE_TELEMETRY"], ProcessLimits(1, seconds=90.0))
    assert outcome.value == "1", outcome


def test_what_is_begun_ends_with_who_waits_for_it(engine: Engine, tmp_path: Path) -> None:
    tasks = [("hang", tmp_path / "hangs"), ("work", tmp_path / "works")]
    with closing(engine(act, tasks, ProcessLimits(2, seconds=90.0))) as ended:
        number, outcome = next(ended)
        assert number == 1
        assert soon((tmp_path / "hangs").exists)
    assert soon(lambda: not Path(f"/proc/{outcome.value[0]}").exists())


@pytest.mark.parametrize("run", [run_in_processes, pytest.param(RayEngine(NEEDS), marks=CLUSTER)])
def test_a_worker_does_one_task_after_the_other_with_its_share_of_threads(
    run: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    tasks = [("work", tmp_path / f"{number}") for number in range(3)]
    found = {outcome.value for _, outcome in run(act, tasks, ProcessLimits(1))}
    assert [threads for _, threads in found] == [str(usable_cores())]
    assert "NUMBA_NUM_THREADS" not in os.environ


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


@CLUSTER
def test_what_no_node_has_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.apps.batch.ray_engine._LONGEST_START_S", 3.0)
    with pytest.raises(InputError, match="no worker has started on Ray in 3 s: has a node the cores"):
        list(RayEngine(WorkerNeeds(1, 0.5, gpus=64))(act, [("work", tmp_path / "a")], ProcessLimits(1)))


@CLUSTER
def test_ray_of_this_machine_is_reached_from_nowhere_else_and_tells_nobody(tmp_path: Path) -> None:
    """In a process of its own, as a Ray that was imported before has chosen its address."""
    code = (
        "import os\nfrom scopemap.apps.batch.ray_engine import RayEngine\n"
        "from scopemap.apps.batch.engines import WorkerNeeds\n"
        "def listening():\n"
        "    lines = [line.split() for name in ('tcp', 'tcp6') for line in open(f'/proc/net/{name}')]\n"
        "    return [line[1] for line in lines if line[3] == '0A']\n"
        "with RayEngine(WorkerNeeds(1, 0.5))._connected(1) as ray:\n"
        "    facts = ray.util.get_node_ip_address(), os.environ['RAY_USAGE_STATS_ENABLED']\n"
        "    facts += ('dashboard' in ray._private.worker._global_node.all_processes,)\n"
        "    during = listening()\n"
        "for line in (facts, during, listening()):\n    print(*line)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True)
    facts, during, after = done.stdout.splitlines()
    assert facts == "127.0.0.1 0 False"
    new = set(during.split()) - set(after.split())
    loopback = ("0100007F:", "00000000000000000000000001000000:", "0000000000000000FFFF00000100007F:")
    assert new
    assert {address for address in new if not address.startswith(loopback)} == set()


@CLUSTER
def test_a_ray_that_would_ask_others_is_not_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("ray._private.node.Node.start_api_server")
    with pytest.raises(InputError, match=r"starting Ray \d.*asking which cloud this is; install the version in const"):
        list(RayEngine(WorkerNeeds(1, 0.5))(act, [("work", tmp_path / "a")], ProcessLimits(1)))


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, dict[str, bytes]]]:
    """Four short videos, one of which is poisoned, and the content of the single runs of the others."""
    folder = tmp_path_factory.mktemp("batch")
    write_videos(folder / "videos", 4)
    return folder / "videos", single_runs(folder / "videos", folder / "single")


@CLUSTER
# Minutes for each, and Ray starts late on a busy machine: `scopemap_bench.scripts.batch` tries all of them.
def test_a_disturbed_batch_has_the_results_of_single_runs(
    videos: tuple[Path, dict[str, dict[str, bytes]]], tmp_path: Path
) -> None:
    cells, is_right = trial("s3", videos[0], tmp_path / "out", videos[1])
    assert is_right, cells
    assert cells[1] == "3 of 3"
    assert cells[2].startswith(f"{POISONED}: failed")


@CLUSTER
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--worker-cores", 2), "--worker-cores is an option of --engine ray"),
        (("--engine", "ray", "--address", "127.0.0.1:1", "--workers", 1), "cannot connect to Ray at 127.0.0.1:1"),
    ],
)
def test_what_an_engine_cannot_do_is_refused(
    options: tuple[object, ...], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.mp4").write_bytes(b"")
    assert said in refused(capfd, "batch", tmp_path / "a.mp4", "--out", tmp_path / "out", *options)
