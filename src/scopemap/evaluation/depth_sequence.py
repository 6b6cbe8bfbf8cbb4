"""Depth errors of a sequence under one scale for all frames, and the jitter of the scale from frame to frame.

A median scale per image hides flicker. Here one factor, or one scale and shift in disparity as in Video-Depth-Anything
(arXiv 2501.12375), is found for all frames; the jitter of the factor per frame is reported beside it. Frames come from
a factory that is called once per pass, so that one frame is in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
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
    disparity_sums,
    evaluate_depth,
    mean_depth_report,
)

DepthPairs = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]
"""Gives the frames, in order, anew at every call: (predicted, true), (H, W) each, mm, NaN = unknown."""

# Bins of the logarithm of depth: medians read from them are exact to 1e-5 of their value, in bounded memory.
_LOG_LOW, _LOG_HIGH, _LOG_STEP = float(np.log(1e-4)), float(np.log(1e6)), 2e-5


@dataclass(frozen=True)
class ScaleJitter:
    """Variation over the frames of the factor s_t = median(g / d) from prediction to truth; a global scale cancels.

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
    scaling : mode; fit : the one fit of a sequence mode, the identity in other modes.
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
        fit in disparity over them. The others scale each frame by itself, as `evaluate_depth`.
    truth_range_mm, clip_prediction : as in `evaluate_depth`.
    """
    if scaling not in get_args(DepthScaling):
        raise SettingsError(f"depth scaling '{scaling}': choose one of {', '.join(get_args(DepthScaling))}")
    of_sequence = scaling in ("sequence-median", "sequence-scale-and-shift")
    fit = fit_sequence(pairs, scaling, truth_range_mm) if of_sequence else DepthFit(scaling)
    each: ImageScaling | DepthFit = fit if of_sequence else scaling  # type: ignore[assignment]
    frames, scales = [], []
    for predicted_mm, truth_mm in pairs():
        report = evaluate_depth(
            predicted_mm, truth_mm, scaling=each, truth_range_mm=truth_range_mm, clip_prediction=clip_prediction
        )
        frames.append(report)
        scales.append(depth_scale(predicted_mm, truth_mm, truth_range_mm))
    return DepthSequenceReport(scaling, fit, mean_depth_report(frames), tuple(frames), scale_jitter(np.array(scales)))


def depth_scale(
    predicted_mm: np.ndarray, truth_mm: np.ndarray, truth_range_mm: tuple[float, float] = (1e-3, float("inf"))
) -> float:
    """Return s = median(g / d) over the compared pixels of one frame, (H, W) mm each; NaN where there are none."""
    d, g, _ = compared_depths(predicted_mm, truth_mm, truth_range_mm)
    return float(np.median(g / d)) if len(d) else float("nan")


def scale_jitter(scales: np.ndarray) -> ScaleJitter:
    """Return the jitter of one factor per frame (N,), in order, NaN where a frame has none."""
    logs = np.log(np.asarray(scales, dtype=np.float64))
    known, steps = logs[np.isfinite(logs)], np.abs(np.diff(logs))
    steps = steps[np.isfinite(steps)]
    log_std = float(np.std(known)) if len(known) > 1 else float("nan")
    return ScaleJitter(len(known), log_std, float(np.mean(steps)) if len(steps) else float("nan"))


def fit_sequence(pairs: DepthPairs, scaling: DepthScaling, truth_range_mm: tuple[float, float]) -> DepthFit:
    """Return the one fit of `sequence-median` or `sequence-scale-and-shift` in one pass over the frames.

    Every compared pixel of every frame has the same weight. The identity where no pixel can be compared.
    """
    sums, counts = np.zeros(5), np.zeros((2, int((_LOG_HIGH - _LOG_LOW) / _LOG_STEP) + 1), dtype=np.int64)
    for predicted_mm, truth_mm in pairs():
        d, g, _ = compared_depths(predicted_mm, truth_mm, truth_range_mm)
        if scaling == "sequence-scale-and-shift":
            sums += disparity_sums(d, g)
        else:
            for histogram, depths_mm in zip(counts, (d, g), strict=True):
                bins = ((np.log(depths_mm) - _LOG_LOW) / _LOG_STEP).astype(np.int64)
                np.add.at(histogram, np.clip(bins, 0, len(histogram) - 1), 1)
    if scaling == "sequence-scale-and-shift":
        return disparity_fit(sums, scaling)
    if not counts.any():
        return DepthFit(scaling)
    predicted, true = (_median(histogram) for histogram in counts)
    return DepthFit(scaling, true / predicted)


def _median(histogram: np.ndarray) -> float:
    """Return the mean of the two middle values of depths counted by their logarithm."""
    below = np.cumsum(histogram)
    middle = np.searchsorted(below, [(below[-1] - 1) // 2, below[-1] // 2], side="right")
    return float(np.mean(np.exp(_LOG_LOW + (middle + 0.5) * _LOG_STEP)))
