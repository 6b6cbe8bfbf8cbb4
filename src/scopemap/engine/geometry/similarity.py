"""Structural similarity of two pictures (SSIM; Wang et al., IEEE TIP 2004)."""

from __future__ import annotations

import numpy as np

from scopemap.engine.geometry.kernels import UInt8_2d, inner_kernel, kernel

_WINDOW_PX = 7  # Wang et al. 2004 with scikit-image's default window
_SAMPLE = _WINDOW_PX**2 / (_WINDOW_PX**2 - 1)  # of a sample's covariance
_C1 = (0.01 * 255) ** 2  # Wang, section III.B
_C2 = (0.03 * 255) ** 2  # Wang et al. 2004: K2 = 0.03


@kernel
def structural_similarity(grey_a: UInt8_2d, grey_b: UInt8_2d) -> np.ndarray:
    """Return the structural similarity (H, W) float64, -1..1, of two (H, W) uint8 images in 7 x 7 px (Wang, eq. 13).

    Beyond the border the images are mirrored, its pixels twice.
    """
    height, width = grey_a.shape
    radius, share = _WINDOW_PX // 2, 1.0 / _WINDOW_PX**2
    similarity = np.empty((height, width))
    # Whole numbers, so that adding what comes into the window and taking away what leaves it rounds nothing.
    columns, window = np.zeros((width, 5), np.int64), np.zeros(5, np.int64)
    for row in range(-radius, radius):
        _add_row(columns, grey_a, grey_b, _mirrored(row, height), 1)
    for row in range(height):
        _add_row(columns, grey_a, grey_b, _mirrored(row + radius, height), 1)
        window[:] = 0
        for col in range(-radius, radius):
            window += columns[_mirrored(col, width)]
        for col in range(width):
            entering, leaving = _mirrored(col + radius, width), _mirrored(col - radius, width)
            for n in range(5):
                window[n] += columns[entering, n]
            mean_a, mean_b = share * window[0], share * window[1]
            square_a, square_b, product = share * window[2], share * window[3], share * window[4]
            variances = _SAMPLE * (square_a + square_b - mean_a * mean_a - mean_b * mean_b)
            covariance = _SAMPLE * (product - mean_a * mean_b)
            luminance = (2 * mean_a * mean_b + _C1) / (mean_a * mean_a + mean_b * mean_b + _C1)
            similarity[row, col] = luminance * (2 * covariance + _C2) / (variances + _C2)
            for n in range(5):
                window[n] -= columns[leaving, n]
        _add_row(columns, grey_a, grey_b, _mirrored(row - radius, height), -1)
    return similarity


@inner_kernel
def _add_row(columns: np.ndarray, grey_a: np.ndarray, grey_b: np.ndarray, row: int, sign: int) -> None:
    """Add, or take away, a row's levels, their squares and products to the sums (W, 5) of each column."""
    for col in range(len(columns)):
        a, b = np.int64(grey_a[row, col]), np.int64(grey_b[row, col])
        columns[col, 0] += sign * a
        columns[col, 1] += sign * b
        columns[col, 2] += sign * a * a
        columns[col, 3] += sign * b * b
        columns[col, 4] += sign * a * b


@inner_kernel
def _mirrored(place: int, count: int) -> int:
    """Return which of `count` places is seen at one beyond them."""
    while not 0 <= place < count:
        place = -1 - place if place < 0 else 2 * count - 1 - place
    return place
