"""What is measured of predicted depth and of its uncertainty: pure functions of arrays.

Depth errors are those of `scopemap_bench.evaluation.depth`. Of the uncertainty sigma (one standard deviation, mm)
they ask
whether errors grow with it (Spearman's rank correlation; sparsification: Ilg et al., "Uncertainty estimates and
multi-hypotheses networks for optical flow", ECCV 2018, section 5) and whether it is as large as they are. For this,
errors are taken for Laplace distributed in log depth, of scale b = sigma / (sqrt(2) depth).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np
from scipy.stats import spearmanr

from scopemap.cameras.camera import PinholeCamera
from scopemap.flow.dis import DisFlow
from scopemap.flow.estimator import pair_flow
from scopemap.frame import Frame
from scopemap.geometry.warp import pull
from scopemap_bench.evaluation.consistency import ConsistencyMeter
from scopemap_bench.evaluation.correspondences import FrameCorrespondences, FrameMatcher
from scopemap_bench.evaluation.depth import depth_scale, evaluate_depth, scale_jitter

REMOVED = np.arange(20) / 20
"""Shares of the pixels that sparsification removes: 0, 5, ..., 95 %."""
LAPLACE_WITHIN = tuple(1 - math.exp(-math.sqrt(2) * sigmas) for sigmas in (1, 2))
"""Share of a Laplace distribution within 1 and 2 standard deviations."""

_SATURATED_LEVEL = 250
_EDGE_RATIO = 1.1
_CONSISTENCY_PX = 1.0
_FIT_ROUNDS = 30
_LEAST_RESIDUAL = 1e-6


@dataclass(frozen=True)
class Prediction:
    """Depth (H, W) and, if known, its standard deviation (H, W), both mm, NaN = unknown."""

    depth_mm: np.ndarray
    sigma_mm: np.ndarray | None = None


@dataclass(frozen=True)
class FrameScore:
    """Figures of one frame, or their mean over several; NaN where there is nothing to measure.

    Attributes
    ----------
    abs_rel, delta : after median scaling, mean |d - g| / g and share of pixels within a factor of 1.25.
    metric_abs_rel : abs_rel of the millimetres as predicted; scale : median(g) / median(d).
    saturated_share : of the compared pixels, those with a channel at 250 or more; saturated_abs_rel,
        unsaturated_abs_rel : abs_rel there and elsewhere.
    edge_share, edge_abs_rel, smooth_abs_rel : the same for pixels beside a step of true depth by a tenth or more.
    rank : Spearman's correlation of |d - g| / g after median scaling with sigma / d.
    ause : area between the sparsification curve and the oracle's, over removed shares 0..0.95, in units of abs_rel;
        ause_share : the same in units of a random order's area: 0 is the oracle, 1 knows nothing.
    within_1_sigma, within_2_sigma : share of pixels with |ln d / g| below 1, 2 times sigma / d, after median scaling.
    error_over_b : mean of |ln d / g| over Laplace scale b; 1 where sigma is as large as the errors, 2 where half.
    """

    abs_rel: float
    delta: float
    metric_abs_rel: float
    scale: float
    saturated_share: float
    saturated_abs_rel: float
    unsaturated_abs_rel: float
    edge_share: float
    edge_abs_rel: float
    smooth_abs_rel: float
    rank: float
    ause: float
    ause_share: float
    within_1_sigma: float
    within_2_sigma: float
    error_over_b: float


@dataclass(frozen=True)
class Fit:
    """Errors after true distance = scale * distance^exponent, distances along the ray, one of each per sequence."""

    scale: float
    exponent: float
    abs_rel: float
    delta: float


@dataclass(frozen=True)
class SequenceScore:
    """Figures of a sequence.

    Attributes
    ----------
    mean : over the frames; frames : each of them.
    scale_log_std : standard deviation over the frames of ln `FrameScore.scale`.
    one_scale : with one scale for all frames, exponent 1.
    scale_and_exponent : with one scale and one exponent for all frames: what ideal tracked geometry could give.
    exponent_and_medians : with one exponent, then median scaling of each frame (`scale` means nothing here).
    sparsification, oracle : abs_rel over `REMOVED`, mean over the frames; empty without sigma.
    """

    mean: FrameScore
    frames: tuple[FrameScore, ...]
    scale_log_std: float
    one_scale: Fit
    scale_and_exponent: Fit
    exponent_and_medians: Fit
    sparsification: tuple[float, ...]
    oracle: tuple[float, ...]

    @property
    def abs_rel(self) -> float:
        """Mean over the frames of the median-scaled relative error."""
        return self.mean.abs_rel

    @property
    def delta(self) -> float:
        """Mean over the frames of the share within a factor of 1.25 after median scaling."""
        return self.mean.delta


@dataclass(frozen=True)
class Steadiness:
    """Change from frame to frame, without truth; the scene's own change is in it. Constant depth has none.

    Attributes
    ----------
    pairs : of consecutive frames.
    log_step_std : over the pairs, of ln median(depth / previous depth along the flow).
    change, rtc : mean relative change along the flow where it is trusted, and share of it below 1 %.
    opw_change : the same where the images moreover have the same colour.
    """

    pairs: int
    log_step_std: float
    change: float
    rtc: float
    opw_change: float


def score_sequence(
    frames: Sequence[Frame], truths_mm: Sequence[np.ndarray], made: Sequence[Prediction]
) -> SequenceScore:
    """Return the figures of predictions against true depth (H, W) mm, NaN where it is unknown or does not count."""
    scores, curves = [], []
    for frame, truth_mm, prediction in zip(frames, truths_mm, made, strict=True):
        score, curve = score_frame(frame.rgb, truth_mm, prediction)
        scores.append(score)
        curves.append(curve)
    known = [curve for curve in curves if len(curve)]
    mean = np.mean(known, axis=0) if known else np.empty((2, 0))
    jitter = scale_jitter(np.array([score.scale for score in scores]))
    one, both, medians = _fits(frames, truths_mm, made)
    sparse, oracle = (tuple(map(float, row)) for row in mean)
    return SequenceScore(mean_score(scores), tuple(scores), jitter["log_std"], one, both, medians, sparse, oracle)


def score_frame(rgb: np.ndarray, truth_mm: np.ndarray, prediction: Prediction) -> tuple[FrameScore, np.ndarray]:
    """Return the figures of one frame, and the sparsification and oracle curves (2, 20), (0,) without sigma."""
    scaled = evaluate_depth(prediction.depth_mm, truth_mm, scaling="median")
    metric = evaluate_depth(prediction.depth_mm, truth_mm)
    known = np.isfinite(truth_mm) & (prediction.depth_mm > 0)
    ratio = scaled["scale"] * prediction.depth_mm[known].astype(np.float64) / truth_mm[known]
    error = np.abs(ratio - 1)
    bright = rgb[known].max(-1) >= _SATURATED_LEVEL
    edge = beside_steps(truth_mm)[known]
    where = [figure for part in (bright, edge) for figure in (_mean(part), _mean(error[part]), _mean(error[~part]))]
    unsure, curves = (math.nan,) * 6, np.empty(0)
    if prediction.sigma_mm is not None:
        relative = (prediction.sigma_mm / prediction.depth_mm)[known].astype(np.float64)
        unsure, curves = _uncertainty(ratio, relative)
    return FrameScore(scaled["abs_rel"], scaled["delta_1"], metric["abs_rel"], scaled["scale"], *where, *unsure), curves


def _uncertainty(ratio: np.ndarray, relative_sigma: np.ndarray) -> tuple[tuple[float, ...], np.ndarray]:
    told = relative_sigma > 0
    if np.count_nonzero(told) < 2:
        return (math.nan,) * 6, np.empty(0)
    ratio, relative_sigma = ratio[told], relative_sigma[told]
    error, log_error = np.abs(ratio - 1), np.abs(np.log(ratio))
    curve, oracle = sparsification(error, relative_sigma), sparsification(error, error)
    varied = min(np.ptp(error), np.ptp(relative_sigma)) > 0
    rank = float(spearmanr(error, relative_sigma).statistic) if varied else math.nan
    within = [_mean(log_error < sigmas * relative_sigma) for sigmas in (1, 2)]
    error_over_b = _mean(log_error / (relative_sigma / math.sqrt(2)))
    return (rank, *area_between(curve, oracle), *within, error_over_b), np.stack([curve, oracle])


def beside_steps(depth_mm: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: next to a neighbour, across or along, whose known depth (H, W) differs by a tenth or more."""
    edge = np.zeros(depth_mm.shape, bool)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        step = np.maximum(depth_mm[a], depth_mm[b]) >= _EDGE_RATIO * np.minimum(depth_mm[a], depth_mm[b])
        edge[a] |= step
        edge[b] |= step
    return edge


