"""Results do not depend on the number of threads."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

_SUMS = """
import scopemap.engine.geometry.warp, hashlib
import numpy as np
values = np.random.default_rng(0).normal(size=(2, 700_746))
print(hashlib.sha256(values[0] @ values[1]).hexdigest(), hashlib.sha256(np.linalg.norm(values[0])).hexdigest())
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
