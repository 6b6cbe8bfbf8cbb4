"""The table of real clips: its figures have closed forms, and its clips are where the data are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from scopemap.result.result import Result
from scopemap_bench.scripts import real


def _pairs(*factors: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    true_mm = np.linspace(20, 60, 600).reshape(20, 30)
    return ((true_mm * factor, true_mm) for factor in factors)


def test_a_depth_of_another_scale_is_right_in_one_scale(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(real, "depth_pairs", lambda run, truth: _pairs(2, 2, 2, 2, 2))
    found = real.depth_figures(Result(tmp_path), tmp_path, None)
    assert found["abs_rel"] == pytest.approx(0, abs=1e-9)
    assert found["one_scale"] == pytest.approx(0, abs=1e-9)
    assert found["correlation"] == pytest.approx(1)
    assert found["spread"] == pytest.approx(0, abs=1e-9)
    # In the scale of a path that says that the run's millimetres are right, it is twice as deep.
    assert real.depth_figures(Result(tmp_path), tmp_path, 1.0)["one_scale"] == pytest.approx(1)


def test_a_scale_that_changes_from_frame_to_frame_is_seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(real, "depth_pairs", lambda run, truth: _pairs(0.9, 1.0, 1.1))
    found = real.depth_figures(Result(tmp_path), tmp_path, None)
    assert found["abs_rel"] == pytest.approx(0, abs=1e-9)
    assert found["spread"] == pytest.approx(np.std(np.log([0.9, 1.0, 1.1])))
    assert found["one_scale"] == pytest.approx(0.2 / 3)


def test_an_inside_out_depth_has_the_opposite_correlation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    true_mm = np.exp(np.linspace(3, 4, 600)).reshape(20, 30)
    monkeypatch.setattr(real, "depth_pairs", lambda run, truth: [(np.exp(7) / true_mm, true_mm)])
    assert real.depth_figures(Result(tmp_path), tmp_path, None)["correlation"] == pytest.approx(-1)


@pytest.mark.real
@pytest.mark.skipif("SCOPEMAP_REAL_DATA" not in os.environ, reason="SCOPEMAP_REAL_DATA names no folder of real data")
def test_the_clips_and_their_truth_are_there() -> None:
    for clip in real.clips(Path(os.environ["SCOPEMAP_REAL_DATA"])):
        assert clip.source.exists(), clip.name
        assert clip.pairs is None or clip.pairs.is_file(), clip.name
