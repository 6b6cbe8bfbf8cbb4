"""The metric anchor: every kind of estimate against every anchor, held over the sequence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.frame import Frame

CAMERA = PinholeCamera(60.0, 60.0, 29.5, 19.5, 60, 40)
TRUTH_MM = np.random.default_rng(0).uniform(13.5, 100.0, (40, 60)).astype(np.float32)
TRUTH_MM[5, 5], TRUTH_MM[6, 6] = 13.5, 100.0


def frame(index: int = 0) -> Frame:
    valid = np.ones((40, 60), bool)
    valid[0] = False
    return Frame(index, 0.0, np.full((40, 60, 3), 100, np.uint8), CAMERA, valid)


@dataclass
class Metric:
    """An estimator that knows the depth and counts how often it is asked."""

    name: str = "depth-pro"
    focal_px: float | None = 75.0
    asked: int = 0

    def estimate(self, frame: Frame) -> DepthEstimate:
        self.asked += 1
        return DepthEstimate(TRUTH_MM, "depth", self.focal_px)

    def provenance(self) -> dict[str, str]:
        return {}


def anchored(reference: Metric | None = None, **values: Any) -> AnchoredDepth:
    return AnchoredDepth(DepthSettings(**({"backend": "depth-anything"} | values)), reference or Metric())


def depth_of(anchor: AnchoredDepth, estimate: DepthEstimate, frame: Frame) -> np.ndarray:
    return anchor.metric(estimate, frame).depth_mm


def disparity(scale: float = 0.07, shift: float = 0.006) -> DepthEstimate:
    return DepthEstimate(((1 / TRUTH_MM - shift) / scale).astype(np.float32), "disparity")


def test_the_data_sets_own_convention_comes_back_from_near_and_far() -> None:
    """C3VD cecum: depth = 15.6 / (disparity / 255 + 0.156) is near 13.5 at 255 and far 100 at 0."""
    levels = np.linspace(0, 1, 40 * 60, dtype=np.float32).reshape(40, 60)
    levels[0], levels[1, 0] = 0.5, 0.0
    anchor = anchored(near_far_mm=(13.5, 100.0))
    found_mm = depth_of(anchor, DepthEstimate(levels, "disparity"), frame())
    np.testing.assert_allclose(found_mm, 15.6 / (levels + 0.156), rtol=5e-4)
    assert anchor.description == "near-far 13.5:100 mm"


@settings(max_examples=15, deadline=None)
@given(scale=st.floats(1e-4, 1), shift=st.floats(0, 0.009))
def test_disparity_of_any_scale_and_shift_becomes_the_depth_of_the_reference(scale: float, shift: float) -> None:
    anchor = anchored(anchor="depth-pro")
    np.testing.assert_allclose(depth_of(anchor, disparity(scale, shift), frame(7)), TRUTH_MM, rtol=2e-3)
    assert anchor.description.startswith("Depth Pro on frame 7")


def test_the_conversion_is_fitted_once_and_held() -> None:
    reference = Metric()
    anchor = anchored(reference, anchor="depth-pro")
    depth_of(anchor, disparity(), frame(0))
    assert anchor.just_fitted
    nearer = DepthEstimate(disparity().values + np.float32(0.1), "disparity")
    second_mm = depth_of(anchor, nearer, frame(1))
    assert not anchor.just_fitted
    assert reference.asked == 1
    np.testing.assert_allclose(1 / second_mm - 1 / TRUTH_MM, 0.007, rtol=1e-2)


def test_without_shift_it_is_the_papers_baseline_and_frame_1_keeps_the_metric_depth() -> None:
    anchor = anchored(anchor="depth-pro", fit="pseudo-stereo")
    estimate, first = disparity(), frame()
    np.testing.assert_array_equal(depth_of(anchor, estimate, first), TRUTH_MM)
    second_mm = depth_of(anchor, estimate, frame(1))
    used = first.valid & (estimate.values >= 0.1 * estimate.values[first.valid].max())
    per_baseline = 75.0 / estimate.values[used]
    baseline_mm = (TRUTH_MM[used] * per_baseline).sum() / (per_baseline**2).sum()
    known = np.isfinite(second_mm)
    assert known.mean() > 0.9
    np.testing.assert_allclose(second_mm[known], (75.0 * baseline_mm / estimate.values)[known], rtol=1e-4)


@pytest.mark.parametrize("factor", [0.02, 1.0, 40.0])
def test_predicted_depth_is_scaled_to_the_anchor(factor: float) -> None:
    floating = DepthEstimate((factor * TRUTH_MM).astype(np.float32), "depth")
    for values in ({"near_far_mm": (13.5, 100.0)}, {"anchor": "depth-pro"}):
        np.testing.assert_allclose(depth_of(anchored(**values), floating, frame()), TRUTH_MM, rtol=1e-5)


def test_measured_depth_is_never_touched() -> None:
    anchor = anchored(near_far_mm=(1.0, 2.0), anchor="near-far")
    np.testing.assert_array_equal(depth_of(anchor, DepthEstimate(TRUTH_MM, "measured"), frame()), TRUTH_MM)
    assert anchor.description == "measured depth"
    room_mm = 50 * TRUTH_MM
    np.testing.assert_array_equal(depth_of(anchor, DepthEstimate(room_mm, "measured"), frame()), room_mm)


def test_depth_beyond_the_limit_and_nonsense_are_unknown() -> None:
    values = TRUTH_MM.copy()
    values[3, 3], values[4, 4], values[8, 8] = np.nan, -2.0, 90.0
    depth_mm = depth_of(anchored(backend="depth-pro", max_depth_mm=80.0), DepthEstimate(values, "depth"), frame())
    assert depth_mm.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(depth_mm), ~((values > 0) & (values <= 80.0)))


def test_an_unusable_first_frame_leaves_the_anchor_to_the_next() -> None:
    anchor = anchored(anchor="depth-pro")
    blind = replace(frame(0), valid=np.zeros((40, 60), bool))
    assert np.isnan(depth_of(anchor, disparity(), blind)).all()
    assert anchor.conversion is None
    assert "not anchored" in anchor.description
    assert np.isfinite(depth_of(anchor, disparity(), frame(1))).all()
    assert anchor.description.startswith("Depth Pro on frame 1")


@pytest.mark.parametrize(("factor", "nearest_mm"), [(30.0, 1000 / 30), (100.0, 10.0), (1000.0, 1.0)])
def test_a_factor_divides_and_nothing_else_is_fitted(factor: float, nearest_mm: float) -> None:
    """The paper's ablation without Depth Pro: depth is inverse to disparity, or proportional to predicted depth."""
    seen = TRUTH_MM[1:]
    inverse = DepthEstimate((7.0 / TRUTH_MM).astype(np.float32), "disparity")
    for estimate in (inverse, DepthEstimate(0.2 * TRUTH_MM, "depth")):
        anchor = anchored(anchor="factor", factor=factor, backend="elsewhere", max_depth_mm=1e4)
        depth_mm = depth_of(anchor, estimate, frame())
        np.testing.assert_allclose(depth_mm, TRUTH_MM * (nearest_mm / seen.min()), rtol=1e-5)
        assert "arbitrary" in anchor.description
