"""Depth power law: true distance along the ray is c * predicted^e, with one exponent e for a video, fitted to the flow.

Networks and shading get the order of distances right and their range wrong. A moving camera separates the exponent e
from the scale c: c only lengthens the translation, e changes the ratio of parallax between near and far tissue.
Exponent and motion of a pair of frames are fitted together to the flow between them by robust least squares. The
standard deviation of the exponent, with the motion marginalised, comes from the normal matrix with residuals summed
over image cells first (cluster-robust sandwich; Cameron and Miller, "A practitioner's guide to cluster-robust
inference", 2015), since neighbouring pixels have correlated errors.

Flow is smoother than parallax, which alone lowers the exponent by a fifth. So the second frame is warped to the first
by the flow that the fit predicts, the remaining flow is added, and the fit is repeated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import Config
from scopemap.depth.anchor import apply_power_law, depth_downscale, ray_lengths
from scopemap.depth.estimate import DepthEstimate, DepthEstimator
from scopemap.errors import check_shape
from scopemap.flow.dis import DisFlow
from scopemap.flow.estimator import FlowEstimator, pair_flow
from scopemap.frame import Frame
from scopemap.geometry.least_squares import robust_sigma
from scopemap.geometry.se3 import se3, so3_exp, transform
from scopemap.geometry.uncertainty import relative_sigma
from scopemap.geometry.warp import pull
from scopemap.io.sequence import Sequence
from scopemap.masking.mask_files import create_masks
from scopemap.masking.masker import Masker

EXPONENT_RANGE = (0.5, 2.0)
"""Limits of a fitted exponent."""

# Choice of pairs: every 4th frame (more in short clips) is a reference; its partner is the farthest that flow reaches.
_REFERENCE_EVERY, _REFERENCES = 4, 20
_GAPS = (12, 8, 5, 3, 2)  # frames from a reference to its partner, tried in this order
_MAX_FLOW_SHARE = 0.12  # of the image width
_MIN_CONSISTENT_SHARE = 0.5  # of the usable pixels
_REALIGNMENTS = 3
# Fit of one pair. Pixels are at a width of 320 px.
_REFERENCE_WIDTH_PX = 320.0
_SAMPLES, _MIN_SAMPLES = 1500, 150
_MIN_LOG_RANGE = 0.1  # of the distances: a scene at one distance has no range
_CELLS = (6, 8)  # rows and columns of image cells whose residuals are correlated
_MIN_PARALLAX_PX = 1.5
_FLOW_SIGMA_PX = 0.5
_DEFAULT_SHARE = 0.1  # relative depth error where the estimator gives none
_SHARE_RANGE = (0.05, 0.5)
_ROUNDS = 4
_BOUNDS = (0.25, 4.0)
_MIN_Z = 1e-3  # of the median distance
# A fit is rejected where the residual is too large in px and as a share of parallax, or inliers are too few.
_MAX_RESIDUAL_PX, _MAX_RESIDUAL_SHARE = 0.5, 0.35
_MIN_INLIERS, _INLIER_SIGMAS = 0.6, 3.0
_MAX_DEVIATION = 0.3
# Combination of pairs.
_MIN_PAIRS = 4
_MAX_SPREAD = 0.25  # of ln exponent over the pairs
_MIN_LOG_DEVIATION = 0.02
_MEDIAN_TO_MEAN = 1.2533


@dataclass(frozen=True)
class PairFit:
    """The exponent estimated from one pair of frames.

    Attributes
    ----------
    exponent, deviation : value and standard deviation, with the motion marginalised.
    parallax_px : median flow after the best rotation. residual_px : median error of the predicted flow.
    inlier_share : 0..1. pivot_mm : distance along the ray that the power law keeps, unit of the predicted depth.
    T_other_reference : (4, 4), from the reference camera to the other one, same unit, for the corrected depth.
    """

    exponent: float
    deviation: float
    parallax_px: float
    residual_px: float
    inlier_share: float
    pivot_mm: float
    T_other_reference: np.ndarray


@dataclass(frozen=True)
class ExponentFit:
    """The exponent of a sequence, with its standard deviation, from `pairs` pairs; `reason`: why it was left at 1."""

    exponent: float
    deviation: float
    pairs: int
    reason: str = ""

    def applied(self, config: Config) -> Config:
        """Return the settings with the fitted number in place of "fit"."""
        depth = config.depth.model_copy(update={"exponent": round(self.exponent, 4)})
        return config.model_copy(update={"depth": depth})

    def describe(self, frames: int) -> str:
        """Return one line for people; `frames` were looked at."""
        if self.reason:
            return f"depth exponent: left at 1, {self.reason}"
        return (
            f"depth exponent: {self.exponent:.2f} +- {self.deviation:.2f} fitted to the flow of {self.pairs} pairs "
            f"of the first {frames} frames"
        )


@dataclass(frozen=True)
class _Sample:
    """N pixels of a frame with their flow targets; distances are divided by their median."""

    camera: PinholeCamera
    pivot_mm: float
    rays: np.ndarray  # (N, 3) of length 1
    log_distance: np.ndarray  # (N,)
    target_px: np.ndarray  # (N, 2)
    share: np.ndarray  # (N,) standard deviation of distance over distance
    cells: np.ndarray  # (N,) number of the image cell

    def project(self, unknowns: np.ndarray) -> np.ndarray:
        """Return (N, 2) pixels in the other frame for (7,): rotation vector, translation over median, exponent."""
        points = self.rays * np.exp(unknowns[6] * self.log_distance)[:, None]
        moved = points @ so3_exp(unknowns[:3]).T + unknowns[3:6]
        moved[:, 2] = np.maximum(moved[:, 2], _MIN_Z)
        return self.camera.project(moved)


def fit_exponent(sequence: Sequence, config: Config, estimator: DepthEstimator) -> ExponentFit:
    """Return the exponent for the predicted depth of a sequence from its first `exponent_frames` frames.

    It is 1, with a reason, where depth is not predicted and where too few pairs of frames can be fitted. Some
    estimators keep state from the first frame, so the run that follows needs new ones.
    """
    fits: list[PairFit] = []
    for reference, partners in _pairs(sequence, config):
        estimate = estimator.estimate(reference)
        if estimate.kind != "depth":
            return ExponentFit(1.0, 0.0, 0, f"{estimate.kind} needs no power law")
        fit = _pair_fit(reference, partners, estimate, config.mapis.advanced.consistency_px)
        fits += [] if fit is None else [fit]
    return sequence_exponent(fits)


def sequence_exponent(fits: list[PairFit]) -> ExponentFit:
    """Return the exponent of a sequence: the median of ln exponent over its pairs, weighted by inverse variance.

    It is clipped to `EXPONENT_RANGE`, and 1, with the reason, for fewer than four pairs or contradictory ones. Its
    standard deviation combines those of the pairs and their spread, as if pairs were independent.
    """
    if len(fits) < _MIN_PAIRS:
        return ExponentFit(1.0, 0.0, len(fits), f"{len(fits)} pair(s) of frames could be fitted, {_MIN_PAIRS} needed")
    logs = np.log([fit.exponent for fit in fits])
    claimed = np.array([max(fit.deviation / fit.exponent, _MIN_LOG_DEVIATION) for fit in fits])
    # The spread over the pairs is an error common to all.
    spread = robust_sigma(logs - np.median(logs))
    weight = 1 / (claimed**2 + spread**2)
    order = np.argsort(logs)
    position = np.cumsum(weight[order]) - weight[order] / 2
    centre = float(np.interp(weight.sum() / 2, position, logs[order]))
    if spread > _MAX_SPREAD:
        low, high = np.exp(np.percentile(logs, [25, 75]))
        return ExponentFit(1.0, 0.0, len(fits), f"{len(fits)} pairs of frames contradict: {low:.2f} to {high:.2f}")
    exponent = float(np.clip(np.exp(centre), *EXPONENT_RANGE))
    return ExponentFit(exponent, exponent * _MEDIAN_TO_MEAN * float(weight.sum() ** -0.5), len(fits))


def _pairs(sequence: Sequence, config: Config) -> Iterator[tuple[Frame, list[Frame]]]:
    """Yield each usable reference frame, masked, with its candidate partners, farthest first."""
    masker = Masker(config.mask, create_masks(config.mask, sequence.rectifier, sequence.source.masks))
    count = config.depth.advanced.exponent_frames
    every = min(max(min(sequence.count or count, count) // _REFERENCES, 1), _REFERENCE_EVERY)
    downscale = depth_downscale(config.depth, max(sequence.camera.width, sequence.camera.height))
    frames = [masker(frame).downscaled(downscale) for frame in islice(sequence.frames(), count)]
    usable = [frame.valid.mean() >= config.tracking.min_valid_share for frame in frames]
    for i in range(0, len(frames), every):
        if usable[i]:
            yield frames[i], [frames[i + gap] for gap in _GAPS if i + gap < len(frames) and usable[i + gap]]


def _pair_fit(
    reference: Frame, partners: list[Frame], estimate: DepthEstimate, consistency_px: float
) -> PairFit | None:
    """Return the fit with the first partner that flow reaches; None where there is none or it is rejected."""
    estimator, depth_mm, camera = DisFlow(), estimate.values, reference.camera
    share = None if estimate.sigma is None else relative_sigma(depth_mm, estimate.sigma)
    for partner in partners:
        flow = _flow_to(reference, partner, estimator, consistency_px)
        if flow is None:
            continue
        fit = pair_exponent(depth_mm, flow.to_partner, flow.usable, camera, share)
        for _ in range(_REALIGNMENTS):
            if fit is None:
                return None
            guess = modelled_flow(depth_mm, camera, fit)
            guess = np.where(np.isfinite(guess), guess, flow.to_partner)
            realigned = _realigned(reference, partner, guess, estimator, consistency_px)
            fit = pair_exponent(depth_mm, realigned.to_partner, realigned.usable, camera, share)
        return fit
    return None


class _PairFlow(NamedTuple):
    """Flow (H, W, 2) px from the reference to its partner, and (H, W) bool where it is reliable."""

    to_partner: np.ndarray
    usable: np.ndarray


def _flow_to(reference: Frame, partner: Frame, estimator: FlowEstimator, consistency_px: float) -> _PairFlow | None:
    """Return the flow between two frames; None where it is too long or too little of it is consistent."""
    flow = pair_flow(estimator, partner.rgb, reference.rgb, consistency_px)
    usable = flow.consistent & _usable_in(partner, flow.to_previous) & reference.valid
    if usable.sum() < _MIN_CONSISTENT_SHARE * reference.valid.sum():
        return None
    length_px = np.median(np.linalg.norm(flow.to_previous[usable], axis=-1))
    return _PairFlow(flow.to_previous, usable) if length_px <= _MAX_FLOW_SHARE * reference.camera.width else None


def _realigned(
    reference: Frame, partner: Frame, guess: np.ndarray, estimator: FlowEstimator, consistency_px: float
) -> _PairFlow:
    """Return the flow between two frames as a guess (H, W, 2) px plus the flow that remains after warping by it."""
    rest = pair_flow(estimator, pull(partner.rgb, guess), reference.rgb, consistency_px)
    to_partner = rest.to_previous + pull(guess, rest.to_previous)
    return _PairFlow(to_partner, rest.consistent & _usable_in(partner, to_partner) & reference.valid)


def _usable_in(partner: Frame, to_partner: np.ndarray) -> np.ndarray:
    """Return where (H, W) bool flow leads to usable tissue of the partner."""
    return pull(partner.valid.astype(np.float32), to_partner) > 0.5


def pair_exponent(
    depth_mm: np.ndarray,
    flow_to_other: np.ndarray,
    usable: np.ndarray,
    camera: PinholeCamera,
    sigma_share: np.ndarray | None = None,
) -> PairFit | None:
    """Return the exponent for which the predicted depth of one frame explains the flow to another, or None.

    Rotation, translation over the median distance and exponent are the seven unknowns.

    Parameters
    ----------
    depth_mm : (H, W), of any scale, NaN = unknown. flow_to_other : (H, W, 2) px, from this frame. usable : (H, W) bool,
        where both are reliable. camera : of both frames.
    sigma_share : (H, W) relative standard deviation of depth; None: 0.1. It adds parallax * share to the standard
        deviation of each residual.

    Returns None for (nearly) pure rotation, where no motion explains the flow, and where the exponent is unobservable.
    """
    check_shape("flow_to_other", flow_to_other, (camera.height, camera.width, 2))
    sample = _sample(depth_mm, flow_to_other, usable, camera, sigma_share)
    if sample is None:
        return None
    px = camera.width / _REFERENCE_WIDTH_PX
    unknowns, sigma_px = np.array([0, 0, 0, 0, 0, 0, 1.0]), np.full(len(sample.share), 4 * px)
    unknowns = _solve(sample, unknowns, sigma_px, free=3)[0]
    parallax_px = float(np.median(np.linalg.norm(sample.project(unknowns) - sample.target_px, axis=-1)))
    if parallax_px < _MIN_PARALLAX_PX * px:
        return None
    unknowns, result = _solve(sample, unknowns, sigma_px, free=6)
    for _ in range(_ROUNDS):
        sigma_px = _expected_px(sample, unknowns, _FLOW_SIGMA_PX * px)
        error = np.linalg.norm(sample.project(unknowns) - sample.target_px, axis=-1) / sigma_px
        unknowns, result = _solve(sample, unknowns, sigma_px * max(float(np.median(error)), 0.05), free=7)
    return _accepted(sample, unknowns, result, parallax_px)


def modelled_flow(depth_mm: np.ndarray, camera: PinholeCamera, fit: PairFit) -> np.ndarray:
    """Return the flow (H, W, 2) float32, px, that a fit predicts from its predicted depth (H, W); NaN where unknown."""
    true_mm = apply_power_law(depth_mm, camera, fit.exponent, fit.pivot_mm)
    points = transform(fit.T_other_reference, camera.rays * true_mm[..., None])
    return (camera.project(points) - camera.project(camera.rays)).astype(np.float32)


def _sample(
    depth_mm: np.ndarray,
    flow_to_other: np.ndarray,
    usable: np.ndarray,
    camera: PinholeCamera,
    sigma_share: np.ndarray | None,
) -> _Sample | None:
    """Return a uniform sample of pixels; stratified by depth, the worst (nearest, farthest) pixels would dominate."""
    check_shape("depth_mm", depth_mm, (camera.height, camera.width))
    check_shape("usable", usable, (camera.height, camera.width))
    known = usable & (depth_mm > 0) & np.isfinite(flow_to_other).all(-1)
    rows, columns = np.nonzero(known)
    if len(rows) < _MIN_SAMPLES:
        return None
    distance = (depth_mm * ray_lengths(camera))[rows, columns].astype(np.float64)
    pivot_mm = float(np.median(distance))
    logs = np.log(distance / pivot_mm)
    if np.ptp(np.percentile(logs, [1, 99])) < _MIN_LOG_RANGE:
        return None
    if len(rows) > _SAMPLES:
        # Random with a fixed seed: a stride could alias with the image rows.
        chosen = np.random.default_rng(0).choice(len(rows), _SAMPLES, replace=False)
        rows, columns, logs = rows[chosen], columns[chosen], logs[chosen]
    share = np.full(len(rows), _DEFAULT_SHARE)
    if sigma_share is not None:
        share = np.nan_to_num(np.clip(sigma_share[rows, columns], *_SHARE_RANGE), nan=_DEFAULT_SHARE)
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    rays = camera.unproject(pixels)
    cells = rows * _CELLS[0] // camera.height * _CELLS[1] + columns * _CELLS[1] // camera.width
    target_px = pixels + flow_to_other[rows, columns]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return _Sample(camera, pivot_mm, rays, logs, target_px, share, cells)


def _expected_px(sample: _Sample, unknowns: np.ndarray, flow_px: float) -> np.ndarray:
    """Return the standard deviation (N,) px of the residuals: flow error and relative depth error times parallax."""
    rotation_only = np.concatenate([unknowns[:3], np.zeros(3), unknowns[6:]])
    parallax_px = np.linalg.norm(sample.project(unknowns) - sample.project(rotation_only), axis=-1)
    return np.hypot(flow_px, sample.share * parallax_px)


def _solve(sample: _Sample, start: np.ndarray, sigma_px: np.ndarray, *, free: int) -> tuple[np.ndarray, OptimizeResult]:
    """Minimise the soft L1 of the residuals over `sigma_px` (N,) in the first `free` of the 7 unknowns."""

    def residuals(values: np.ndarray) -> np.ndarray:
        error_px = sample.project(np.concatenate([values, start[free:]])) - sample.target_px
        return np.clip(error_px / sigma_px[:, None], -1e4, 1e4).ravel()

    low, high = np.full(7, -np.inf), np.full(7, np.inf)
    low[6], high[6] = _BOUNDS
    result = least_squares(
        residuals, start[:free], loss="soft_l1", bounds=(low[:free], high[:free]), x_scale="jac", max_nfev=40
    )
    return np.concatenate([result.x, start[free:]]), result


def _accepted(sample: _Sample, unknowns: np.ndarray, result: OptimizeResult, parallax_px: float) -> PairFit | None:
    """Return the fit, or None where it explains too little of the flow or the exponent is uncertain."""
    px = sample.camera.width / _REFERENCE_WIDTH_PX
    error_px = np.linalg.norm(sample.project(unknowns) - sample.target_px, axis=-1)
    expected_px = _expected_px(sample, unknowns, _FLOW_SIGMA_PX * px)
    inliers = float(np.mean(error_px <= _INLIER_SIGMAS * expected_px))
    residual_px, deviation = float(np.median(error_px)), _deviation(sample, result)
    limit_px = max(_MAX_RESIDUAL_PX * px, _MAX_RESIDUAL_SHARE * parallax_px)
    if residual_px > limit_px or inliers < _MIN_INLIERS or not deviation <= _MAX_DEVIATION:
        return None
    if not _BOUNDS[0] * 1.01 < unknowns[6] < _BOUNDS[1] / 1.01:
        return None
    T_other_reference = se3(so3_exp(unknowns[:3]), unknowns[3:6] * sample.pivot_mm)
    exponent, pivot_mm = float(unknowns[6]), sample.pivot_mm
    return PairFit(exponent, deviation, parallax_px, residual_px, inliers, pivot_mm, T_other_reference)


def _deviation(sample: _Sample, result: OptimizeResult) -> float:
    """Return the standard deviation of the exponent, infinite where the normal matrix is singular."""
    # scipy gives the Jacobian of soft L1 times (1 + r^2)^(-3/4); the gradient of a residual is r J / sqrt(1 + r^2).
    gradient = result.jac * (result.fun * (1 + result.fun**2) ** 0.25)[:, None]
    cells = np.zeros((sample.cells.max() + 1, result.jac.shape[1]))
    np.add.at(cells, np.repeat(sample.cells, 2), gradient)
    try:
        last = np.linalg.solve(result.jac.T @ result.jac, np.eye(7)[6])
    except np.linalg.LinAlgError:
        return float("inf")
    return float(np.linalg.norm(cells @ last))
