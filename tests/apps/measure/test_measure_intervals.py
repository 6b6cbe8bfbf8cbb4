"""Intervals of measures against draws of the same errors, and what two measures have in common."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scopemap.apps.measure.intervals import SIGMAS, LogChanges

SIGMA = st.floats(0.0, 0.2)


@given(scale=SIGMA, own=st.lists(SIGMA, max_size=4), power=st.sampled_from([-1.0, 1.0, 2.0]))
def test_independent_sources_add_as_squares(scale: float, own: list[float], power: float) -> None:
    found = LogChanges.of_scale(scale)
    for sigma in own:
        found = found.times(LogChanges.of_own(sigma))
    low, high = found.to_power(power).factors
    expected = abs(power) * SIGMAS * float(np.linalg.norm([scale, *own]))
    assert np.log(high) == pytest.approx(expected)
    assert np.log(low) == pytest.approx(-expected)


def test_what_two_figures_share_cancels_in_their_ratio() -> None:
    shared = LogChanges(np.array([[-0.2, 0.2], [-0.1, 0.1], [0, 0]]), np.array([[-0.03, 0.03]]))
    low, high = shared.times(shared.to_power(-1)).factors
    assert np.log([low, high]) == pytest.approx(np.sqrt(2) * np.array([-0.03, 0.03]))


def test_a_source_that_only_lengthens_raises_the_upper_end_alone() -> None:
    low, high = LogChanges(own=np.array([[0.05, 0.04]])).factors
    assert (low, np.log(high)) == pytest.approx((1.0, 0.05))


def test_the_ends_are_those_of_drawn_errors() -> None:
    """A length of which one end is drawn nearer or farther, and aside: percentiles of a hundred thousand draws."""
    random = np.random.default_rng(0)
    depth, aside = np.exp(0.05 * random.normal(size=100_000)), 0.1 * random.normal(size=100_000)

    def length(depth: np.ndarray, aside: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.stack([3.0 * depth + aside, 10.0 * depth - 10.0], -1), axis=-1)

    ends = SIGMAS * np.array([-1.0, 1.0])
    by_depth, by_aside = length(np.exp(0.05 * ends), np.zeros(2)), length(np.ones(2), 0.1 * ends)
    factors = LogChanges(own=np.log(np.stack([by_depth, by_aside]) / 3.0)).factors
    low, high = np.percentile(length(depth, aside) / 3.0, [2.5, 97.5])
    assert factors == pytest.approx((low, high), abs=0.05)
