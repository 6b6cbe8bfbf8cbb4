"""Flow kept on disk: estimated once, the same for every method, whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.flow.estimator import FlowPair
from scopemap_bench.scoring import flow_to_previous


class Counting(DisFlow):
    """DIS that counts how often it is asked."""

    asked = 0

    def estimate_checked(self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: FlowPair | None = None) -> FlowPair:
        type(self).asked += 1
        return super().estimate_checked(rgb_from, rgb_to, start)


def pair() -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(0).integers(0, 255, (70, 90, 3)).astype(np.uint8)
    picture = np.kron(noise[:14, :18], np.ones((5, 5, 1), np.uint8))
    return picture, np.roll(picture, 2, axis=1)


def test_what_is_read_back_is_what_was_first_returned(tmp_path: Path) -> None:
    Counting.asked = 0
    first = flow_to_previous(Counting(), 7, *pair(), tmp_path / "dis")
    once = Counting.asked
    again = flow_to_previous(Counting(), 7, *pair(), tmp_path / "dis")
    assert (once, Counting.asked) == (1, 1)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    assert np.median(first[0][..., 0][first[1]]) < -1.5
    assert [file.name for file in (tmp_path / "dis").iterdir()] == ["000007.npz"]
