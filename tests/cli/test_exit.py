"""A command that has loaded networks ends without a word from their libraries."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.networks
def test_torch_and_triton_say_nothing_at_exit() -> None:
    pytest.importorskip("triton", reason="torch's CPU wheels come without triton")
    code = "import sys, triton; sys.argv = ['scopemap', '--version']; from scopemap.cli.app import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
