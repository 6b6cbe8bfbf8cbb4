"""Depth maps against true depth: the field's standard errors, per image and per sequence, and the jitter of the scale.

Eigen, Puhrsch and Fergus, "Depth map prediction from a single image", NeurIPS 2014, section 4.2; mean over images, not
pixels, as AF-SfMLearner and EndoDAC report it. A scale per image hides flicker, so a sequence may have one factor, or
one scale and shift in disparity (Video-Depth-Anything, arXiv 2501.12375).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from scopemap.engine.errors import SettingsError, check_shape

ImageScaling = Literal["none", "median", "scale-and-shift"]
DepthScaling = Literal["none", "median", "scale-and-shift", "sequence-median", "sequence-scale-and-shift"]
"""How a prediction is scaled first. Per image: factor median(g) / median(d), or least squares of scale and shift in
disparity. Per sequence: the same over the pixels of all frames."""

DEPTH_RANGES_MM: dict[str, tuple[float, float]] = {
    "scared": (1e-3, 150.0),  # AF-SfMLearner and EndoDAC, evaluate_depth.py
    "hamlyn": (1.0, 300.0),  # Endo-Depth-and-Motion and EndoOmni; AF-SfMLearner caps at 150
    "c3vd": (1e-3, 100.0),  # EndoDAC; the data set's files end at 100
    "serv-ct": (1.0, 180.0),  # AF-SfMLearner
}
"""Range of true depth that counts, both ends excluded, by data set, as the named projects evaluate it."""

# Video-Depth-Anything floors fitted disparity at 1e-3 per metre: no pixel is farther than a kilometre.
_LEAST_DISPARITY_PER_MM = 1e-6
# A variance below this share of the squared mean is rounding of the sums.
_LEAST_VARIATION = 1e-12
DepthPairs = Callable[[], Iterable[tuple[np.ndarray, np.ndarray]]]
"""Gives the frames, in order, again at every call: (predicted, true), (H, W) each, mm, NaN = unknown."""

_FIGURES = (
    *("pixels", "coverage", "scale", "shift_per_mm", "abs_rel", "sq_rel_mm", "rmse_mm", "rmse_log", "mae_mm"),
    *("delta_1", "delta_2", "delta_3"),
)
# Bins of the logarithm of depth: medians read from them are exact to 1e-5 of their value, in bounded memory.
_LOG_LOW = float(np.log(1e-4))
_LOG_HIGH = float(np.log(1e6))
_LOG_STEP = 2e-5


@dataclass(frozen=True)
class DepthFit:
    """Scale and shift of a prediction d (mm): 1 / d' = 1 / (scale d) + shift. The default changes nothing.

    scale : factor on the depth; infinite where least squares found no correlation with the truth. shift_per_mm : added
    to the disparity, 1/mm; not 0 under scale-and-shift only.
    """

    scaling: DepthScaling = "none"
    scale: float = 1.0
    shift_per_mm: float = 0.0

    def apply(self, depth_mm: np.ndarray) -> np.ndarray:
        """Return depth of any shape, mm, scaled and shifted; unknown (NaN) and impossible (<= 0) values give NaN."""
        depth_mm = np.where(depth_mm > 0, depth_mm, np.nan)
        if self.shift_per_mm == 0 and np.isfinite(self.scale):
            return self.scale * depth_mm
        disparity = 1 / (self.scale * depth_mm) + self.shift_per_mm
        return 1 / np.maximum(disparity, _LEAST_DISPARITY_PER_MM)


def evaluate_depth(
    predicted_mm: np.ndarray,
    truth_mm: np.ndarray,
    *,
    scaling: ImageScaling | DepthFit = "none",
    truth_range_mm: tuple[float, float] = (1e-3, float("inf")),
    clip_prediction: bool = False,
) -> dict[str, Any]:
    """Return the errors of a predicted depth map (H, W) against the true one (H, W), both mm, NaN = unknown.

    pixels, coverage : compared pixels, and their share of those with true depth, 0..1. The others are NaN without.
    scaling, scale, shift_per_mm : what was applied to the prediction (`DepthFit`).
    abs_rel, sq_rel_mm : mean of |d - g| / g and (d - g)^2 / g; mae_mm : mean |d - g|; rmse_mm, rmse_log : root mean
    square of d - g and ln d - ln g; delta_1, delta_2, delta_3 : share with max(d/g, g/d) strictly below 1.25, 1.25^2,
    1.25^3.

    `scaling`: "median", the ratio of the medians of the compared pixels; "scale-and-shift", least squares in disparity;
    or a fit found elsewhere; `SettingsError` for another name. True depth counts strictly inside `truth_range_mm`, to
    which `clip_prediction` clips the scaled prediction, as AF-SfMLearner and Video-Depth-Anything do.
    """
    d, g, known = compared_depths(predicted_mm, truth_mm, truth_range_mm)
    fit = scaling if isinstance(scaling, DepthFit) else _fit(d, g, scaling)
    counted, coverage = len(d), len(d) / max(known, 1)
    if counted == 0:
        return _report(fit.scaling, [0, coverage, *[float("nan")] * 10])
    d = fit.apply(d)
    if clip_prediction:
        d = np.clip(d, *truth_range_mm)
    difference, ratio = d - g, np.maximum(d / g, g / d)
    errors = [np.mean(np.abs(difference) / g), np.mean(difference**2 / g), np.sqrt(np.mean(difference**2))]
    errors += [np.sqrt(np.mean(np.log(d / g) ** 2)), np.mean(np.abs(difference))]
    errors += [np.mean(ratio < 1.25**k) for k in (1, 2, 3)]
    return _report(fit.scaling, [counted, coverage, fit.scale, fit.shift_per_mm, *errors])


def _report(scaling: DepthScaling, figures: Iterable[float]) -> dict[str, Any]:
    return {"scaling": scaling} | dict(zip(_FIGURES, map(float, figures), strict=True))


def compared_depths(
    predicted_mm: np.ndarray, truth_mm: np.ndarray, truth_range_mm: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return prediction and truth (N,) float64, mm, of the comparable pixels, and the number of true depths."""
    check_shape("predicted_mm", predicted_mm, np.shape(truth_mm))
    nearest, farthest = truth_range_mm
    known = np.isfinite(truth_mm) & (truth_mm > nearest) & (truth_mm < farthest)
    compared = known & np.isfinite(predicted_mm) & (predicted_mm > 0)
    d, g = predicted_mm[compared].astype(np.float64), truth_mm[compared].astype(np.float64)
    return d, g, int(np.count_nonzero(known))


