"""Focal length of a sequence and its standard deviation, combined from the bundle adjustments of its windows.

A window is adjusted with an unknown focal length and distortion, from no motion and one depth for all points (Ha et
al., CVPR 2016). The standard deviation of ln f is a cluster-robust sandwich over blocks of the image, because the
errors of neighbouring corners are correlated. The variance between windows is estimated, too (DerSimonian and Laird
1986). A lamp that moves with the camera biases the rotation by about 0.4 degrees: where the optical axis tilts by T
degrees, the relative error of the focal length is 0.4 / T in all windows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.errors import CalibrationError
from scopemap.engine.frame import Frame
from scopemap.engine.models.device import cpu_threads
from scopemap.engine.notices import Notice
from scopemap.input.focal_length.trial import LensTrial, try_lenses
from scopemap.input.focal_length.window_adjustment import Scene, WindowSolution, adjusted, at_rest
from scopemap.input.focal_length.windows import MAX_FRAMES, Window, frames_of_windows, window_of
from scopemap.input.scopes import ANY_LENS, FOV_RANGE_DEG, KINDS, SCOPES
from scopemap.input.sequence import Sequence

_LOG_DEPTH_SIGMA = 1.0
_DISTORTION_SIGMA = 0.3
_LOG_FOCAL_SIGMA = 1.0
_NO_DISTORTION_SIGMA = 1e-4
_START_FOV_DEG = (60.0, 105.0)
_BLOCKS = 4  # columns and rows of the image within which errors are correlated
# Iterations, and smallest relative decrease: first of all starts, then of the best one with distortion.
_FIRST = (15, 1e-3)
_THEN = (30, 1e-4)


@dataclass(frozen=True)
class WindowFit:
    """Focal length from one window.

    log_focal : ln of fx, px. deviation : its standard deviation, all else marginalised. residual_px : robust standard
    deviation of the reprojection errors. tilt_deg : largest tilt of the optical axis against the host's. distortion :
    b of `window_adjustment`.
    """

    log_focal: float
    deviation: float
    residual_px: float
    tilt_deg: float
    distortion: float


def adjust_window(window: Window, assumed_focal_px: float) -> WindowFit | None:
    """Return the fit to a window from the best start, None where undetermined; ln f has a prior of deviation 1."""
    assumed, squeeze, count = np.array([math.log(assumed_focal_px), 0.0]), [1.0, window.aspect], len(window.start)
    free = Scene(
        window.start / squeeze,
        window.seen / squeeze,
        np.zeros(count),
        np.full(count, _LOG_DEPTH_SIGMA),
        window.half_width_px,
        assumed,
        np.array([_LOG_FOCAL_SIGMA, _DISTORTION_SIGMA]),
    )
    straight = free._replace(lens_sigma=np.array([_LOG_FOCAL_SIGMA, _NO_DISTORTION_SIGMA]))
    starts = [math.log(window.half_width_px / math.tan(math.radians(fov_deg) / 2)) for fov_deg in _START_FOV_DEG]
    rest = at_rest(free)
    found = [adjusted(straight, rest._replace(lens=np.array([start, 0.0])), *_FIRST) for start in starts]
    best = adjusted(free, min(found, key=lambda one: one.sigma_px).state, *_THEN)
    deviation = _log_focal_deviation(free, best)
    if not np.isfinite(deviation):
        return None
    tilt_deg = float(np.degrees(np.arccos(np.clip(best.state.T[:, 2, 2].min(), -1, 1))))
    log_focal, bend = best.state.lens.tolist()
    return WindowFit(log_focal, deviation, best.sigma_px, tilt_deg, bend)


def _log_focal_deviation(scene: Scene, found: WindowSolution) -> float:
    """Return the cluster-robust standard deviation of ln f, all else marginalised; NaN where it is undetermined."""
    try:
        influence = np.linalg.pinv(found.reduced(), hermitian=True)[-2]
    except np.linalg.LinAlgError:
        return float("nan")
    scores, pixel = found.scores - found.E * (found.g / found.h)[:, None], scene.start
    low, high = pixel.min(0), pixel.max(0)
    cell = np.clip((pixel - low) / np.maximum(high - low, 1e-9) * _BLOCKS, 0, _BLOCKS - 1).astype(int)
    number = cell[:, 0] * _BLOCKS + cell[:, 1]
    influences = np.bincount(number, weights=scores @ influence, minlength=_BLOCKS**2)
    filled = len(np.unique(number))
    return float(np.sqrt((influences**2).sum() * filled / max(filled - 1, 1)))


MAX_SHARE = 0.05
"""Standard deviation over the focal length above which an estimate from motion is not taken: two are 10 %."""

_MIN_DISTORTION = 0.05  # smaller estimates are noise
_ROTATION_ERROR_DEG = 0.4
_MIN_TILT_DEG = 0.05
_MIN_SHARE = 0.01  # of any window's deviation
_MAX_RESIDUAL = 0.001  # share of the width; larger reprojection errors mean that tissue deforms
_MIN_WINDOWS = 2
_SIGNIFICANT = 2.0


@dataclass(frozen=True)
class FocalEstimate:
    """Focal length estimated from motion.

    focal_px : horizontal focal length at the sequence's working size, NaN = unknown. share : its standard deviation
    over itself. fov_deg : horizontal field of view. windows : number of windows used. distortion : radial distortion, b
    of `window_adjustment`. reason : why there is no estimate, or "".
    """

    focal_px: float
    share: float
    fov_deg: float
    windows: int
    distortion: float = 0.0
    reason: str = ""

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the focal length, px at the working size."""
        return self.share * self.focal_px

    def differs_from(self, focal_px: float) -> bool:
        """Whether it differs from another focal length by two standard deviations or more."""
        return bool(abs(math.log(self.focal_px / focal_px)) >= _SIGNIFICANT * self.share)


