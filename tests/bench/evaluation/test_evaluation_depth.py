"""Depth errors: hand-computed figures, scaling of images and sequences, caps, unknown pixels, jitter of the scale."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.errors import SettingsError
from scopemap_bench.evaluation.depth import (
    DEPTH_RANGES_MM,
    depth_scale,
    evaluate_depth,
    evaluate_depth_sequence,
    fit_sequence,
    mean_depth_report,
    metric_consistency,
    scale_jitter,
)

TRUTH = np.array([[10.0, 20.0], [40.0, np.nan]], dtype=np.float32)
ALL = (1e-3, float("inf"))


def test_figures_computed_by_hand() -> None:
    report = evaluate_depth(np.array([[11.0, 15.0], [60.0, 7.0]], dtype=np.float32), TRUTH)
    assert report["pixels"] == 3
    assert report["coverage"] == 1
    assert report["abs_rel"] == pytest.approx((0.1 + 0.25 + 0.5) / 3)
    assert report["sq_rel_mm"] == pytest.approx((1 / 10 + 25 / 20 + 400 / 40) / 3)
    assert report["rmse_mm"] == pytest.approx(np.sqrt((1 + 25 + 400) / 3))
    assert report["rmse_log"] == pytest.approx(np.sqrt((np.log(1.1) ** 2 + np.log(0.75) ** 2 + np.log(1.5) ** 2) / 3))
    assert report["mae_mm"] == pytest.approx((1 + 5 + 20) / 3)
    # Ratios 1.1, 1.333, 1.5 against 1.25, 1.5625, 1.953.
    assert [report["delta_1"], report["delta_2"], report["delta_3"]] == pytest.approx([1 / 3, 1, 1])


def test_delta_is_strict() -> None:
    assert evaluate_depth(np.array([[1.25]]), np.array([[1.0]]))["delta_1"] == 0
    assert evaluate_depth(np.array([[1.25**2]]), np.array([[1.0]]))["delta_2"] == 0
    assert evaluate_depth(np.array([[1.0]]), np.array([[1.25**3]]))["delta_3"] == 0
    assert evaluate_depth(np.array([[1.2499]]), np.array([[1.0]]))["delta_1"] == 1


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.05, 20))
def test_median_scaling_removes_a_scale_and_none_shows_it(seed: int, scale: float) -> None:
    truth = np.random.default_rng(seed).uniform(5, 100, size=(12, 9))
    scaled = evaluate_depth(truth * scale, truth, scaling="median")
    assert scaled["scale"] == pytest.approx(1 / scale)
    assert [scaled["abs_rel"], scaled["rmse_mm"], scaled["rmse_log"]] == pytest.approx([0, 0, 0], abs=1e-9)
    unscaled = evaluate_depth(truth * scale, truth)
    assert unscaled["scale"] == 1
    assert unscaled["abs_rel"] == pytest.approx(abs(scale - 1))
    assert unscaled["rmse_log"] == pytest.approx(abs(np.log(scale)), abs=1e-9)


def test_unknown_and_impossible_predictions_lower_the_coverage_and_nothing_else() -> None:
    truth = np.full((2, 4), 10.0)
    predicted = np.array([[11.0, np.nan, 0.0, -3.0], [11.0, np.inf, 11.0, 11.0]])
    report = evaluate_depth(predicted, truth)
    assert (report["pixels"], report["coverage"]) == (4, 0.5)
    assert report["abs_rel"] == pytest.approx(0.1)


def test_range_of_the_truth_is_exclusive() -> None:
    truth = np.array([[1.0, 50.0, 100.0, 120.0]])
    assert evaluate_depth(truth, truth, truth_range_mm=(1.0, 100.0))["pixels"] == 1


def test_nothing_to_compare_is_nan_not_zero() -> None:
    report = evaluate_depth(np.full((2, 2), np.nan), np.ones((2, 2)))
    assert (report["pixels"], report["coverage"]) == (0, 0)
    figures = {key: value for key, value in report.items() if key not in ("scaling", "pixels", "coverage")}
    assert np.isnan(list(figures.values())).all()


def test_mean_is_over_images_and_leaves_out_empty_ones() -> None:
    small = evaluate_depth(np.full((1, 1), 12.0), np.full((1, 1), 10.0))
    large = evaluate_depth(np.full((10, 10), 14.0), np.full((10, 10), 10.0))
    empty = evaluate_depth(np.full((2, 2), np.nan), np.ones((2, 2)))
    mean = mean_depth_report([small, large, empty])
    assert mean["abs_rel"] == pytest.approx(0.3)
    assert mean["coverage"] == pytest.approx(2 / 3)
    assert np.isnan(mean_depth_report([empty])["abs_rel"])
    assert np.isnan(mean_depth_report([])["abs_rel"])


# ---- scale and shift, clipping


def test_scale_and_shift_is_the_least_squares_solution() -> None:
    rng = np.random.default_rng(3)
    truth, predicted = rng.uniform(5, 100, (2, 30, 20))
    unknown = np.where(rng.random(truth.shape) < 0.2, np.nan, truth)
    known = np.isfinite(unknown)
    design = np.stack([1 / predicted[known], np.ones(known.sum())], -1)
    slope, shift = np.linalg.lstsq(design, 1 / truth[known], rcond=None)[0]
    report = evaluate_depth(predicted, unknown, scaling="scale-and-shift")
    assert (1 / report["scale"], report["shift_per_mm"]) == pytest.approx((slope, shift))
    scaled = 1 / (slope / predicted[known] + shift)
    assert report["mae_mm"] == pytest.approx(np.mean(np.abs(scaled - truth[known])))


def test_prediction_without_variation_becomes_the_mean_disparity_of_the_truth() -> None:
    report = evaluate_depth(np.full((1, 2), 7.0), np.array([[10.0, 30.0]]), scaling="scale-and-shift")
    assert report["scale"] == float("inf")
    assert 1 / report["shift_per_mm"] == pytest.approx(15)
    assert report["mae_mm"] == pytest.approx((5 + 15) / 2)


def test_clipping_follows_scaling_and_leaves_the_choice_of_pixels() -> None:
    truth = np.array([[100.0, 100.0, 140.0, 170.0]])
    predicted = np.array([[50.0, 50.0, 90.0, 50.0]])
    limits = DEPTH_RANGES_MM["scared"]
    free = evaluate_depth(predicted, truth, scaling="median", truth_range_mm=limits)
    clipped = evaluate_depth(predicted, truth, scaling="median", truth_range_mm=limits, clip_prediction=True)
    # 170 lies beyond the cap; 90 becomes 180, which is clipped to 150.
    assert (free["pixels"], clipped["pixels"], clipped["scale"]) == (3, 3, 2)
    assert (free["mae_mm"], clipped["mae_mm"]) == pytest.approx((40 / 3, 10 / 3))


def test_an_unknown_scaling_is_refused() -> None:
    with pytest.raises(SettingsError, match="'mean': choose one of none, median, scale-and-shift"):
        evaluate_depth(TRUTH, TRUTH, scaling="mean")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="sequence-median"):
        evaluate_depth(TRUTH, TRUTH, scaling="sequence-median")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="sequence-scale-and-shift"):
        evaluate_depth_sequence(list, scaling="mean")  # type: ignore[arg-type]


# ---- sequences


class Frames:
    """A factory of frames that counts how often it is asked for them."""

    def __init__(self, frames: list[tuple[np.ndarray, np.ndarray]]) -> None:
        self.frames, self.passes = frames, 0

    def __call__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        self.passes += 1
        for predicted, truth in self.frames:
            yield predicted.copy(), truth.copy()


def flickering(factors: list[float]) -> Frames:
    truths = np.random.default_rng(1).uniform(5, 100, (len(factors), 12, 9))
    return Frames([(truth / factor, truth) for truth, factor in zip(truths, factors, strict=True)])


def test_one_scale_for_the_sequence_shows_the_flicker_that_a_scale_per_image_hides() -> None:
    frames = flickering([2.0, 2.2, 2.0])
    hidden = evaluate_depth_sequence(frames, scaling="median")
    assert frames.passes == 1
    assert hidden.mean["abs_rel"] == pytest.approx(0, abs=1e-9)
    shown = evaluate_depth_sequence(frames, scaling="sequence-median")
    assert frames.passes == 3
    assert [frame["scale"] for frame in shown.frames] == [shown.fit.scale] * 3
    s = shown.fit.scale
    assert shown.mean["abs_rel"] == pytest.approx(np.mean([abs(s / 2 - 1), abs(s / 2.2 - 1), abs(s / 2 - 1)]))
    assert (shown.scaling, shown.mean["scaling"], hidden.mean["scaling"]) == (
        "sequence-median",
        "sequence-median",
        "median",
    )
    for report in (hidden, shown):
        assert report.jitter["frames"] == 3
        assert report.jitter["log_step"] == pytest.approx(np.log(1.1))
        assert report.jitter["log_std"] == pytest.approx(np.log(1.1) * np.sqrt(2) / 3)


def test_metric_consistency_is_the_truth_over_depth_in_the_scale_of_the_path() -> None:
    scales = evaluate_depth_sequence(flickering([2.0, 2.2, 1.8]), scaling="median").scales
    found = metric_consistency(np.append(scales, np.nan), path_scale=2.0)
    assert found["frames"] == pytest.approx([1.0, 1.1, 0.9])
    assert (found["least"], found["median"], found["most"]) == pytest.approx((0.9, 1.0, 1.1))
    assert metric_consistency(np.array([np.nan]), path_scale=2.0) == {}


def test_sequence_median_is_the_ratio_of_the_pooled_medians() -> None:
    rng = np.random.default_rng(5)
    frames = [(rng.uniform(0.1, 9, (7, n)), rng.uniform(5, 100, (7, n))) for n in (3, 40)]
    frames[1][0][0] = np.nan
    known = [np.isfinite(predicted) for predicted, _ in frames]
    d, g = (np.concatenate([pair[i][k] for pair, k in zip(frames, known, strict=True)]) for i in (0, 1))
    fit = fit_sequence(Frames(frames), "sequence-median", ALL)
    assert fit.scale == pytest.approx(np.median(g) / np.median(d), rel=3e-5)


def test_sequence_scale_and_shift_is_least_squares_over_the_pixels_of_all_frames() -> None:
    rng = np.random.default_rng(6)
    frames = [(rng.uniform(0.1, 9, (7, n)), rng.uniform(5, 100, (7, n))) for n in (3, 40, 11)]
    d, g = (np.concatenate([pair[i].ravel() for pair in frames]) for i in (0, 1))
    slope, shift = np.linalg.lstsq(np.stack([1 / d, np.ones_like(d)], -1), 1 / g, rcond=None)[0]
    fit = fit_sequence(Frames(frames), "sequence-scale-and-shift", ALL)
    assert (1 / fit.scale, fit.shift_per_mm) == pytest.approx((slope, shift))
    whole = [(d[None], g[None])]
    alone = evaluate_depth(*whole[0], scaling="scale-and-shift")
    assert evaluate_depth_sequence(Frames(whole), scaling="sequence-scale-and-shift").mean["rmse_mm"] == pytest.approx(
        alone["rmse_mm"]
    )


def test_frames_without_truth_break_no_sequence() -> None:
    nothing = (np.ones((2, 2)), np.full((2, 2), np.nan))
    frames = Frames([(TRUTH / 2, TRUTH), nothing, (TRUTH / 2, TRUTH)])
    report = evaluate_depth_sequence(frames, scaling="sequence-median")
    assert report.fit.scale == pytest.approx(2, rel=3e-5)
    assert report.mean["abs_rel"] < 1e-4
    assert (report.jitter["frames"], report.jitter["log_std"]) == (2, 0)
    assert np.isnan(report.jitter["log_step"])
    for scaling in ("sequence-median", "sequence-scale-and-shift"):
        empty = evaluate_depth_sequence(Frames([nothing]), scaling=scaling)  # type: ignore[arg-type]
        assert (empty.fit.scale, empty.mean["pixels"]) == (1, 0)
        assert np.isnan(empty.mean["abs_rel"])


# ---- jitter


def test_jitter_of_factors_computed_by_hand() -> None:
    jitter = scale_jitter(np.array([1.0, np.e, np.nan, np.e, 1.0, np.e**3]))
    assert jitter["frames"] == 5
    assert jitter["log_std"] == pytest.approx(np.std([0, 1, 1, 0, 3]))
    assert jitter["log_step"] == pytest.approx((1 + 1 + 3) / 3)
    assert np.isnan(scale_jitter(np.array([2.0]))["log_std"])
    assert np.isnan(scale_jitter(np.array([]))["log_step"])


def test_factor_of_a_frame_is_the_median_of_the_ratios() -> None:
    predicted = np.array([[1.0, 2.0, 4.0, 0.0]])
    truth = np.array([[10.0, 30.0, 4.0, 5.0]])
    assert depth_scale(predicted, truth) == 10
    assert depth_scale(predicted, truth, (11.0, 40.0)) == 15
    assert np.isnan(depth_scale(predicted, np.full((1, 4), np.nan)))