def _fit(d: np.ndarray, g: np.ndarray, scaling: ImageScaling) -> DepthFit:
    if scaling not in get_args(ImageScaling):
        raise SettingsError(f"scaling of one image '{scaling}': choose one of {', '.join(get_args(ImageScaling))}")
    if scaling == "none" or len(d) == 0:
        return DepthFit(scaling)
    if scaling == "median":
        return DepthFit(scaling, float(np.median(g) / np.median(d)))
    return disparity_fit(disparity_sums(d, g), scaling)


def disparity_sums(d: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the sums (5,) of 1, x, y, x^2, x y over disparities x = 1/d, y = 1/g (1/mm) of depths (N,), mm."""
    x, y = 1 / d, 1 / g
    return np.array([len(d), x.sum(), y.sum(), x @ x, x @ y])


def disparity_fit(sums: np.ndarray, scaling: DepthScaling) -> DepthFit:
    """Return the least-squares fit 1 / g = a / d + b of `disparity_sums`, which add up over frames; identity if empty.

    A prediction without variation becomes the mean disparity of the truth. arXiv 2501.12375, by the normal equations.
    """
    count, x, y, xx, xy = sums
    if count == 0:
        return DepthFit(scaling)
    mean_x, mean_y = x / count, y / count
    variance, covariance = xx / count - mean_x**2, xy / count - mean_x * mean_y
    slope = covariance / variance if variance > _LEAST_VARIATION * mean_x**2 else 0.0
    return DepthFit(scaling, float(1 / slope) if slope != 0 else float("inf"), float(mean_y - slope * mean_x))


def mean_depth_report(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the mean of `evaluate_depth` over comparable images; `SettingsError` where their scaling differs."""
    if not reports:
        return _report("none", [0, *[float("nan")] * 11])
    scalings = sorted({report["scaling"] for report in reports})
    if len(scalings) > 1:
        raise SettingsError(f"mean of depth errors: the images were scaled by {', '.join(scalings)}; use one of them")
    table = np.array([[report[name] for name in _FIGURES] for report in reports])
    compared = table[table[:, 0] > 0, 2:]
    errors = compared.mean(axis=0) if len(compared) else np.full(compared.shape[1], np.nan)
    return _report(scalings[0], [*table[:, :2].mean(axis=0), *errors])


@dataclass(frozen=True)
class DepthSequenceReport:
    """Depth errors of a sequence: the `fit` of a sequence mode, each frame's report and their mean, unscaled jitter.

    scales : (N,) median of true over predicted depth of each frame, unscaled; NaN where nothing can be compared.
    """

    scaling: DepthScaling
    fit: DepthFit
    mean: dict[str, Any]
    frames: tuple[dict[str, Any], ...]
    jitter: dict[str, float]
    scales: np.ndarray


def evaluate_depth_sequence(
    pairs: DepthPairs,
    *,
    scaling: DepthScaling = "none",
    truth_range_mm: tuple[float, float] = (1e-3, float("inf")),
    clip_prediction: bool = False,
) -> DepthSequenceReport:
    """Return the errors of a sequence of depth maps, averaged over frames.

    `sequence-median`: one factor, the median of all true depths over the median of all predicted ones.
    `sequence-scale-and-shift`: one least-squares fit in disparity. All else is as in `evaluate_depth`.
    """
    if scaling not in get_args(DepthScaling):
        raise SettingsError(f"depth scaling '{scaling}': choose one of {', '.join(get_args(DepthScaling))}")
    of_sequence = scaling in ("sequence-median", "sequence-scale-and-shift")
    fit = fit_sequence(pairs, scaling, truth_range_mm) if of_sequence else DepthFit(scaling)
    each: ImageScaling | DepthFit = fit if of_sequence else scaling  # type: ignore[assignment]
    frames, scales = [], []
    options: dict[str, Any] = {"truth_range_mm": truth_range_mm, "clip_prediction": clip_prediction}
    for predicted_mm, truth_mm in pairs():
        frames.append(evaluate_depth(predicted_mm, truth_mm, scaling=each, **options))
        scales.append(depth_scale(predicted_mm, truth_mm, truth_range_mm))
    each_scale = np.array(scales, dtype=np.float64)
    return DepthSequenceReport(
        scaling, fit, mean_depth_report(frames), tuple(frames), scale_jitter(each_scale), each_scale
    )


def metric_consistency(scales: np.ndarray, path_scale: float) -> dict[str, Any]:
    """Return how depth fits the path: median true over predicted depth per frame (N,), in the scale of the path.

    path_scale : factor by which the Sim(3) alignment of the trajectory takes the run's lengths to true ones. 1 is
    right; above, depth is too small for the path. median, least, most : over the frames, which `frames` lists.
    """
    ratios = scales[np.isfinite(scales)] / path_scale
    if not len(ratios):
        return {}
    least, median, most = np.percentile(ratios, [0, 50, 100]).tolist()
    return {"median": median, "least": least, "most": most, "frames": ratios.tolist()}


def depth_scale(
    predicted_mm: np.ndarray, truth_mm: np.ndarray, truth_range_mm: tuple[float, float] = (1e-3, float("inf"))
) -> float:
    """Return s = median(g / d) over the compared pixels of one frame, (H, W) mm each; NaN where there are none."""
    d, g, _ = compared_depths(predicted_mm, truth_mm, truth_range_mm)
    return float(np.median(g / d)) if len(d) else float("nan")


def scale_jitter(scales: np.ndarray) -> dict[str, float]:
    """Return the variation of one factor s_t per frame (N,), in order, NaN where a frame has none.

    frames : with a factor. log_std : standard deviation (by N) of ln s_t; NaN below two frames. log_step : mean |ln
    s_{t+1} - ln s_t| over consecutive frames that both have one; NaN where there are none.
    """
    logs = np.log(np.asarray(scales, dtype=np.float64))
    known, steps = logs[np.isfinite(logs)], np.abs(np.diff(logs))
    steps = steps[np.isfinite(steps)]
    log_std = float(np.std(known)) if len(known) > 1 else float("nan")
    log_step = float(np.mean(steps)) if len(steps) else float("nan")
    return {"frames": len(known), "log_std": log_std, "log_step": log_step}


def fit_sequence(pairs: DepthPairs, scaling: DepthScaling, truth_range_mm: tuple[float, float]) -> DepthFit:
    """Return the one fit of a sequence mode over all compared pixels, in one pass; the identity without one."""
    sums, counts = np.zeros(5), np.zeros((2, int((_LOG_HIGH - _LOG_LOW) / _LOG_STEP) + 1), dtype=np.int64)
    for predicted_mm, truth_mm in pairs():
        d, g, _ = compared_depths(predicted_mm, truth_mm, truth_range_mm)
        if scaling == "sequence-scale-and-shift":
            sums += disparity_sums(d, g)
        else:
            for histogram, depths_mm in zip(counts, (d, g), strict=True):
                bins = ((np.log(depths_mm) - _LOG_LOW) / _LOG_STEP).astype(np.int64)
                histogram += np.bincount(bins.clip(0, len(histogram) - 1), minlength=len(histogram))
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