def with_focal_from_motion(sequence: Sequence, config: Config) -> tuple[Sequence, list[Notice]]:
    """Return a sequence of unknown camera with the focal length estimated from its motion, and notices about the lens.

    Where the estimate is not taken the focal length stays, of a stated kind of endoscope weighed with what was seen,
    and `camera_source` says why. `input.focal` "flow" takes any estimate, "auto" one of small deviation that
    contradicts the assumed focal length. Raises `CalibrationError` where there is no estimate for "flow".
    """
    windows: list[Window] = []
    estimate, assumed_px = focal_from_motion(sequence, config, windows), sequence.camera.fx
    wanted, scope = config.input.focal == "flow", SCOPES.get(config.input.scope, ANY_LENS)
    if wanted and estimate.reason:
        raise CalibrationError(
            f"input.focal = flow: the motion in {sequence.path} does not constrain the focal length: "
            f"{estimate.reason}; give a calibration (--camera) or the field of view (--fov, with input.focal = assume)"
        )
    described = (
        f"fx {estimate.focal_px:.0f} +- {max(estimate.sigma_px, 1):.0f} px, horizontal field of view "
        f"{estimate.fov_deg:.0f} deg"
    )
    kept, why, found = "", "", None
    if estimate.reason:
        kept = f"the motion does not constrain it: {estimate.reason}"
        why = estimate.reason
    elif not wanted and estimate.share > MAX_SHARE:
        kept = f"the estimate from the motion is uncertain: {described}"
        why = "the estimate from the camera motion is too uncertain"
    is_unknown, bends = bool(kept), abs(estimate.distortion) >= _MIN_DISTORTION
    if not wanted and (is_unknown or bends):
        # A run that adjusts nothing afterwards does not wait for windows to be adjusted.
        adjusts = config.mapping.global_adjustment
        found = try_lenses(windows, scope) if adjusts else None
        tried = _agreeing(found, estimate, sequence, windows)
        if tried is not None and not tried.reason:
            return _with_tried(sequence, tried, windows, "estimated: by trial of lenses"), []
        if is_unknown:
            undecided = "too few of the first frames show a rigid scene" if tried is None else tried.reason
            kept += f"; a trial of typical lenses was inconclusive: {undecided}" if adjusts else ""
            sequence.source.warnings.append(Notice("camera-unknown", {"reason": why}))
    if not kept and not wanted and not estimate.differs_from(assumed_px):
        kept = f"{assumed_px:.0f} px, consistent with the estimate from the motion: {described}"
    if kept and is_unknown and config.input.scope:
        source, focal_px = f"{sequence.camera_source}; {kept}", scope.focal * sequence.camera.width
        if found is not None and found.reason:
            # Its mean weighs what is expected against what was seen.
            used = f"{source}; used: the likeliest of such lenses"
            return replace(_with_tried(sequence, found, windows, used), is_estimated=False), []
        sigma_px, fisheye = scope.spread * focal_px, KINDS[scope.kinds[0]]
        return sequence.with_focal(focal_px, source, sigma_px, fisheye, is_estimated=False), []
    if kept:
        return replace(sequence, camera_source=f"{sequence.camera_source}; {kept}"), []
    distorted = Notice("camera-distorted", {"share": abs(estimate.distortion)})
    source = f"estimated: from the motion of {min(sequence.count or MAX_FRAMES, MAX_FRAMES)} frames, {described}"
    return sequence.with_focal(estimate.focal_px, source, estimate.sigma_px), [distorted] * bends


