"""The median within kernels: numba takes four times as long to compile its own, in each kernel again."""

from __future__ import annotations

import numpy as np

from scopemap.engine.geometry.kernels import inner_kernel


@inner_kernel
def median(values: np.ndarray) -> float:
    """Return the median of (N,) float64, N > 0, none NaN; it changes their order."""
    half = values.size // 2
    upper = _smallest(values, half)
    if values.size % 2:
        return upper
    lower = values[0]
    for n in range(1, half):
        lower = max(lower, values[n])
    return (lower + upper) / 2


@inner_kernel
def _smallest(values: np.ndarray, rank: int) -> float:
    """Return the value of a rank, from 0 on, with no larger one before it: Hoare's selection (CACM 4, 1961, 65)."""
    low, high = 0, values.size - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]
