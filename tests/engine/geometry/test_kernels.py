"""Kernels read and write their arrays alone: compiled, they do not check; as plain Python, they raise `IndexError`."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
@pytest.mark.parametrize(
    "tests",
    ["engine/fusion/test_texture.py::test_a_chart_is_painted_in_its_colours", "engine/geometry/test_median.py"],
)
def test_kernels_pass_their_tests_as_plain_python(tests: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"tests/{tests}"]
    run = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout[-3000:]