def _agreeing(
    tried: LensTrial | None, motion: FocalEstimate, sequence: Sequence, windows: list[Window]
) -> LensTrial | None:
    """Return a trial's result; a pinhole that the motion, which needs no depth, contradicts gets a `reason`."""
    if tried is None or tried.reason or motion.reason or tried.kind != "pinhole":
        return tried
    scale = sequence.camera.width / (2 * windows[0].half_width_px)
    if abs(math.log(scale * tried.focal_px / motion.focal_px)) <= motion.share:
        return tried
    return replace(tried, reason=f"its pinhole of {tried.fov_deg:.0f} deg is not that of the motion")


def _with_tried(sequence: Sequence, tried: LensTrial, windows: list[Window], how: str) -> Sequence:
    """Return the sequence seen through the lens that a trial found, and `how` it is known."""
    scale = sequence.camera.width / (2 * windows[0].half_width_px)
    focal_px, sigma_px = scale * tried.focal_px, scale * tried.focal_px * tried.share
    source = (
        f"{how} in {tried.windows} windows, {tried.kind}, fx {focal_px:.0f} +- "
        f"{max(sigma_px, 1):.0f} px, horizontal field of view {tried.fov_deg:.0f} deg"
    )
    return sequence.with_focal(focal_px, source, sigma_px, KINDS[tried.kind])


def focal_from_motion(sequence: Sequence, config: Config, windows: list[Window] | None = None) -> FocalEstimate:
    """Return the focal length estimated from the first frames of a sequence; its camera's is the mean of the prior."""
    camera = sequence.camera

    def adjusted_window(frames: list[Frame]) -> tuple[Window, WindowFit | None] | None:
        window = window_of(frames)
        if window is None:
            return None
        return window, adjust_window(window, camera.fx * 2 * window.half_width_px / camera.width)

    # Frames are read while the windows of those before are found and adjusted.
    with ThreadPoolExecutor(cpu_threads()) as pool:
        found = [one for one in pool.map(adjusted_window, frames_of_windows(sequence, config)) if one is not None]
    if windows is not None:
        windows.extend(window for window, _ in found)
    # All windows have one size, which may be smaller than the sequence's.
    width_px = 2 * found[0][0].half_width_px if found else camera.width
    fits = [fit for _, fit in found if fit is not None and fit.residual_px <= _MAX_RESIDUAL * width_px]
    estimate = combine(fits, width_px)
    return replace(estimate, focal_px=estimate.focal_px * camera.width / width_px)


def combine(fits: Iterable[WindowFit], width_px: float) -> FocalEstimate:
    """Return the combined estimate of windows of images of this width; its relative deviation is 1 % or more."""
    used = [fit for fit in fits if fit.tilt_deg >= _MIN_TILT_DEG]
    if len(used) < _MIN_WINDOWS:
        reason = "the camera turns too little in the first frames, or the scene is not rigid"
        return FocalEstimate(math.nan, math.inf, math.nan, len(used), reason=reason)
    logs = np.array([fit.log_focal for fit in used])
    shared = np.array([_ROTATION_ERROR_DEG / fit.tilt_deg for fit in used])
    own = np.array([fit.deviation for fit in used]) ** 2 + _MIN_SHARE**2
    scatter = _scatter(logs, own + shared**2)
    weight = 1 / (own + shared**2 + scatter)
    weight /= weight.sum()
    share = math.hypot(math.sqrt(float((weight**2 * (own + scatter)).sum())), float(weight @ shared))
    focal_px = math.exp(float(weight @ logs))
    fov_deg = 2 * math.degrees(math.atan(width_px / 2 / focal_px))
    possible = FOV_RANGE_DEG[0] <= fov_deg <= FOV_RANGE_DEG[1]
    reason = "" if possible else f"the motion fits a field of view of {fov_deg:.0f} deg, which no endoscope has"
    distortion = float(np.median([fit.distortion for fit in used]))
    return FocalEstimate(focal_px, share, fov_deg, len(used), distortion, reason)


def _scatter(values: np.ndarray, variances: np.ndarray) -> float:
    """Return the variance between values, without their own variances (DerSimonian and Laird, 1986)."""
    weight = 1 / variances
    mean = weight @ values / weight.sum()
    excess = weight @ (values - mean) ** 2 - (len(values) - 1)
    return max(0.0, float(excess / (weight.sum() - (weight**2).sum() / weight.sum())))
