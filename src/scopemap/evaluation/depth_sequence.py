"""Depth of a whole sequence against its truth: one scale for all frames, and how the scale jitters from frame to frame.

Scaling every image by its own median hides flicker. Here one factor, or one scale and shift in disparity as in
Video-Depth-Anything (arXiv 2501.12375), serves all frames; the jitter of the per-frame factor is reported beside it.
No more than one frame is held in memory: frames come from a factory that is called once per pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import get_args

import numpy as np

from scopemap.errors import SettingsError
from scopemap.evaluation.depth import (
    DepthFit,
    DepthReport,
    DepthScaling,
    ImageScaling,
    compared_depths,
    disparity_fit,
    evaluate_depth,
    mean_depth_report,
)

DepthPairs = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]
"""Gives the frames, in order, anew at every call: (predicted, true), (H, W) each, mm, NaN = unknown."""

# Bins of the logarithm of depth: medians read off them are exact to 1e-5 of their value, in bounded memory.
_LOG_RANGE = (float(np.log(1e-4)), float(np.log(1e6)))
_LOG_STEP = 2e-5


@dataclass(frozen=True)
class ScaleJitter:
    """How the factor s_t = median(g / d) from prediction to truth varies over the frames; any one scale cancels.

    Attributes
    ----------
    frames : frames with a factor.
    log_std : standard deviation (by N) of ln s_t. NaN below two frames.
    log_step : mean |ln s_{t+1} - ln s_t| over consecutive frames that both have one; NaN where there are none.
    """

    frames: int
    log_std: float
    log_step: float


@dataclass(frozen=True)
class DepthSequenceReport:
    """Depth errors of a sequence.

    Attributes
    ----------
    scaling : what was done to the prediction; fit : the one fit of a sequence mode, the identity in other modes.
    mean : over the frames; frames : each frame's report, in order.
    jitter : of the prediction as given.
    """

    scaling: DepthScaling
    fit: DepthFit
    mean: DepthReport
    frames: tuple[DepthReport, ...]
    jitter: ScaleJitter


def evaluate_depth_sequence(
    pairs: DepthPairs,
    *,
    scaling: DepthScaling = "none",
    truth_range_mm: tuple[float, float] = (1e-3, float("inf")),
    clip_prediction: bool = False,
) -> DepthSequenceReport:
    """Return the errors of a sequence of depth maps, averaged over frames.

    Parameters
    ----------
    pairs : factory of the frames; called twice for the sequence modes, once for the others.
    scaling : `sequence-median`: one factor, the median of all true depths over the median of all predicted ones (not
        the median of the ratios), over the compared pixels of all frames. `sequence-scale-and-shift`: one least-squares
        fit in disparity over them. Else each frame for itself, as `evaluate_depth`.
    truth_range_mm, clip_prediction : as in `evaluate_depth`.
    """
    if scaling not in get_args(DepthScaling):
        raise SettingsError(f"depth scaling '{scaling}': choose one of {', '.join(get_args(DepthScaling))}")
    of_sequence = scaling in ("sequence-median", "sequence-scale-and-shift")
    fit = fit_sequence(pairs, scaling, truth_range_mm) if of_sequence else DepthFit(scaling)
    each: ImageScaling | DepthFit = fit if of_sequence else scaling  # type: ignore[assignment]
    frames, scales = [], []
    for predicted_mm, truth_mm in pairs():
        frames.append(
            evaluate_depth(
                predicted_mm, truth_mm, scaling=each, truth_range_mm=truth_range_mm, clip_prediction=clip_prediction
            )
        )
        scales.append(depth_scale(predicted_mm, truth_mm, truth_range_mm))
    mean = mean_depth_report(frames)
    return DepthSequenceReport(scaling, fit, mean, tuple(frames), scale_jitter(np.array(scales)))


def depth_scale(
    predicted_mm: np.ndarray, truth_mm: np.ndarray, truth_range_mm: tuple[float, float] = (1e-3, float("inf"))
) -> float:
    """Return s = median(g / d) over the compared pixels of one frame, (H, W) mm each; NaN where there are none."""
    d, g, _ = compared_depths(predicted_mm, truth_mm, truth_range_mm)
    return float(np.median(g / d)) if len(d) else float("nan")


def scale_jitter(scales: np.ndarray) -> ScaleJitter:
    """Return the jitter of one factor per frame (N,), in order, NaN where a frame has none."""
    logs = np.log(np.asarray(scales, dtype=np.float64))
    known = logs[np.isfinite(logs)]
    steps = np.abs(np.diff(logs))
    steps = steps[np.isfinite(steps)]
    log_std = float(np.std(known)) if len(known) > 1 else float("nan")
    return ScaleJitter(len(known), log_std, float(np.mean(steps)) if len(steps) else float("nan"))


def fit_sequence(pairs: DepthPairs, scaling: DepthScaling, truth_range_mm: tuple[float, float]) -> DepthFit:
    """Return the one fit of `sequence-median` or `sequence-scale-and-shift` in one pass over the frames.

    Every compared pixel of every frame counts the same. The identity where no pixel can be compared.
    """
    medians, moments = (_Median(), _Median()), _Moments()
    for predicted_mm, truth_mm in pairs():
        d, g, _ = compared_depths(predicted_mm, truth_mm, truth_range_mm)
        if scaling == "sequence-median":
            medians[0].add(d)
            medians[1].add(g)
        elif len(d):
            moments.add(1 / d, 1 / g)
    if scaling == "sequence-median":
        predicted, true = medians[0].value, medians[1].value
        return DepthFit(scaling, true / predicted) if predicted > 0 else DepthFit(scaling)
    return moments.fit(scaling)


class _Median:
    """The median of any number of positive values, from a histogram of their logarithms, to 1e-5 of its value."""

    def __init__(self) -> None:
        self._counts = np.zeros(int((_LOG_RANGE[1] - _LOG_RANGE[0]) / _LOG_STEP) + 1, dtype=np.int64)

    def add(self, values: np.ndarray) -> None:
        bins = ((np.log(np.clip(values, *np.exp(_LOG_RANGE))) - _LOG_RANGE[0]) / _LOG_STEP).astype(np.int64)
        np.add.at(self._counts, np.minimum(bins, len(self._counts) - 1), 1)

    @property
    def value(self) -> float:
        """Mean of the two middle values; NaN where there are none."""
        below = np.cumsum(self._counts)
        if below[-1] == 0:
            return float("nan")
        middle = np.searchsorted(below, [(below[-1] - 1) // 2, below[-1] // 2], side="right")
        return float(np.mean(np.exp(_LOG_RANGE[0] + (middle + 0.5) * _LOG_STEP)))


@dataclass
class _Moments:
    """Mean, variance and covariance of predicted and true disparity, merged frame by frame.

    Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing sample variances", 1979.
    """

    count: int = 0
    means: np.ndarray = field(default_factory=lambda: np.zeros(2))
    products: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))

    def add(self, x: np.ndarray, y: np.ndarray) -> None:
        values = np.stack([x, y])
        means = values.mean(axis=1)
        centred = values - means[:, None]
        total, apart = self.count + len(x), means - self.means
        self.products += centred @ centred.T + np.outer(apart, apart) * self.count * len(x) / total
        self.means = self.means + apart * len(x) / total
        self.count = total

    def fit(self, scaling: DepthScaling) -> DepthFit:
        if self.count == 0:
            return DepthFit(scaling)
        means = float(self.means[0]), float(self.means[1])
        return disparity_fit(float(self.products[0, 1]), float(self.products[0, 0]), means, scaling)
