"""Depth under highlights: a plane in closed form, what stays as it is."""

from __future__ import annotations

import numpy as np
import pytest

from scopemap.engine.depth.under_highlights import depth_under_highlights, small_highlights

HEIGHT, WIDTH = 90, 160


def _wall_mm() -> np.ndarray:
    """A wall whose depth grows by the same share with each column."""
    return np.tile(40 * np.exp(0.002 * np.arange(WIDTH, dtype=np.float32)), (HEIGHT, 1))


def _highlight(row: int, column: int, radius_px: float) -> np.ndarray:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.hypot(rows - row, columns - column) <= radius_px


def test_a_dent_under_a_highlight_goes() -> None:
    highlight, wall_mm = _highlight(40, 70, 4), _wall_mm()
    # The dent is a little wider than what is seen to be bright.
    dented_mm = np.where(_highlight(40, 70, 4.5), wall_mm * np.float32(1.2), wall_mm)
    np.testing.assert_allclose(depth_under_highlights(dented_mm, highlight), wall_mm, rtol=0.005)


def test_depth_elsewhere_and_unknown_depth_stay() -> None:
    highlight, depth_mm = _highlight(40, 70, 4), _wall_mm()
    depth_mm[:, 73:80] = np.nan
    found_mm = depth_under_highlights(depth_mm, highlight)
    away = ~_highlight(40, 70, 7)
    np.testing.assert_array_equal(found_mm[away], depth_mm[away])
    np.testing.assert_array_equal(np.isnan(found_mm), np.isnan(depth_mm))
    np.testing.assert_allclose(found_mm[:, :73], _wall_mm()[:, :73], rtol=0.01)


@pytest.mark.parametrize("highlights", [None, np.zeros((HEIGHT, WIDTH), bool), np.ones((HEIGHT, WIDTH), bool)])
def test_without_small_highlights_nothing_changes(highlights: np.ndarray | None) -> None:
    depth_mm = _wall_mm()
    np.testing.assert_array_equal(depth_under_highlights(depth_mm, highlights), depth_mm)


def test_large_highlights_and_those_at_the_border_are_not_small() -> None:
    small, large, at_border = _highlight(20, 20, 3), _highlight(60, 100, 14), _highlight(3, 130, 3)
    np.testing.assert_array_equal(small_highlights(small | large | at_border), small)
