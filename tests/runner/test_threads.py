"""Results do not depend on the number of threads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.places import ROOT

_SUMS = """
import scopemap.engine.geometry.warp, hashlib
import numpy as np
values = np.random.default_rng(0).normal(size=(2, 700_746))
print(hashlib.sha256(values[0] @ values[1]).hexdigest(), hashlib.sha256(np.linalg.norm(values[0])).hexdigest())
"""


_SET = "import os; print(os.environ.get('OPENBLAS_NUM_THREADS', ''))"
_IN_A_PROCESS = """
import numpy
from tests.support.process_tasks import threads_of_openblas
from scopemap.runner.processes import ProcessLimits, run_in_processes
if __name__ == "__main__":
    print(*(outcome.value for _, outcome in run_in_processes(threads_of_openblas, [None], ProcessLimits(1))))
    print(os.environ.get("OPENBLAS_NUM_THREADS", ""))
"""


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one core has one thread")
def test_sums_are_the_same_on_one_thread_and_two() -> None:
    known = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    command = [sys.executable, "-c", _SUMS]
    one, two = (
        subprocess.run(command, env=known | {"OMP_NUM_THREADS": count}, capture_output=True, text=True, check=True)
        for count in ("1", "2")
    )
    assert one.stdout == two.stdout != ""


@pytest.mark.parametrize(
    ("before", "set_to", "expected"),
    [("", "", "1"), ("", "3", "3"), ("import numpy", "", ""), ("import numpy", "3", "3")],
)
def test_only_a_numpy_that_is_loaded_later_has_one_thread(before: str, set_to: str, expected: str) -> None:
    assert _printed(f"{before}\nimport scopemap\n{_SET}", set_to) == expected


def test_a_process_that_loads_numpy_first_has_one_thread(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(f"import os\n{_IN_A_PROCESS}")
    assert _printed(str(tmp_path / "script.py")) == "1"


def _printed(code: str, set_to: str = "") -> str:
    """Run code, or a script, with so many threads of OpenBLAS asked for, "" for none; return what it prints."""
    known = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    known["PYTHONPATH"] = os.pathsep.join([str(ROOT), *sys.path])
    command = [sys.executable, code] if code.endswith(".py") else [sys.executable, "-c", code]
    asked = {"OPENBLAS_NUM_THREADS": set_to} if set_to else {}
    return subprocess.run(command, env=known | asked, capture_output=True, text=True, check=True).stdout.strip()
