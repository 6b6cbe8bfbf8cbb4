"""The median of kernels is numpy's, of any number of values and with equal ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.geometry.kernels import kernel
from scopemap.engine.geometry.median import median


# A cached kernel would be the one of an earlier median.
@kernel(cache=False)
def _medians(rows):  # type: ignore[no-untyped-def]
    found = np.empty(len(rows))
    for n in range(len(rows)):
        found[n] = median(rows[n].copy())
    return found


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.integers(1, 12), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_it_is_the_median(count: int, levels: int, seed: int) -> None:
    rows = np.random.default_rng(seed).integers(-levels, levels, (20, count)) / 2
    np.testing.assert_array_equal(_medians(rows), np.median(rows, axis=1))
