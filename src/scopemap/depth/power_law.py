"""One exponent for a video: predicted depth that is squeezed or stretched in range, set right by the flow.

Networks and shading get the order of distances right and their range wrong: true distance along the ray is about
c * predicted^e. A moving camera tells e apart from the scale c: c only lengthens the translation, e changes how much
parallax near and far tissue have. Exponent and motion of one pair of frames are therefore fitted together to the flow
between them, by robust least squares. The exponent's deviation, the motion marginalised, comes from the normal matrix
with the residuals summed over cells of the image first (cluster-robust sandwich; Cameron and Miller, "A practitioner's
guide to cluster-robust inference", 2015): neighbouring pixels err alike and are not so many witnesses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import check_shape
from scopemap.geometry.least_squares import robust_sigma
from scopemap.geometry.se3 import se3, so3_exp, transform

EXPONENT_RANGE = (0.5, 2.0)
"""What a fitted exponent is clipped to."""

_SAMPLE = 1500
_LEAST_SAMPLE = 150
_LEAST_LOG_RANGE = 0.1  # of the distances: what is all as far away has no range that could be wrong
_CELLS = (6, 8)  # rows and columns of the cells whose residuals are taken to err alike
# Pixels at a width of 320 px.
_REFERENCE_WIDTH_PX = 320.0
_LEAST_PARALLAX_PX = 1.5
_FLOW_SIGMA_PX = 0.5
_FAIR_RESIDUAL_PX = 0.5
# What depth that says nothing of its error is taken to be wrong by, and between what a told error is believed.
_ASSUMED_SHARE = 0.1
_SHARE_RANGE = (0.05, 0.5)
# A fit whose residual is a larger share of the parallax than this, or that has fewer inliers, explains no flow.
_LARGEST_RESIDUAL_SHARE = 0.35
_LEAST_INLIERS = 0.6
_INLIER_SIGMAS = 3.0
_LARGEST_DEVIATION = 0.3
_ROUNDS = 4
_BOUNDS = (0.25, 4.0)
_NEAREST = 1e-3  # of the median distance: a point behind the camera is kept in front of it
_LEAST_PAIRS = 4
_LARGEST_SPREAD = 0.25  # of ln exponent over the pairs: more is a contradiction
_LEAST_LOG_DEVIATION = 0.02
_MEDIAN_TO_MEAN = 1.2533


@dataclass(frozen=True)
class PairFit:
    """The exponent that one pair of frames asks for.

    Attributes
    ----------
    exponent, deviation : and its standard deviation, the motion marginalised. parallax_px : median flow that no
    rotation explains. residual_px : median distance between the flow and what the fit makes of it. inlier_share : 0..1.
    pivot_mm : distance along the ray, in the unit of the predicted depth, that the exponent leaves as it is.
    T_other_reference : (4, 4), takes points of the stretched depth to the other camera, in the same unit.
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
    """The exponent of a sequence; `reason` says why it was left at 1, "" where it was fitted from `pairs` pairs."""

    exponent: float
    deviation: float
    pairs: int
    reason: str = ""


@dataclass(frozen=True)
class _Sample:
    """N pixels of a frame and where the flow takes them; distances are over their median."""

    camera: PinholeCamera
    pivot_mm: float
    rays: np.ndarray  # (N, 3) of length 1
    log_distance: np.ndarray  # (N,)
    target_px: np.ndarray  # (N, 2)
    share: np.ndarray  # (N,) standard deviation of distance over distance
    cells: np.ndarray  # (N,) number of the image cell

    def seen_px(self, unknowns: np.ndarray) -> np.ndarray:
        """Return (N, 2) pixels in the other frame for (7,): rotation vector, translation over median, exponent."""
        points = self.rays * np.exp(unknowns[6] * self.log_distance)[:, None]
        moved = points @ so3_exp(unknowns[:3]).T + unknowns[3:6]
        moved[:, 2] = np.maximum(moved[:, 2], _NEAREST)
        return self.camera.project(moved)


def stretched(depth_mm: np.ndarray, camera: PinholeCamera, exponent: float, pivot_mm: float) -> np.ndarray:
    """Return depth (H, W) float32 whose distance r along the ray has become pivot * (r / pivot)^exponent.

    depth_mm : (H, W), NaN = unknown, which it stays, and so becomes what is not positive. pivot_mm : the distance along
    the ray, in the same unit, that stays as it is.
    """
    check_shape("depth_mm", depth_mm, (camera.height, camera.width))
    along = ray_lengths(camera)
    distance = np.where(depth_mm > 0, depth_mm, np.nan).astype(np.float64) * along
    return (pivot_mm * (distance / pivot_mm) ** exponent / along).astype(np.float32)


