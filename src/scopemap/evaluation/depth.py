"""Depth maps against true depth: the field's standard errors, per image, and their mean over images.

Definitions: Eigen, Puhrsch and Fergus, "Depth map prediction from a single image", NeurIPS 2014, section 4.2; average
over images, not over pixels, as AF-SfMLearner and EndoDAC report it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np

from scopemap.errors import check_shape

DepthScaling = Literal["none", "median"]


@dataclass(frozen=True)
class DepthReport:
    """Errors of one depth map, or their mean over several; NaN where no pixel could be compared.

    Attributes
    ----------
    pixels : compared pixels; coverage : their share of the pixels with true depth, 0..1.
    scale : factor applied to the prediction first (1 without scaling).
    abs_rel, sq_rel_mm : mean of |d - g| / g and of (d - g)^2 / g.
    rmse_mm, rmse_log : root mean square of d - g and of ln d - ln g.
    mae_mm : mean |d - g|.
    delta_1, delta_2, delta_3 : share with max(d/g, g/d) strictly below 1.25, 1.25^2, 1.25^3.
    """

    pixels: float
    coverage: float
    scale: float
    abs_rel: float
    sq_rel_mm: float
    rmse_mm: float
    rmse_log: float
    mae_mm: float
    delta_1: float
    delta_2: float
    delta_3: float


def evaluate_depth(
    predicted_mm: np.ndarray,
    truth_mm: np.ndarray,
    *,
    scaling: DepthScaling = "none",
    truth_range_mm: tuple[float, float] = (1e-3, float("inf")),
) -> DepthReport:
    """Return the errors of a predicted depth map (H, W) against the true one (H, W), both mm, NaN = unknown.

    Compared are pixels with true depth strictly inside `truth_range_mm` and a positive prediction. `median` first
    multiplies the prediction by the ratio of the medians over these pixels, which hides a wrong scale: say so.
    """
    check_shape("predicted_mm", predicted_mm, np.shape(truth_mm))
    nearest, farthest = truth_range_mm
    known = np.isfinite(truth_mm) & (truth_mm > nearest) & (truth_mm < farthest)
    compared = known & np.isfinite(predicted_mm) & (predicted_mm > 0)
    pixels = int(np.count_nonzero(compared))
    coverage = pixels / max(int(np.count_nonzero(known)), 1)
    if pixels == 0:
        return DepthReport(0, coverage, *[float("nan")] * 9)
    d, g = predicted_mm[compared].astype(np.float64), truth_mm[compared].astype(np.float64)
    scale = float(np.median(g) / np.median(d)) if scaling == "median" else 1.0
    return DepthReport(pixels, coverage, scale, *_errors(scale * d, g))


def _errors(d: np.ndarray, g: np.ndarray) -> list[float]:
    difference = d - g
    ratio = np.maximum(d / g, g / d)
    errors = [
        np.mean(np.abs(difference) / g),
        np.mean(difference**2 / g),
        np.sqrt(np.mean(difference**2)),
        np.sqrt(np.mean(np.log(d / g) ** 2)),
        np.mean(np.abs(difference)),
        *(np.mean(ratio < 1.25**k) for k in (1, 2, 3)),
    ]
    return [float(error) for error in errors]


def mean_depth_report(reports: Sequence[DepthReport]) -> DepthReport:
    """Return the mean over images; those without a comparable pixel count in `pixels` and `coverage` only."""
    if not reports:
        return DepthReport(0, *[float("nan")] * 10)
    table = np.array([astuple(report) for report in reports], dtype=np.float64)
    compared = table[:, 0] > 0
    errors = table[compared, 2:].mean(axis=0) if compared.any() else np.full(table.shape[1] - 2, np.nan)
    return DepthReport(*(float(value) for value in (*table[:, :2].mean(axis=0), *errors)))
