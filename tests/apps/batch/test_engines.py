"""Tasks by processes and Ray: outcomes, deaths, time limits, attempts; batches that lose processes and nodes."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from scopemap.apps.batch.engines import Engine, WorkerNeeds
from scopemap.apps.batch.ray_engine import RayEngine
from scopemap.engine.errors import InputError
from scopemap.runner.processes import THREADS, ProcessLimits, run_in_processes, usable_cores
from scopemap_bench.scripts.batch import POISONED, single_runs, trial, write_videos
from tests.support.front_door import call, refused
from tests.support.places import ROOT
from tests.support.process_tasks import FAULTS, LIMIT_S, WHATS, act, soon
from tests.support.result_files import batch_rows
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.cluster

NEEDS = WorkerNeeds(cores=1, memory_gb=0.5)
CLUSTER = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("ray", "moto", "s3fs")),
    reason="needs the extras cluster and dev",
)


@pytest.fixture(scope="module")
def ray_address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a Ray of this machine with two cores, begun as a user does, which ends with these tests."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    folder = tmp_path_factory.mktemp("ray")
    # Who has no token cannot connect.
    os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    words = ["ray", "start", "--head", "--block", "--port", address.rpartition(":")[2], "--num-cpus", "2"]
    words += ["--include-dashboard", "false", "--disable-usage-stats"]
    words += ["--object-store-memory", str(100 << 20), "--temp-dir", f"/tmp/ray-{os.getpid()}"]
    own = {name: value for name, value in os.environ.items() if name not in ("ORT_DISABLE_TELEMETRY", *THREADS)}
    own["PYTHONPATH"] = os.pathsep.join([str(ROOT), *sys.path])
    with (folder / "log").open("wb") as log:
        ray = subprocess.Popen(words, stdout=log, stderr=log, env=own)
    try:
        assert soon(lambda: b"Ray runtime started" in (folder / "log").read_bytes() or ray.poll() is not None)
        assert ray.poll() is None, (folder / "log").read_text()
        yield address
    finally:
        ray.terminate()
        ray.wait()
        shutil.rmtree(f"/tmp/ray-{os.getpid()}", ignore_errors=True)


@pytest.fixture(params=["processes", pytest.param("ray", marks=CLUSTER)])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Engine:
    """An engine whose workers find the modules of these tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *sys.path]))
    if request.param == "processes":
        return run_in_processes
    return RayEngine(NEEDS, request.getfixturevalue("ray_address"))


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


def test_a_worker_does_one_task_after_the_other_with_its_share_of_threads(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    tasks = [("work", tmp_path / f"{number}") for number in range(3)]
    found = {outcome.value for _, outcome in engine(act, tasks, ProcessLimits(1))}
    share = NEEDS.cores if isinstance(engine, RayEngine) else usable_cores()
    assert [threads for _, threads in found] == [str(share)]
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_processes_end_where_their_parent_is_killed(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\nfrom tests.support.process_tasks import act\n"
        "from scopemap.runner.processes import ProcessLimits, run_in_processes\n"
        f"if __name__ == '__main__':\n    list(run_in_processes(act, [('hang', Path({str(tmp_path / 'a')!r}))], "
        "ProcessLimits(1)))\n"
    )
    (tmp_path / "parent.py").write_text(code)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
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
def test_what_no_node_has_is_a_sentence(ray_address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.apps.batch.ray_engine._LONGEST_START_S", 3.0)
    engine = RayEngine(WorkerNeeds(1, 0.5, gpus=64), ray_address)
    with pytest.raises(InputError, match="no worker has started on Ray in 3 s: has a node the cores"):
        list(engine(act, [("work", tmp_path / "a")], ProcessLimits(1)))


@CLUSTER
def test_two_workers_of_a_ray_run_a_batch(ray_address: str, tmp_path: Path) -> None:
    for number in range(2):
        write_tiny(tmp_path / "archive" / f"colon_{number}", frames=4)
    words = ("batch", tmp_path / "archive", "--out", tmp_path / "out", "--engine", "ray", "--address", ray_address)
    needs = ("--workers", 2, "--worker-cores", 1, "--worker-memory", "500MB", "--quiet")
    assert call(*words, *needs, "--set", "mapping.triangulate_depth=false") == 0
    rows = batch_rows(tmp_path / "out" / "batch.csv")
    assert {name: row["status"] for name, row in rows.items()} == {"colon_0": "done", "colon_1": "done"}


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
        (("--engine", "ray"), "how many videos run at once on Ray? Give --workers"),
    ],
)
def test_what_an_engine_cannot_do_is_refused(
    options: tuple[object, ...], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.mp4").write_bytes(b"")
    assert said in refused(capfd, "batch", tmp_path / "a.mp4", "--out", tmp_path / "out", *options)