def ray_lengths(camera: PinholeCamera) -> np.ndarray:
    """Return distance along the ray over depth, (H, W) float32, at least 1."""
    return np.linalg.norm(camera.rays, axis=-1)


def modelled_flow(depth_mm: np.ndarray, camera: PinholeCamera, fit: PairFit) -> np.ndarray:
    """Return the flow (H, W, 2) float32, px, that a fit makes of the predicted depth (H, W) it came from, else NaN."""
    true_mm = stretched(depth_mm, camera, fit.exponent, fit.pivot_mm)
    points = transform(fit.T_other_reference, camera.rays * true_mm[..., None])
    return (camera.project(points) - camera.project(camera.rays)).astype(np.float32)


def pair_exponent(
    depth_mm: np.ndarray,
    flow_to_other: np.ndarray,
    usable: np.ndarray,
    camera: PinholeCamera,
    sigma_share: np.ndarray | None = None,
) -> PairFit | None:
    """Return the exponent under which the predicted depth of one frame explains the flow to another, or None.

    Rotation, translation over the median distance and exponent are unknown, nothing of the motion is given.

    Parameters
    ----------
    depth_mm : (H, W), of any scale, NaN = unknown. flow_to_other : (H, W, 2) px, from this frame. usable : (H, W) bool,
        where both can be trusted. camera : of both frames.
    sigma_share : (H, W) standard deviation of depth over depth, or None: 0.1. An error of depth moves a pixel in
        proportion to its parallax, so it decides, with the flow's own error, how much a pixel counts.

    Returns None where the camera hardly moved but turned, where no motion explains the flow, and where range and motion
    cannot be told apart.
    """
    check_shape("flow_to_other", flow_to_other, (camera.height, camera.width, 2))
    sample = _sampled(depth_mm, flow_to_other, usable, camera, sigma_share)
    if sample is None:
        return None
    px = camera.width / _REFERENCE_WIDTH_PX
    unknowns, sigma_px = np.array([0, 0, 0, 0, 0, 0, 1.0]), np.full(len(sample.share), 4 * px)
    unknowns = _solved(sample, unknowns, sigma_px, free=3)[0]
    parallax_px = float(np.median(np.linalg.norm(sample.seen_px(unknowns) - sample.target_px, axis=-1)))
    if parallax_px < _LEAST_PARALLAX_PX * px:
        return None
    unknowns, result = _solved(sample, unknowns, sigma_px, free=6)
    for _ in range(_ROUNDS):
        sigma_px = _expected_px(sample, unknowns, _FLOW_SIGMA_PX * px)
        error = np.linalg.norm(sample.seen_px(unknowns) - sample.target_px, axis=-1) / sigma_px
        unknowns, result = _solved(sample, unknowns, sigma_px * max(float(np.median(error)), 0.05), free=7)
    return _judged(sample, unknowns, result, parallax_px)


def sequence_exponent(fits: list[PairFit]) -> ExponentFit:
    """Return the exponent of a sequence from those of its pairs: their median in the logarithm, by inverse variance.

    Clipped to `EXPONENT_RANGE`. 1, with the reason, where fewer than four pairs could be fitted or they contradict each
    other. Its deviation follows from what the pairs claim and from what they differ by, as if they were independent,
    which pairs that share frames are not quite.
    """
    if len(fits) < _LEAST_PAIRS:
        return ExponentFit(1.0, 0.0, len(fits), f"{len(fits)} pair(s) of frames could be fitted, {_LEAST_PAIRS} needed")
    logs = np.log([fit.exponent for fit in fits])
    claimed = np.array([max(fit.deviation / fit.exponent, _LEAST_LOG_DEVIATION) for fit in fits])
    # What the pairs differ by beyond their claims is an error too, the same for all.
    spread = robust_sigma(logs - np.median(logs))
    weight = 1 / (claimed**2 + spread**2)
    centre = _weighted_median(logs, weight)
    if spread > _LARGEST_SPREAD:
        low, high = np.exp(np.percentile(logs, [25, 75]))
        return ExponentFit(1.0, 0.0, len(fits), f"{len(fits)} pairs of frames contradict: {low:.2f} to {high:.2f}")
    exponent = float(np.clip(np.exp(centre), *EXPONENT_RANGE))
    return ExponentFit(exponent, exponent * _MEDIAN_TO_MEAN * float(weight.sum() ** -0.5), len(fits))


