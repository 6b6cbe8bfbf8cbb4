"""What all tests share: threads, where the real data lie, and which tests are quick."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path

import pytest

# Tests that run side by side share the cores. OpenBLAS takes all of them for each process, and its threads spin while
# they wait: two modules took 37 s of processor time in place of 24. Set before numpy is loaded.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    os.environ.setdefault("OMP_NUM_THREADS", str(max(cores // int(workers), 1)))
_DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data"
# What a quick test does without.
NOT_QUICK = ("slow", "real", "networks", "dev", "browser", "cluster")
# A file of which no test is quick.
NOTHING_QUICK = re.compile(rf"^pytestmark = \[?\s*pytest\.mark\.({'|'.join(NOT_QUICK)})\b", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files without quick tests where only these are asked for: importing torch and others takes seconds."""
    if config.option.markexpr != "quick" or collection_path.suffix != ".py":
        return None
    return NOTHING_QUICK.search(collection_path.read_text(encoding="utf-8")) is not None or None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that take little and need nothing: `pytest -m quick`."""
    for item in items:
        if not any(item.get_closest_marker(name) for name in NOT_QUICK):
            item.add_marker("quick")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real frames and weights (docs/install.md, "Tests"); the test skips where it is absent."""
    folder = Path(os.environ.get("SCOPEMAP_REAL_DATA", _DEFAULT))
    if not folder.is_dir():
        pytest.skip(f"real data not found in {folder}; set SCOPEMAP_REAL_DATA to run this test")
    return folder


@pytest.fixture
def short_films(monkeypatch: pytest.MonkeyPatch) -> None:
    """Films of a surface that turns have 12 frames in place of 180."""
    from scopemap.report import films

    monkeypatch.setattr(films, "write_turntable", partial(films.write_turntable, frames=12))
