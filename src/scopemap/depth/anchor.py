"""The metric anchor: what turns a depth estimate of any kind into millimetres, fixed on the first frame and then held.

METHOD section MAPIS-Depth, steps 1-4. Only scale (and shift, of a disparity) are fitted, once: a scale that floats from
frame to frame is the business of the consistency stage, which knows how the camera moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scopemap.config import DepthSettings
from scopemap.depth.estimate import DepthEstimate, DepthEstimator
from scopemap.depth.power_law import ray_lengths, stretched
from scopemap.depth.pseudo_stereo import AffineDisparity, fit_affine_disparity, fit_baseline_lbfgsb
from scopemap.errors import InputError, SettingsError
from scopemap.frame import Frame

# A frame with less that has both an estimate and an anchor cannot fix a scale: the next one is tried.
_LEAST_SHARE = 0.02
_FACTOR_MM = 1000.0


@dataclass(frozen=True)
class DepthScale:
    """Depth from a predicted depth by one factor."""

    factor: float

    def depth_mm(self, depth: np.ndarray) -> np.ndarray:
        """Return depth (same shape, float32, mm); NaN stays NaN, and so becomes what is not positive."""
        scaled = np.asarray(depth, dtype=np.float32) * np.float32(self.factor)
        return np.where(scaled > 0, scaled, np.float32(np.nan))

    def sigma_mm(self, sigma: np.ndarray | None) -> np.ndarray | None:
        """Return the standard deviation, same shape, float32, mm, of depth with that of `sigma`; None for None."""
        return None if sigma is None else np.asarray(sigma, dtype=np.float32) * np.float32(self.factor)


@dataclass(frozen=True)
class MetricDepth:
    """Depth of one frame in millimetres, and what is known of its error.

    Attributes
    ----------
    depth_mm : (H, W) float32, NaN = unknown. sigma_mm : (H, W) float32, one standard deviation, NaN = unknown; None:
    nothing is said.
    """

    depth_mm: np.ndarray
    sigma_mm: np.ndarray | None


@dataclass(frozen=True)
class _Target:
    """What the anchor says: estimated values (N,) and the depth (N,) in mm they should come out as."""

    values: np.ndarray
    depth_mm: np.ndarray
    focal_px: float


class AnchoredDepth:
    """Turns the estimates of one sequence into raw metric depth.

    The first frame with enough usable pixels fixes the conversion, which is held for all later frames.
    `settings.anchor` chooses what it is fitted to: a given range (`near-far`), a metric network's estimate of that
    frame (`depth-pro`), the shading prior (`shading`), an arbitrary number (`factor`), or (`auto`) the range if one is
    given, else the estimate's own millimetres if it has them, else shading. Measured depth is never touched.

    `settings.exponent` widens (or, below 1, narrows) the range of predicted depth before anything else: the median
    distance along the ray of the first usable frame is the pivot, which stays, and is held too.

    `settings.reanchor_every` asks the reference again every so many frames: a metric network then bounds the drift.

    reference : the estimator that is asked where the anchor is neither the range nor the estimate itself.
    Raises `SettingsError` where `near-far` is asked for and no range, or an impossible one, is given.
    """

    def __init__(self, settings: DepthSettings, reference: DepthEstimator) -> None:
        _check_range(settings)
        self._settings = settings
        self._reference = reference
        self._conversion: AffineDisparity | DepthScale | None = None
        self._description = "not anchored: no usable frame yet"
        self._frames_held = 0
        self._pivot: float | None = None

    @property
    def description(self) -> str:
        """What fixed the scale, for people: for instance "near-far 13.5:100 mm"."""
        return self._description

    @property
    def reference(self) -> DepthEstimator:
        """The estimator that is asked where the anchor is neither the range nor the estimate itself."""
        return self._reference

    @property
    def just_fitted(self) -> bool:
        """Whether the frame that came last fixed the conversion, so that its depth needs no scale from the past."""
        return self._conversion is not None and self._frames_held == 0

    @property
    def conversion(self) -> AffineDisparity | DepthScale | None:
        """The conversion that holds for the sequence; None until a frame fixed it."""
        return self._conversion

    def depth_mm(self, estimate: DepthEstimate, frame: Frame) -> np.ndarray:
        """Return the depth of `metric` alone."""
        return self.metric(estimate, frame).depth_mm

    def metric(self, estimate: DepthEstimate, frame: Frame) -> MetricDepth:
        """Return metric depth (H, W) float32 in mm, NaN = unknown or not positive, with its sigma where one is told.

        Sigma is scaled as a predicted or measured depth is; of a disparity nothing is said, and neither is it where
        the anchor's own depth takes the estimate's place.

        Depth that is not measured is NaN too beyond `reach_mm`, where an estimate says nothing any more.
        All NaN as long as no frame had enough usable pixels. Raises `InputError` if the estimate contradicts the
        anchor, `SettingsError` if an exponent is asked for and the estimate is no predicted depth.
        """
        estimate = self._in_range(estimate, frame)
        self._frames_held += 1
        first_mm = self._anchor(estimate, frame) if self._is_due(estimate) else None
        if self._conversion is None:
            return MetricDepth(np.full(estimate.values.shape, np.nan, dtype=np.float32), None)
        depth_mm = self._conversion.depth_mm(estimate.values) if first_mm is None else first_mm
        sigma_mm = self._conversion.sigma_mm(estimate.sigma) if first_mm is None else None
        if estimate.kind != "measured":
            depth_mm = np.where(depth_mm <= reach_mm(self._settings), depth_mm, np.float32(np.nan))
        return MetricDepth(depth_mm, sigma_mm)

    def _in_range(self, estimate: DepthEstimate, frame: Frame) -> DepthEstimate:
        """Return the estimate with the range that the exponent gives it; its error grows in proportion, as a share."""
        exponent = self._settings.exponent
        if exponent == "fit":
            raise SettingsError("depth.exponent=fit: only a whole run can fit it, before it starts; give a number here")
        if exponent == 1.0:
            return estimate
        if estimate.kind != "depth":
            raise SettingsError(
                f"depth.exponent={exponent:g} is for predicted depth; depth.backend={self._settings.backend} gives "
                f"{estimate.kind}: leave it at 1"
            )
        if self._pivot is None:
            distance = estimate.values * ray_lengths(frame.camera)
            seen = distance[frame.valid & (distance > 0)]
            if seen.size < _LEAST_SHARE * distance.size:
                return estimate
            self._pivot = float(np.median(seen))
        values = stretched(estimate.values, frame.camera, exponent, self._pivot)
        if estimate.sigma is None:
            return replace(estimate, values=values)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = (estimate.sigma * np.float32(exponent) * values / estimate.values).astype(np.float32)
        return replace(estimate, values=values, sigma=sigma)

    def _is_due(self, estimate: DepthEstimate) -> bool:
        if self._conversion is None:
            return True
        every = self._settings.reanchor_every
        return every > 0 and self._frames_held >= every and self._source(estimate) == "reference"

    def _anchor(self, estimate: DepthEstimate, frame: Frame) -> np.ndarray | None:
        """Fix the conversion; return this frame's depth (H, W) where it is the anchor's and not the conversion's."""
        usable = frame.valid & np.isfinite(estimate.values)
        if usable.mean() < _LEAST_SHARE:
            return None
        first_mm = None
        source = self._source(estimate)
        if source == "own":
            self._conversion = DepthScale(1.0)
        elif source == "factor":
            self._conversion = self._by_factor(estimate, usable)
        elif source == "near-far":
            self._conversion = self._fitted(estimate, self._range_target(estimate, usable, frame))
        else:
            reference = self._reference.estimate(frame)
            known = usable & (reference.values > 0) & (reference.values <= reach_mm(self._settings))
            if known.mean() < _LEAST_SHARE:
                return None
            focal_px = reference.focal_px or frame.camera.fx
            target = _Target(estimate.values[known], reference.values[known], focal_px)
            self._conversion = self._fitted(estimate, target)
            # In the paper's form frame 1 keeps the metric network's depth; D = f B / d begins at frame 2.
            first_mm = None if self._settings.fit_shift else reference.values
        self._frames_held = 0
        self._description = self._described(source, estimate, frame)
        return first_mm

    def _source(self, estimate: DepthEstimate) -> Literal["own", "near-far", "factor", "reference"]:
        anchor = self._settings.anchor
        if estimate.kind == "measured" or anchor == self._settings.backend:
            return "own"
        if anchor == "factor":
            return "factor"
        if anchor == "near-far" or (anchor == "auto" and self._settings.near_far_mm is not None):
            return "near-far"
        return "own" if anchor == "auto" and estimate.kind == "depth" else "reference"

    def _by_factor(self, estimate: DepthEstimate, usable: np.ndarray) -> AffineDisparity | DepthScale:
        """Put the nearest tissue at 1000 mm / factor, without shift: the paper's ablation."""
        values, nearest_mm = estimate.values[usable], _FACTOR_MM / self._settings.factor
        positive = values[values > 0]
        if not positive.size:
            raise InputError("anchoring depth by a factor: no pixel of the first usable frame has a positive value")
        if estimate.kind == "disparity":
            return AffineDisparity(1 / (nearest_mm * float(positive.max())), 0.0)
        return DepthScale(nearest_mm / float(positive.min()))

    def _range_target(self, estimate: DepthEstimate, usable: np.ndarray, frame: Frame) -> _Target:
        values = estimate.values[usable]
        near_far = (values.max(), values.min()) if estimate.kind == "disparity" else (values.min(), values.max())
        return _Target(np.array(near_far, np.float64), np.array(self._settings.near_far_mm), frame.camera.fx)

    def _fitted(self, estimate: DepthEstimate, target: _Target) -> AffineDisparity | DepthScale:
        if estimate.kind == "depth":
            return DepthScale(float(np.exp(np.median(np.log(target.depth_mm / target.values)))))
        if self._settings.fit_shift:
            return fit_affine_disparity(target.depth_mm, target.values, reach_mm(self._settings))
        baseline_mm = fit_baseline_lbfgsb(target.depth_mm, target.values, target.focal_px)
        return AffineDisparity.from_baseline(baseline_mm, target.focal_px)

    def _described(self, source: str, estimate: DepthEstimate, frame: Frame) -> str:
        if estimate.kind == "measured":
            return "measured depth"
        if source == "near-far":
            return "near-far {:g}:{:g} mm".format(*self._settings.near_far_mm or ())
        if source == "factor":
            return f"arbitrary: nearest tissue of frame {frame.index} at 1000 mm / {self._settings.factor:g}"
        name = self._settings.backend if source == "own" else self._reference.name
        if name == "shading":
            return f"shading prior, median distance {self._settings.shading_median_mm:g} mm"
        return f"Depth Pro on frame {frame.index}" if name == "depth-pro" else f"millimetres as {name} gives them"


def reach_mm(settings: DepthSettings) -> float:
    """Return how far predicted depth may reach, mm: a stated farthest tissue is believed beyond `max_depth_mm`."""
    return max(settings.max_depth_mm, *(settings.near_far_mm or (0.0,)))


def _check_range(settings: DepthSettings) -> None:
    if settings.near_far_mm is None:
        if settings.anchor == "near-far":
            raise SettingsError("depth.anchor=near-far needs a range: give it by --near-far NEAR:FAR (mm)")
        return
    near_mm, far_mm = settings.near_far_mm
    if not 0 < near_mm < far_mm:
        raise SettingsError(f"--near-far {near_mm:g}:{far_mm:g}: nearest must be positive and smaller than farthest")
