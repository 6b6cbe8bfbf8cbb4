"""Depth errors: hand-computed figures, scaling, unknown pixels."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.evaluation.depth import evaluate_depth, mean_depth_report

TRUTH = np.array([[10.0, 20.0], [40.0, np.nan]], dtype=np.float32)


def test_figures_computed_by_hand() -> None:
    report = evaluate_depth(np.array([[11.0, 15.0], [60.0, 7.0]], dtype=np.float32), TRUTH)
    assert report.pixels == 3
    assert report.coverage == 1
    assert report.abs_rel == pytest.approx((0.1 + 0.25 + 0.5) / 3)
    assert report.sq_rel_mm == pytest.approx((1 / 10 + 25 / 20 + 400 / 40) / 3)
    assert report.rmse_mm == pytest.approx(np.sqrt((1 + 25 + 400) / 3))
    assert report.rmse_log == pytest.approx(np.sqrt((np.log(1.1) ** 2 + np.log(0.75) ** 2 + np.log(1.5) ** 2) / 3))
    assert report.mae_mm == pytest.approx((1 + 5 + 20) / 3)
    # Ratios 1.1, 1.333, 1.5 against 1.25, 1.5625, 1.953.
    assert [report.delta_1, report.delta_2, report.delta_3] == pytest.approx([1 / 3, 1, 1])


def test_delta_is_strict() -> None:
    assert evaluate_depth(np.array([[1.25]]), np.array([[1.0]])).delta_1 == 0


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.05, 20))
def test_median_scaling_removes_a_scale_and_none_shows_it(seed: int, scale: float) -> None:
    truth = np.random.default_rng(seed).uniform(5, 100, size=(12, 9))
    scaled = evaluate_depth(truth * scale, truth, scaling="median")
    assert scaled.scale == pytest.approx(1 / scale)
    assert [scaled.abs_rel, scaled.rmse_mm, scaled.rmse_log] == pytest.approx([0, 0, 0], abs=1e-9)
    unscaled = evaluate_depth(truth * scale, truth)
    assert unscaled.scale == 1
    assert unscaled.abs_rel == pytest.approx(abs(scale - 1))
    assert unscaled.rmse_log == pytest.approx(abs(np.log(scale)), abs=1e-9)


def test_unknown_and_impossible_predictions_lower_the_coverage_and_nothing_else() -> None:
    truth = np.full((2, 4), 10.0)
    predicted = np.array([[11.0, np.nan, 0.0, -3.0], [11.0, np.inf, 11.0, 11.0]])
    report = evaluate_depth(predicted, truth)
    assert (report.pixels, report.coverage) == (4, 0.5)
    assert report.abs_rel == pytest.approx(0.1)


def test_range_of_the_truth_is_exclusive() -> None:
    truth = np.array([[1.0, 50.0, 100.0, 120.0]])
    assert evaluate_depth(truth, truth, truth_range_mm=(1.0, 100.0)).pixels == 1


def test_nothing_to_compare_is_nan_not_zero() -> None:
    report = evaluate_depth(np.full((2, 2), np.nan), np.ones((2, 2)))
    assert (report.pixels, report.coverage) == (0, 0)
    assert all(np.isnan(value) for key, value in asdict(report).items() if key not in ("pixels", "coverage"))


def test_sizes_must_agree() -> None:
    with pytest.raises(ValueError, match="predicted_mm"):
        evaluate_depth(np.ones((2, 2)), np.ones((2, 3)))


def test_mean_is_over_images_and_leaves_out_empty_ones() -> None:
    small = evaluate_depth(np.full((1, 1), 12.0), np.full((1, 1), 10.0))
    large = evaluate_depth(np.full((10, 10), 14.0), np.full((10, 10), 10.0))
    empty = evaluate_depth(np.full((2, 2), np.nan), np.ones((2, 2)))
    mean = mean_depth_report([small, large, empty])
    assert mean.abs_rel == pytest.approx(0.3)
    assert mean.coverage == pytest.approx(2 / 3)
    assert np.isnan(mean_depth_report([empty]).abs_rel)
    assert np.isnan(mean_depth_report([]).abs_rel)
