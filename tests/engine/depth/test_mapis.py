"""MAPIS: the scale, each blend against its formula, moved and copied values, recursion, and what is unknown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config, MapisSettings
from scopemap.engine.depth.mapis import DenseCorrespondence, Mapis, RefinedDepth, robust_scale
from scopemap.engine.geometry.se3 import se3

SHAPE = (48, 64)
CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48)
RNG = np.random.default_rng(8)
DEPTH = RNG.uniform(30, 60, SHAPE).astype(np.float32)
OTHER = RNG.uniform(30, 60, SHAPE).astype(np.float32)
DISTANCE = RNG.uniform(0, 1.4, SHAPE).astype(np.float32)
APPROACH = se3(np.eye(3), np.array([0.0, 0.0, -5.0]))


def _mapis(**changes: Any) -> Mapis:
    """Plain settings: no filter, no scale, so that a formula can be seen through."""
    plain = {"filter_sigma_px": 0.0, "frame_scale": "none", "blend": "constant"}
    return Mapis(MapisSettings(**(plain | changes)))


def _link(distance: np.ndarray | float = 0.0, flow_x: float = 0.0) -> DenseCorrespondence:
    to_previous = np.zeros((*SHAPE, 2), np.float32)
    to_previous[..., 0] = flow_x
    return DenseCorrespondence(to_previous, np.ones(SHAPE, bool), np.broadcast_to(np.float32(distance), SHAPE).copy())


def _second(mapis: Mapis, link: DenseCorrespondence, T: np.ndarray | None = None, kind: Any = "depth") -> RefinedDepth:
    mapis.refine(DEPTH, kind, CAMERA, None, None)
    return mapis.refine(OTHER, kind, CAMERA, link, T)


def test_robust_scale_in_closed_form() -> None:
    raw = np.array([[1.0, 1.0, 2.0, 4.0, 0.0]])
    warped = np.array([[2.0, 3.0, 16.0, np.nan, 5.0]])
    assert robust_scale(raw, warped, 1.0) == pytest.approx(3.0)
    assert robust_scale(raw[:, :2], warped[:, :2], 1.0) == pytest.approx(np.sqrt(6))  # geometric, so 1/x gives 1/s
    assert robust_scale(warped[:, :2], raw[:, :2], 1.0) == pytest.approx(1 / np.sqrt(6))


def test_robust_scale_needs_an_overlap() -> None:
    few = np.full(SHAPE, np.nan, np.float32)
    assert robust_scale(DEPTH, few, 0.7) == 0.7
    few.ravel()[: int(0.19 * few.size)] = 99.0
    assert robust_scale(DEPTH, few, 0.7) == 0.7
    few.ravel()[: int(0.21 * few.size) + 1] = 99.0
    assert robust_scale(DEPTH, few, 0.7) != 0.7


@pytest.mark.parametrize(
    ("blend", "weight"),
    [
        ("exponential", np.exp(-DISTANCE / 0.15)),
        ("linear", 1 - np.clip(DISTANCE, 0, 1)),
        ("paper-equation", np.clip(DISTANCE, 0, 1)),
        ("constant", np.full(SHAPE, 0.5)),
        ("auto", 1 - np.clip(DISTANCE, 0, 1)),
        ("none", np.zeros(SHAPE)),
    ],
)
def test_each_blend_follows_its_formula(blend: str, weight: np.ndarray) -> None:
    refined = _second(_mapis(blend=blend), _link(DISTANCE))
    np.testing.assert_allclose(refined.depth_mm, weight * DEPTH + (1 - weight) * OTHER, rtol=1e-5)
    assert refined.depth_mm.dtype == np.float32
    assert refined.warped_share == 1.0


@pytest.mark.parametrize("motion", [None, APPROACH])
def test_measured_depth_is_left_alone(motion: np.ndarray | None) -> None:
    mapis = Mapis(Config().mapis)
    for depth in (DEPTH, OTHER):
        refined = mapis.refine(depth, "measured", CAMERA, _link(), motion)
        np.testing.assert_array_equal(refined.depth_mm, depth)
        assert refined.scale == 1.0


@pytest.mark.parametrize("kind", ["depth", "disparity"])
@pytest.mark.parametrize("factor", [0.2, 0.97, 1.0, 3.5])
def test_frame_scale_corrects_a_wrong_factor_exactly(kind: Any, factor: float) -> None:
    mapis = Mapis(MapisSettings(filter_sigma_px=0.0))
    mapis.refine(DEPTH, kind, CAMERA, None, None)
    refined = mapis.refine(DEPTH * np.float32(factor), kind, CAMERA, _link(DISTANCE), None)
    assert refined.scale == pytest.approx(1 / factor, rel=1e-5)
    np.testing.assert_allclose(refined.depth_mm, DEPTH, rtol=1e-5)


def test_a_chain_that_little_holds_does_not_run_away() -> None:
    """A motion that is wrong says at each frame that all went 2 mm away, in three tenths of the image."""
    mapis = _mapis(frame_scale="robust", blend="none")
    consistent = np.zeros(SHAPE, bool)
    consistent[:, : round(0.3 * SHAPE[1])] = True
    link = DenseCorrespondence(_link().to_previous, consistent, _link().distance)
    flat, away = np.full(SHAPE, 40.0, np.float32), se3(np.eye(3), np.array([0.0, 0.0, 2.0]))
    mapis.refine(flat, "depth", CAMERA, None, None)
    scales = [mapis.refine(flat, "depth", CAMERA, link, away).scale for _ in range(120)]
    assert 1.2 < scales[-1] < 2.0


@pytest.mark.parametrize("round_view", [False, True])
def test_a_chain_that_all_holds_is_left_alone(round_view: bool) -> None:
    """All that shows tissue: what lies outside a round field of view could not be linked anyway."""
    mapis, link = _mapis(frame_scale="robust", blend="none"), _link()
    if round_view:
        v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
        inside = np.hypot(u - 32, v - 24) < 24
        link = DenseCorrespondence(link.to_previous, inside, link.distance, float(inside.mean()))
    mapis.refine(DEPTH, "depth", CAMERA, None, None)
    scales = [mapis.refine(2 * DEPTH, "depth", CAMERA, link, None).scale for _ in range(100)]
    np.testing.assert_allclose(scales, 0.5, rtol=1e-4)


def test_scale_with_the_motion_keeps_an_approach_and_without_cancels_it() -> None:
    flat = np.full(SHAPE, 40.0, np.float32)
    for motion, depth_mm in ((APPROACH, 35.0), (None, 40.0)):
        mapis = Mapis(MapisSettings(filter_sigma_px=0.0))
        mapis.refine(flat, "depth", CAMERA, None, None)
        refined = mapis.refine(1.7 * (flat - 5), "depth", CAMERA, _link(), motion)
        np.testing.assert_allclose(refined.depth_mm, depth_mm, rtol=1e-5)
        assert refined.scale == pytest.approx(depth_mm / (1.7 * 35), rel=1e-5)


def test_values_are_pulled_along_the_flow() -> None:
    refined = _second(_mapis(blend="linear"), _link(flow_x=3.0))
    np.testing.assert_allclose(refined.depth_mm[:, :-3], DEPTH[:, 3:], rtol=1e-6)
    np.testing.assert_array_equal(refined.depth_mm[:, -3:], OTHER[:, -3:])
    assert refined.warped_share == pytest.approx(61 / 64)


@pytest.mark.parametrize("recursive", [True, False])
def test_what_is_carried_on(recursive: bool) -> None:
    mapis = _mapis(previous="refined" if recursive else "raw")
    second = _second(mapis, _link()).depth_mm
    np.testing.assert_allclose(second, (DEPTH + OTHER) / 2, rtol=1e-6)
    third = mapis.refine(OTHER, "depth", CAMERA, _link(), None).depth_mm
    np.testing.assert_allclose(third, ((second if recursive else OTHER) + OTHER) / 2, rtol=1e-6)


def test_forget_cuts_the_chain_and_holds_the_scale() -> None:
    mapis = Mapis(MapisSettings(filter_sigma_px=0.0))
    mapis.refine(DEPTH, "depth", CAMERA, None, None)
    mapis.refine(2 * DEPTH, "depth", CAMERA, _link(), None)
    mapis.reset()
    after = mapis.refine(3 * OTHER, "depth", CAMERA, _link(), None)
    assert after.warped_share == 0.0
    assert after.scale == pytest.approx(0.5, rel=1e-5)
    np.testing.assert_allclose(after.depth_mm, 1.5 * OTHER, rtol=1e-5)


def test_an_anchored_frame_starts_the_chain_anew() -> None:
    mapis = Mapis(MapisSettings(filter_sigma_px=0.0))
    mapis.refine(DEPTH, "depth", CAMERA, None, None)
    assert mapis.refine(2 * DEPTH, "depth", CAMERA, _link(), None).scale == pytest.approx(0.5, rel=1e-5)
    mapis.rescale(1.0)
    anchored = mapis.refine(3 * OTHER, "depth", CAMERA, _link(), None)
    np.testing.assert_array_equal(anchored.depth_mm, 3 * OTHER)
    after = mapis.refine(OTHER, "depth", CAMERA, _link(), None)
    assert after.scale == pytest.approx(3.0, rel=1e-5)


def test_without_a_warped_value_the_scaled_raw_depth_stands() -> None:
    mapis = Mapis(MapisSettings(filter_sigma_px=0.0))
    holed = DEPTH.copy()
    holed[:10] = np.nan
    mapis.refine(holed, "depth", CAMERA, None, None)
    consistent = np.ones(SHAPE, bool)
    consistent[:, :7] = False
    link = DenseCorrespondence(np.zeros((*SHAPE, 2), np.float32), consistent, np.zeros(SHAPE, np.float32))
    refined = mapis.refine(4 * OTHER, "depth", CAMERA, link, None)
    np.testing.assert_array_equal(refined.depth_mm[:10], (4 * OTHER * np.float32(refined.scale))[:10])
    np.testing.assert_array_equal(refined.depth_mm[:, :7], (4 * OTHER * np.float32(refined.scale))[:, :7])
    np.testing.assert_allclose(refined.depth_mm[10:, 7:], DEPTH[10:, 7:], rtol=1e-5)
    assert refined.warped_share == pytest.approx(38 * 57 / (48 * 64))