def sparsification(error: np.ndarray, uncertainty: np.ndarray) -> np.ndarray:
    """Return the mean error (20,) of the pixels that are left once the most uncertain `REMOVED` shares are gone.

    Both are (N,). Equal uncertainty is removed in random order, not in the order of rows.
    """
    shuffled = np.random.default_rng(0).permutation(len(error))
    order = shuffled[np.argsort(uncertainty[shuffled], kind="stable")]
    means = np.cumsum(error[order]) / np.arange(1, len(error) + 1)
    left = np.maximum(np.rint((1 - REMOVED) * len(error)).astype(int), 1)
    return means[left - 1]


def area_between(curve: np.ndarray, oracle: np.ndarray) -> tuple[float, float]:
    """Return the area between two curves over `REMOVED`: in units of the error of all pixels, and of a flat curve's."""
    if curve[0] == 0:
        return math.nan, math.nan
    area, flat = (float(np.trapezoid(upper - oracle, REMOVED)) for upper in (curve, np.full_like(oracle, oracle[0])))
    return area / float(curve[0]), area / flat if flat > 0 else math.nan


def mean_score(scores: Sequence[FrameScore]) -> FrameScore:
    """Return the mean of each figure over the frames that have it."""
    table = np.array([astuple(score) for score in scores], dtype=np.float64).reshape(-1, len(fields(FrameScore)))
    return FrameScore(*(_mean(column[np.isfinite(column)]) for column in table.T))


