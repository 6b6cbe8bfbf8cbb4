"""From relative disparity to metric depth: pseudo-stereo baseline and robust affine fit.

The baseline is equation 1 of arXiv 2508.11282; the fit with a shift is not in the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.least_squares import huber_weight, robust_sigma

_HUBER_SIGMAS = 1.345  # 95 % efficient on Gaussian errors (Holland and Welsch 1977)
_ITERATIONS = 30  # guard: reweightings


@dataclass(frozen=True)
class AffineDisparity:
    """Depth from disparity by 1 / D = scale * d + shift; the pseudo-stereo form D = f B / d is scale = 1 / (f B)."""

    scale: float
    shift: float

    @classmethod
    def from_baseline(cls, baseline_mm: float, focal_px: float) -> AffineDisparity:
        """Return the conversion D = f B / d of a pseudo-stereo pair."""
        return cls(1 / (baseline_mm * focal_px), 0.0)

    def depth_mm(self, disparity: np.ndarray) -> np.ndarray:
        """Return depth (same shape, float32, mm); NaN where disparity is NaN or the depth is infinite or negative."""
        inverse = self.scale * np.asarray(disparity, dtype=np.float64) + self.shift
        return np.divide(1.0, inverse, out=np.full(inverse.shape, np.nan), where=inverse > 0).astype(np.float32)

    def sigma_mm(self, sigma: np.ndarray | None) -> np.ndarray | None:
        """Return None: the depth error of a disparity depends on its shift, which is uncertain."""
        return None


def fit_baseline_lbfgsb(
    depth_mm: np.ndarray, disparity: np.ndarray, focal_px: float, floor_share: float = 0.0
) -> float:
    """Return the baseline B (mm) that minimises the mean of (D - f B / d)^2 (equation 1), by L-BFGS-B.

    depth_mm, disparity : arrays of one shape; pixels that are not finite and positive are left out.
    floor_share : pixels below this share of the largest disparity are left out, too: f / d of d near 0 would dominate
        the sum.

    The variables are brought to order one first: the optimiser's tolerances are absolute in the gradient. Raises
    `InputError` if no pixel is left.
    """
    depth, d = np.asarray(depth_mm, np.float64).ravel(), np.asarray(disparity, np.float64).ravel()
    known = np.isfinite(depth) & np.isfinite(d) & (depth > 0) & (d > 0)
    known[known] = d[known] >= floor_share * d[known].max(initial=0)
    if not known.any():
        raise InputError(
            "fitting the pseudo-stereo baseline: no pixel has both a depth and a positive disparity; "
            "check the depth source on the first frame"
        )
    depth, per_baseline = depth[known], focal_px / d[known]
    depth_unit = float(np.median(depth))
    baseline_unit = depth_unit / float(np.sqrt(np.mean(per_baseline**2)))
    target, slope = depth / depth_unit, per_baseline * (baseline_unit / depth_unit)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        residual = slope * x[0] - target
        return float(np.mean(residual**2)), np.array([2 * np.mean(residual * slope)])

    options = {"ftol": 1e-16, "gtol": 1e-12, "maxiter": 200}
    found = minimize(cost, np.ones(1), jac=True, method="L-BFGS-B", bounds=[(0.0, None)], options=options)
    return float(found.x[0]) * baseline_unit


def fit_affine_disparity(depth_mm: np.ndarray, disparity: np.ndarray, max_depth_mm: float) -> AffineDisparity:
    """Fit 1 / D = scale * d + shift robustly (Huber weights, scale by the median deviation, on inverse depth).

    depth_mm, disparity : arrays of one shape; pixels without a finite positive depth are left out.
    max_depth_mm : the farthest pixel of the fit is kept at or before this depth, so that 1 / D stays positive.

    Raises `InputError` if fewer than two pixels are left, or disparity is constant or falls towards the camera.
    """
    known = np.isfinite(depth_mm) & np.isfinite(disparity) & (np.asarray(depth_mm) > 0)
    d, inverse = np.asarray(disparity, np.float64)[known], 1 / np.asarray(depth_mm, np.float64)[known]
    if d.size < 2 or np.ptp(d) <= 1e-9 * np.abs(d).max():
        raise InputError(
            f"fitting disparity to metric depth: the disparity is constant or empty ({d.size} pixels); "
            "check the depth files, or start at a frame that shows structure"
        )
    origin, spread = float(d.mean()), float(d.std())
    design = np.stack([(d - origin) / spread, np.ones_like(d)], -1)
    slope, level = _robust_least_squares(design, inverse)
    farthest = (float(d.min()) - origin) / spread
    if slope > 0 and slope * farthest + level < 1 / max_depth_mm:
        # Through the farthest allowed point, the slope alone is left to fit.
        (slope,) = _robust_least_squares(design[:, :1] - farthest, inverse - 1 / max_depth_mm)
        level = 1 / max_depth_mm - slope * farthest
    if slope <= 0:
        raise InputError(
            "fitting disparity to metric depth: nearer tissue has the smaller disparity; if these values are depth "
            "rather than disparity set depth.files_kind=depth, else give the range by --near-far"
        )
    return AffineDisparity(float(slope / spread), float(level - slope * origin / spread))


def _robust_least_squares(design: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the Huber estimate x of `design` (N, k) x = `target` (N,) by iteratively reweighted least squares."""
    x: np.ndarray = np.linalg.lstsq(design, target, rcond=None)[0]
    for _ in range(_ITERATIONS):
        residual = np.abs(design @ x - target)
        sigma = robust_sigma(residual) + 1e-12 * float(np.abs(target).max())
        root = np.sqrt(huber_weight(residual, _HUBER_SIGMAS * sigma))
        before, x = x, np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0]
        if np.allclose(x, before, rtol=1e-10, atol=0):
            break
    return x
