"""Disparity to depth: the optimiser against its closed form, and the affine fit against known scale and shift."""

from __future__ import annotations

import numpy as np
import pytest

from scopemap.engine.depth.pseudo_stereo import (
    fit_affine_disparity,
    fit_baseline_lbfgsb,
)
from scopemap.engine.errors import InputError


def closed_form(depth_mm: np.ndarray, disparity: np.ndarray, focal_px: float) -> float:
    """B = sum(D g) / sum(g g) with g = f / d: the minimum of the mean of (D - f B / d)^2."""
    per_baseline = focal_px / disparity
    return float(np.sum(depth_mm * per_baseline) / np.sum(per_baseline**2))


def test_a_true_baseline_comes_back_in_spite_of_unknown_and_far_pixels() -> None:
    depth_mm = np.linspace(10, 90, 400).reshape(20, 20)
    disparity = 570.0 * 4.3 / depth_mm
    depth_mm[0, 0], depth_mm[1, 1], disparity[2, 2] = np.nan, -1.0, np.nan
    disparity[3], disparity[4] = 0.0, 1e-9
    assert fit_baseline_lbfgsb(depth_mm, disparity, 570.0, 0.1) == pytest.approx(4.3, rel=1e-9)
    used = np.isfinite(depth_mm) & (depth_mm > 0) & (disparity > 0)
    dominated_mm = closed_form(depth_mm[used], disparity[used], 570.0)
    assert fit_baseline_lbfgsb(depth_mm, disparity, 570.0) == pytest.approx(dominated_mm, rel=1e-6)
    assert dominated_mm < 1e-3  # by the far pixels


def test_no_pixel_to_fit_a_baseline_to_is_an_error() -> None:
    with pytest.raises(InputError, match="no pixel"):
        fit_baseline_lbfgsb(np.ones(10), np.zeros(10), 300.0)


def test_a_fifth_of_wrong_pixels_hardly_moves_the_fit() -> None:
    rng = np.random.default_rng(3)
    depth_mm = rng.uniform(15, 100, 5000)
    disparity = (1 / depth_mm - 0.008) / 0.07 + rng.normal(0, 0.01, depth_mm.size)
    wrong = rng.random(depth_mm.size) < 0.2
    disparity[wrong] = rng.uniform(0, 1, int(wrong.sum()))
    found = fit_affine_disparity(depth_mm, disparity, 300.0)
    plain = np.polyfit(disparity, 1 / depth_mm, 1)
    error_mm = np.abs(found.depth_mm(disparity[~wrong]) - depth_mm[~wrong])
    assert np.median(error_mm) < 2.0
    assert np.median(error_mm) < 0.5 * np.median(np.abs(1 / np.polyval(plain, disparity[~wrong]) - depth_mm[~wrong]))


def test_depth_stays_positive_over_the_range_of_the_fit() -> None:
    """A line through these pixels crosses zero before the farthest of them: the fit must not."""
    disparity = np.concatenate([np.linspace(0.5, 1, 200), [0.0]])
    depth_mm = np.concatenate([1 / (0.1 * np.linspace(0.5, 1, 200) - 0.04), [80.0]])
    found = fit_affine_disparity(depth_mm, disparity, 150.0)
    converted = found.depth_mm(disparity)
    assert np.isfinite(converted).all()
    assert converted[-1] == pytest.approx(150.0, rel=1e-5)
    assert (np.diff(converted[:-1]) < 0).all()


@pytest.mark.parametrize("disparity", [np.full(100, 0.3), np.full(100, np.nan), np.zeros(100)])
def test_constant_or_unknown_disparity_is_refused(disparity: np.ndarray) -> None:
    with pytest.raises(InputError, match="constant or empty"):
        fit_affine_disparity(np.linspace(10, 50, 100), disparity, 300.0)


def test_depth_taken_for_disparity_is_refused_with_advice() -> None:
    depth_mm = np.linspace(10, 50, 100)
    with pytest.raises(InputError, match=r"depth\.files_kind=depth"):
        fit_affine_disparity(depth_mm, depth_mm / 255, 300.0)