def power_fit(predicted: np.ndarray, true: np.ndarray, *, exponent: float | None = None) -> tuple[float, float]:
    """Return scale and exponent of true = scale * predicted^exponent, (N,) each, with least |ln| error.

    Iteratively reweighted least squares. A given exponent is kept, and the scale is the median.
    """
    x, y = np.log(predicted), np.log(true)
    if exponent is not None or len(x) < 2 or np.ptp(x) == 0:
        exponent = 1.0 if exponent is None else exponent
        return float(np.exp(np.median(y - exponent * x))), exponent
    design, weight = np.stack([np.ones_like(x), x], axis=1), np.ones_like(x)
    for _ in range(_FIT_ROUNDS):
        offset, slope = np.linalg.solve(design.T @ (weight[:, None] * design), design.T @ (weight * y))
        weight = 1 / np.maximum(np.abs(y - offset - slope * x), _LEAST_RESIDUAL)
    return float(np.exp(offset)), float(slope)


def _fits(frames: Sequence[Frame], truths_mm: Sequence[np.ndarray], made: Sequence[Prediction]) -> tuple[Fit, Fit, Fit]:
    """Return the fits of `SequenceScore`: one scale; scale and exponent; exponent and medians."""
    along = [np.linalg.norm(frame.camera.rays, axis=-1) for frame in frames]
    distances = [prediction.depth_mm * length for prediction, length in zip(made, along, strict=True)]
    known = [np.isfinite(g) & (d > 0) for g, d in zip(truths_mm, distances, strict=True)]
    if not any(k.any() for k in known):
        return (Fit(*[math.nan] * 4),) * 3
    x = [np.log(d[k], dtype=np.float64) for d, k in zip(distances, known, strict=True) if k.any()]
    y = [np.log((g * n)[k], dtype=np.float64) for g, n, k in zip(truths_mm, along, known, strict=True) if k.any()]

    def errors(scale: float, exponent: float, *, medians: bool = False) -> Fit:
        reports = [
            evaluate_depth(scale * d**exponent / n, g, scaling="median" if medians else "none")
            for d, g, n in zip(distances, truths_mm, along, strict=True)
        ]
        kept = [report for report in reports if report["pixels"]]
        return Fit(scale, exponent, _mean([r["abs_rel"] for r in kept]), _mean([r["delta_1"] for r in kept]))

    predicted, true = np.exp(np.concatenate(x)), np.exp(np.concatenate(y))
    # A scale that differs from frame to frame must not be taken for an exponent: each frame about its own median.
    inner, outer = (np.exp(np.concatenate([part - np.median(part) for part in logs])) for logs in (x, y))
    return (
        errors(*power_fit(predicted, true, exponent=1.0)),
        errors(*power_fit(predicted, true)),
        errors(*power_fit(inner, outer), medians=True),
    )


def link_clip(frames: Sequence[Frame]) -> list[FrameCorrespondences | None]:
    """Return what the images alone tell of each frame and the one before it, by DIS flow; None for the first."""
    matcher, links, previous = FrameMatcher(frames[0].camera), [], None
    for frame in frames:
        flow = None if previous is None else pair_flow(DisFlow(), previous.rgb, frame.rgb, _CONSISTENCY_PX)
        known = (None, None) if flow is None else (flow.to_previous, flow.consistent)
        links.append(matcher.match(frame.rgb, frame.valid, *known))
        previous = frame
    return links


def steadiness(
    camera: PinholeCamera,
    counted: Sequence[np.ndarray],
    depths_mm: Sequence[np.ndarray],
    links: Sequence[FrameCorrespondences | None],
) -> Steadiness:
    """Return how steady depth (H, W) mm of consecutive frames is, over the pixels `counted` (H, W) bool."""
    meter, scales = ConsistencyMeter(camera), []
    previous_mm = None
    for valid, depth_mm, link in zip(counted, depths_mm, links, strict=True):
        meter.add(depth_mm, valid, link)
        current_mm = np.where(valid, depth_mm, np.nan).astype(np.float32)
        if previous_mm is not None and link is not None and link.to_previous is not None:
            before_mm = np.where(link.consistent, pull(previous_mm, link.to_previous), np.nan)
            scales.append(depth_scale(before_mm, current_mm))
        previous_mm = current_mm
    report = meter.report()
    log_std = scale_jitter(np.array(scales))["log_std"]
    flow = report["along_flow"]
    return Steadiness(report["pairs"], log_std, flow["relative"], flow["rtc"], report["opw"]["relative"])


def _mean(values: np.ndarray | Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else math.nan
