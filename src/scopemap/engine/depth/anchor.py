"""The metric anchor: converts a depth estimate of any kind to mm, fitted once, on the first frame.

With Depth Pro as the anchor of disparity: equation 1 of arXiv 2508.11282 (MAPIS-Depth).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.estimate import DepthEstimate, DepthEstimator, DepthKind, Releasable
from scopemap.engine.depth.pseudo_stereo import AffineDisparity, fit_affine_disparity, fit_baseline_lbfgsb
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.frame import Frame

# A frame with a smaller share of pixels that have both an estimate and an anchor is skipped.
_MIN_SHARE = 0.02  # by hand
_MIN_SHARE_NOTED = 0.005  # by hand: a smaller share beyond the largest depth is not mentioned
_MAX_SHARE_BEYOND = 0.5  # by hand: of the depth that may be beyond the limit without a note
_FACTOR_MM = 1000.0  # `depth.factor` divides it, as in table 3 of the paper
_DISPARITY_FLOOR = 0.1  # by hand: share of the largest disparity, below which the far end would determine a baseline
# Longest side of most images that scopenet was trained on: at twice the size it needs four times as long, and surfaces
# are less consistent.
_SCOPENET_PX = 160


@dataclass(frozen=True)
class DepthScale:
    """Metric depth as predicted depth times a factor."""

    factor: float

    def depth_mm(self, depth: np.ndarray) -> np.ndarray:
        """Return depth (same shape, float32, mm); NaN where the input is NaN or not positive."""
        scaled = np.asarray(depth, dtype=np.float32) * np.float32(self.factor)
        return np.where(scaled > 0, scaled, np.float32(np.nan))

    def sigma_mm(self, sigma: np.ndarray | None) -> np.ndarray | None:
        """Return the standard deviation of depth (same shape, float32, mm); None for None."""
        return None if sigma is None else np.asarray(sigma, dtype=np.float32) * np.float32(self.factor)


@dataclass(frozen=True)
class MetricDepth:
    """Depth of one frame, (H, W) float32, mm, NaN = unknown, its deviation or None, and why most is unknown."""

    depth_mm: np.ndarray
    sigma_mm: np.ndarray | None
    limit_note: str = ""


class AnchoredDepth:
    """Converts the estimates of one sequence to raw metric depth.

    `settings.anchor` chooses the target of the fit to the first frame with enough usable pixels: a range (`near-far`),
    `depth-pro`, the `shading` prior, an arbitrary `factor`, or (`auto`) the range if given, else the estimate's own
    millimetres, else shading. It is fitted once. Measured depth is not changed.
    Raises `SettingsError` where `near-far` has no valid range.

    reference : metric estimator for anchors other than the range and the estimate itself. conversion : of the sequence;
    None until it is fitted. description : the source of the scale. is_measured : whether depth needs no anchor.
    scale_is_known : whether it is measured, or anchored to a range or by Depth Pro. is_stated : whether to a range.
    """

    conversion: AffineDisparity | DepthScale | None = None
    description = "not anchored: no usable frame yet"
    scale_is_known = False
    is_measured = False
    is_stated = False
    just_fitted = False
    """Whether the last frame determined the conversion, so that its depth needs no scale from earlier frames."""

    def __init__(self, settings: DepthSettings, reference: DepthEstimator) -> None:
        _check_range(settings)
        self._settings = settings
        self.reference = reference

    def record(self) -> dict[str, Any]:
        """Return the conversion and what is known of it, for `resume`, as JSON holds it."""
        facts = self.description, self.scale_is_known, self.is_measured, self.is_stated
        return {"facts": facts, "conversion": None if self.conversion is None else asdict(self.conversion)}

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record."""
        self.description, self.scale_is_known, self.is_measured, self.is_stated = record["facts"]
        if (found := record["conversion"]) is not None:
            self.conversion = AffineDisparity(**found) if "shift" in found else DepthScale(**found)

    def metric(self, estimate: DepthEstimate, frame: Frame) -> MetricDepth:
        """Return metric depth (H, W) float32, mm, NaN = unknown, with its standard deviation where it is estimated.

        Sigma is scaled with depth; it is None for disparity, and where the anchor's depth replaces the estimate.
        Predicted depth beyond `max_depth_mm` is NaN. All is NaN until a frame had enough usable pixels. Raises
        `InputError` if the estimate contradicts the anchor.
        """
        self.just_fitted = False
        first_mm, limit_note = self._anchor(estimate, frame) if self.conversion is None else (None, "")
        if self.conversion is None:
            return MetricDepth(np.full(estimate.values.shape, np.nan, dtype=np.float32), None, limit_note)
        if isinstance(self.reference, Releasable):
            self.reference.release()  # a resumed run has it anew
        depth_mm = self.conversion.depth_mm(estimate.values) if first_mm is None else first_mm
        sigma_mm = self.conversion.sigma_mm(estimate.sigma) if first_mm is None else None
        if estimate.kind != "measured":
            share, note = self._beyond_limit(depth_mm, frame.valid)
            limit_note = note if share > _MAX_SHARE_BEYOND else ""
            depth_mm = np.where(depth_mm <= max_depth_mm(self._settings), depth_mm, np.float32(np.nan))
        return MetricDepth(depth_mm, sigma_mm, limit_note)

    def _beyond_limit(self, depth_mm: np.ndarray, usable: np.ndarray) -> tuple[float, str]:
        """Return the share of the usable positive depths that are beyond `max_depth_mm`, and a note from 0.5 % on."""
        positive_mm, limit_mm = depth_mm[usable & (depth_mm > 0)], max_depth_mm(self._settings)
        share = float(np.mean(positive_mm > limit_mm)) if positive_mm.size else 0.0
        if share < _MIN_SHARE_NOTED:
            return share, ""
        limit = f"depth.max_depth_mm = {limit_mm:g}"
        return share, f"{share:.0%} of its depth is beyond {limit} (median {np.median(positive_mm):.0f} mm)"

    def _anchor(self, estimate: DepthEstimate, frame: Frame) -> tuple[np.ndarray | None, str]:
        """Fit the conversion if the frame allows it.

        Returns the depth (H, W) of this frame where the anchor gives it directly, else None, and why the frame does not
        allow it where that is due to `max_depth_mm`.
        """
        usable = frame.valid & np.isfinite(estimate.values)
        if usable.mean() < _MIN_SHARE:
            return None, ""
        first_mm, details = None, ""
        source = self._source(estimate)
        if source == "estimate":
            self.conversion = DepthScale(1.0)
        elif source == "factor":
            self.conversion = self._from_factor(estimate, usable)
        elif source == "near-far":
            self.conversion = self._fitted_to_range(estimate, usable, frame)
        else:
            reference = self.reference.estimate(frame)
            _, limit_note = self._beyond_limit(reference.values, usable)
            known = usable & (reference.values > 0) & (reference.values <= max_depth_mm(self._settings))
            if known.mean() < _MIN_SHARE:
                return None, f"no scale by {self.reference.name}: {limit_note}" if limit_note else ""
            details = self._details(reference, frame) + (f"; {limit_note}, and left the fit" if limit_note else "")
            focal_px = reference.focal_px or frame.camera.fx
            self.conversion = self._fitted(estimate.kind, estimate.values[known], reference.values[known], focal_px)
            # In the paper's form frame 1 keeps the metric network's depth; D = f B / d begins at frame 2.
            first_mm = None if self._settings.fit == "scale-and-shift" else reference.values
        self.just_fitted = True
        self.description = self._describe(source, estimate, frame) + details
        network = (
            self._settings.backend if source == "estimate" else self.reference.name if source == "reference" else ""
        )
        self.is_measured, self.is_stated = estimate.kind == "measured", source == "near-far"
        self.scale_is_known = self.is_measured or self.is_stated or network == "depth-pro"
        return first_mm, ""

    def _source(self, estimate: DepthEstimate) -> Literal["estimate", "near-far", "factor", "reference"]:
        anchor = self._settings.anchor
        if estimate.kind == "measured" or anchor == self._settings.backend:
            return "estimate"
        if anchor == "factor":
            return "factor"
        if anchor == "near-far" or (anchor == "auto" and self._settings.near_far_mm is not None):
            return "near-far"
        return "estimate" if anchor == "auto" and estimate.kind == "depth" else "reference"

    def _from_factor(self, estimate: DepthEstimate, usable: np.ndarray) -> AffineDisparity | DepthScale:
        """Put the nearest tissue at 1000 mm / factor, without shift: the paper's ablation."""
        values, nearest_mm = estimate.values[usable], _FACTOR_MM / self._settings.factor
        positive = values[values > 0]
        if not positive.size:
            raise InputError("anchoring depth by a factor: no pixel of the first usable frame has a positive value")
        if estimate.kind == "disparity":
            return AffineDisparity(1 / (nearest_mm * float(positive.max())), 0.0)
        return DepthScale(nearest_mm / float(positive.min()))

    def _fitted_to_range(
        self, estimate: DepthEstimate, usable: np.ndarray, frame: Frame
    ) -> AffineDisparity | DepthScale:
        values = estimate.values[usable]
        near_far = (values.max(), values.min()) if estimate.kind == "disparity" else (values.min(), values.max())
        range_mm = np.array(self._settings.near_far_mm)
        return self._fitted(estimate.kind, np.array(near_far, np.float64), range_mm, frame.camera.fx)

    def _fitted(
        self, kind: DepthKind, values: np.ndarray, depth_mm: np.ndarray, focal_px: float
    ) -> AffineDisparity | DepthScale:
        """Return the conversion of estimated values (N,) to their metric depth (N,), mm."""
        if kind == "depth":
            return DepthScale(float(np.exp(np.median(np.log(depth_mm / values)))))
        if self._settings.fit == "scale-and-shift":
            return fit_affine_disparity(depth_mm, values, max_depth_mm(self._settings))
        floor_share = 0.0 if self._settings.fit == "pseudo-stereo-all" else _DISPARITY_FLOOR
        baseline_mm = fit_baseline_lbfgsb(depth_mm, values, focal_px, floor_share)
        return AffineDisparity.from_baseline(baseline_mm, focal_px)

    def _describe(self, source: str, estimate: DepthEstimate, frame: Frame) -> str:
        if estimate.kind == "measured":
            return "measured depth"
        if source == "near-far":
            return "near-far {:g}:{:g} mm".format(*self._settings.near_far_mm or ())
        if source == "factor":
            return f"arbitrary: nearest tissue of frame {frame.index} at 1000 mm / {self._settings.factor:g}"
        name = self._settings.backend if source == "estimate" else self.reference.name
        if name == "shading":
            return f"shading prior, median distance {self._settings.shading_median_mm:g} mm"
        return f"Depth Pro on frame {frame.index}" if name == "depth-pro" else f"{name}'s own scale"

    def _details(self, reference: DepthEstimate, frame: Frame) -> str:
        """Return what scales the depth of the reference, "" unless it finds a focal length (Depth Pro)."""
        if reference.focal_px is None:
            return ""
        found_px, known_px = reference.focal_px, frame.camera.fx
        if self._settings.depth_pro_focal == "network" or np.isclose(known_px, found_px, rtol=1e-3):
            return f", by the focal length that it finds, {found_px:.0f} px"
        ratio = known_px / found_px
        return f", times {ratio:.3f}: the camera's focal length is {known_px:.0f} px, it finds {found_px:.0f} px"


def max_depth_mm(settings: DepthSettings) -> float:
    """Return the largest valid predicted depth, mm: `settings.max_depth_mm`, or the far end of near-far if larger."""
    return max(settings.max_depth_mm, *(settings.near_far_mm or (0.0,)))


def depth_downscale(settings: DepthSettings, longest_px: int) -> int:
    """Return what the working size, px, is divided by to estimate depth: for scopenet, by its training size."""
    return max(longest_px // _SCOPENET_PX, 1) if settings.backend == "scopenet" else 1


def _check_range(settings: DepthSettings) -> None:
    if settings.near_far_mm is None:
        if settings.anchor == "near-far":
            raise SettingsError("depth.anchor=near-far needs a range: give it by --near-far NEAR:FAR (mm)")
        return
    near_mm, far_mm = settings.near_far_mm
    if not 0 < near_mm < far_mm:
        raise SettingsError(f"--near-far {near_mm:g}:{far_mm:g}: nearest must be positive and smaller than farthest")
