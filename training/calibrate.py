"""The last touch: range and uncertainty of a trained network made right on average, on pictures of its training scenes.

Under a loss of absolute errors a network that is unsure says less than it sees: the range of its distances comes out
compressed, by a factor that hardly differs between pictures, and its spread is as good as its last steps. Both are two
numbers, fitted here and folded into the last convolution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize_scalar

from training.buffers import Store
from training.network import TYPICAL_LOG_MM, ScopeNet
from training.samples import make_sample

_SEED = 88
_PICTURES = 240
_PIXELS = 400
_RANGE = (0.5, 2.5)


class Calibration(NamedTuple):
    """How a network's answers are changed.

    exponent : factor of ln distance about `pivot`. pivot : ln of mm, the mean over the pictures. spread : factor of the
    Laplace scale.
    """

    exponent: float
    pivot: float
    spread: float


def fit_calibration(network: ScopeNet, stores: list[Store]) -> Calibration:
    """Return the calibration of a network on fresh pictures of the scenes in `stores`, as many of each."""
    rng = np.random.default_rng(_SEED)
    given, true, log_spread, levels = [], [], [], []
    for n in range(_PICTURES):
        store = stores[n % len(stores)]
        sample = make_sample(store[int(rng.integers(len(store)))], np.random.default_rng((_SEED, n)))
        known = np.flatnonzero((np.isfinite(sample.log_distance) & sample.valid).ravel())
        if known.size < _PIXELS:
            continue
        known = rng.choice(known, _PIXELS, replace=False)
        with torch.inference_mode():
            answer = network(torch.from_numpy(sample.planes)[None])[0].numpy().reshape(2, -1)[:, known]
        truth = sample.log_distance.ravel()[known]
        given.append(answer[0] - np.median(answer[0]))
        true.append(truth - np.median(truth))
        levels.append(np.median(answer[0]))
        log_spread.append(answer[1])
    x, y, spreads = np.concatenate(given), np.concatenate(true), np.exp(np.concatenate(log_spread))
    fit = minimize_scalar(lambda e: float(np.abs(y - e * x).mean()), bounds=_RANGE, method="bounded")
    exponent = float(fit.x)
    # The median of |error| / b of a Laplace distribution is ln 2: outliers have no say in it.
    spread = float(np.median(np.abs(y - exponent * x) / spreads) / np.log(2))
    return Calibration(exponent, float(np.mean(levels)), spread)


def calibrated(network: ScopeNet, calibration: Calibration) -> ScopeNet:
    """Return the network, changed in place, whose answers are those of before, calibrated."""
    head, exponent = network.head, calibration.exponent
    assert head.bias is not None
    with torch.no_grad():
        # pivot + e (typical + h - pivot) = typical + e h + (e - 1) (typical - pivot), h what the head says.
        head.weight[0] *= exponent
        head.bias[0] = exponent * head.bias[0] + (exponent - 1) * (TYPICAL_LOG_MM - calibration.pivot)
        head.bias[1] += float(np.log(calibration.spread))
    return network