def _weighted_median(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values)
    position = np.cumsum(weight[order]) - weight[order] / 2
    return float(np.interp(weight.sum() / 2, position, values[order]))


def _sampled(
    depth_mm: np.ndarray,
    flow_to_other: np.ndarray,
    usable: np.ndarray,
    camera: PinholeCamera,
    sigma_share: np.ndarray | None,
) -> _Sample | None:
    """Take pixels evenly over the image.

    In equal numbers from near and far, the few nearest and farthest pixels, which are the most wrong, would decide.
    """
    check_shape("depth_mm", depth_mm, (camera.height, camera.width))
    check_shape("usable", usable, (camera.height, camera.width))
    known = usable & (depth_mm > 0) & np.isfinite(flow_to_other).all(-1)
    rows, columns = np.nonzero(known)
    if len(rows) < _LEAST_SAMPLE:
        return None
    distance = (depth_mm * ray_lengths(camera))[rows, columns].astype(np.float64)
    pivot_mm = float(np.median(distance))
    logs = np.log(distance / pivot_mm)
    if np.ptp(np.percentile(logs, [1, 99])) < _LEAST_LOG_RANGE:
        return None
    if len(rows) > _SAMPLE:
        # By chance, not by a stride, which could fall into step with the rows; the same chance every time.
        chosen = np.random.default_rng(0).choice(len(rows), _SAMPLE, replace=False)
        rows, columns, logs = rows[chosen], columns[chosen], logs[chosen]
    share = np.full(len(rows), _ASSUMED_SHARE)
    if sigma_share is not None:
        share = np.nan_to_num(np.clip(sigma_share[rows, columns], *_SHARE_RANGE), nan=_ASSUMED_SHARE)
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    rays = camera.unproject(pixels)
    cells = rows * _CELLS[0] // camera.height * _CELLS[1] + columns * _CELLS[1] // camera.width
    target_px = pixels + flow_to_other[rows, columns]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return _Sample(camera, pivot_mm, rays, logs, target_px, share, cells)


def _expected_px(sample: _Sample, unknowns: np.ndarray, flow_px: float) -> np.ndarray:
    """Return the standard deviation (N,) px of the residuals: of the flow, and of depth times the pixel's parallax."""
    turned_only = np.concatenate([unknowns[:3], np.zeros(3), unknowns[6:]])
    parallax_px = np.linalg.norm(sample.seen_px(unknowns) - sample.seen_px(turned_only), axis=-1)
    return np.hypot(flow_px, sample.share * parallax_px)


def _solved(
    sample: _Sample, start: np.ndarray, sigma_px: np.ndarray, *, free: int
) -> tuple[np.ndarray, OptimizeResult]:
    """Minimise the soft L1 of the residuals over `sigma_px` (N,) in the first `free` of the 7 unknowns."""

    def residuals(values: np.ndarray) -> np.ndarray:
        error_px = sample.seen_px(np.concatenate([values, start[free:]])) - sample.target_px
        return np.clip(error_px / sigma_px[:, None], -1e4, 1e4).ravel()

    low, high = np.full(7, -np.inf), np.full(7, np.inf)
    low[6], high[6] = _BOUNDS
    result = least_squares(
        residuals, start[:free], loss="soft_l1", bounds=(low[:free], high[:free]), x_scale="jac", max_nfev=40
    )
    return np.concatenate([result.x, start[free:]]), result


def _judged(sample: _Sample, unknowns: np.ndarray, result: OptimizeResult, parallax_px: float) -> PairFit | None:
    """Return the fit, or None where it explains too little or leaves the exponent open."""
    px = sample.camera.width / _REFERENCE_WIDTH_PX
    error_px = np.linalg.norm(sample.seen_px(unknowns) - sample.target_px, axis=-1)
    expected_px = _expected_px(sample, unknowns, _FLOW_SIGMA_PX * px)
    inliers = float(np.mean(error_px <= _INLIER_SIGMAS * expected_px))
    residual_px, deviation = float(np.median(error_px)), _deviation(sample, result)
    fair_px = max(_FAIR_RESIDUAL_PX * px, _LARGEST_RESIDUAL_SHARE * parallax_px)
    if residual_px > fair_px or inliers < _LEAST_INLIERS or not deviation <= _LARGEST_DEVIATION:
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
