"""How the uncertainty of depth flows: from the estimate through anchor, blend and fusion, in closed form."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import DepthSettings, FusionSettings, MapisSettings
from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.mapis import DenseCorrespondence, Mapis, RefinedDepth
from scopemap.engine.depth.shading import ShadingDepth
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.fusion.tsdf import Voxels
from scopemap.engine.fusion.voxel_blocks import dense
from scopemap.engine.geometry.uncertainty import blended_sigma, by_variance, depth_trust, faded_sigma, relative_sigma

SHAPE = (48, 64)
CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48)
RNG = np.random.default_rng(11)
DEPTH, OTHER = (RNG.uniform(30, 60, SHAPE).astype(np.float32) for _ in range(2))
SHARE, SHARE_OTHER = (RNG.uniform(0.02, 0.4, SHAPE).astype(np.float32) for _ in range(2))
DISTANCE = RNG.uniform(0, 1.4, SHAPE).astype(np.float32)


# ---- the mathematics


def test_a_share_is_sigma_over_depth_and_unknown_where_either_is() -> None:
    depth = np.array([[50.0, 50.0, np.nan, 50.0, -1.0, 50.0]], np.float32)
    sigma = np.array([[5.0, np.nan, 5.0, np.inf, 5.0, 0.0]], np.float32)
    np.testing.assert_allclose(relative_sigma(depth, sigma), [[0.1, np.nan, np.nan, 1e3, np.nan, 1e-4]], rtol=1e-6)
    assert relative_sigma(depth, sigma).dtype == np.float32
    assert np.isnan(relative_sigma(depth, None)).all()
    with pytest.raises(ValueError, match="sigma_mm"):
        relative_sigma(depth, sigma[:, :2])


def test_trust_is_one_where_nothing_is_said_and_everywhere_with_a_large_floor() -> None:
    np.testing.assert_array_equal(depth_trust(DEPTH, None, 0.1), 1.0)
    np.testing.assert_array_equal(depth_trust(DEPTH, np.full(SHAPE, np.nan, np.float32), 0.1), 1.0)
    np.testing.assert_allclose(depth_trust(DEPTH, SHARE * DEPTH, 1e6), 1.0, rtol=1e-6)
    holed = np.where(DEPTH > 40, SHARE * DEPTH, np.nan)
    np.testing.assert_array_equal(depth_trust(DEPTH, holed, 0.1)[DEPTH <= 40], 1.0)
    assert np.ptp(depth_trust(DEPTH, holed, 0.1)[DEPTH > 40]) > 1


def test_odds_are_multiplied_by_the_ratio_of_inverse_variances() -> None:
    weight = np.float32([0.0, 0.2, 0.5, 0.5, 1.0, 0.3])
    share, other = np.float32([0.1, 0.1, 0.1, 0.3, 0.5, np.nan]), np.float32([0.2, 0.2, 0.1, 0.1, 0.1, 0.1])
    # odds: 0; 1/4 * 4; 1 * 1; 1 * 1/9; infinite; unchanged
    np.testing.assert_allclose(by_variance(weight, share, other), [0, 0.5, 0.5, 0.1, 1, 0.3], rtol=1e-5)
    one, two = 1 / share[1:5] ** 2, 1 / other[1:5] ** 2
    by_hand = weight[1:5] * one / (weight[1:5] * one + (1 - weight[1:5]) * two)
    np.testing.assert_allclose(by_variance(weight, share, other)[1:5], by_hand, rtol=1e-5)


def test_errors_of_one_kind_do_not_average_out() -> None:
    one, other = np.float32([0.1, 0.1, np.nan, np.nan]), np.float32([0.1, 0.3, 0.3, np.nan])
    np.testing.assert_allclose(blended_sigma(np.float32(0.25), one, other), [0.1, 0.25, 0.3, np.nan], rtol=1e-6)


def test_old_certainty_fades_towards_the_present_and_doubt_does_not() -> None:
    carried, current = np.float32([0.1, 0.1, 0.3, 0.1, np.nan]), np.float32([0.1, 0.3, 0.1, np.nan, 0.1])
    faded = faded_sigma(carried, current, 0.1)
    np.testing.assert_allclose(faded, [0.1, np.sqrt(0.01 + 0.1 * 0.08), 0.3, 0.1, np.nan], rtol=1e-6)
    np.testing.assert_array_equal(faded_sigma(carried, current, 0.0), carried)
    np.testing.assert_allclose(faded_sigma(carried, current, 1.0)[:3], [0.1, 0.3, 0.3], rtol=1e-6)


# ---- frames, estimates and the anchor


def _anchored(estimate: DepthEstimate, **changes: Any) -> Any:
    values = DepthSettings(**({"backend": "depth-anything", "anchor": "factor", "factor": 25.0} | changes))
    frame = Frame(0, 0.0, np.full((*SHAPE, 3), 90, np.uint8), CAMERA, np.ones(SHAPE, bool))
    return AnchoredDepth(values, ShadingDepth(values)).metric(estimate, frame)


def test_the_anchor_scales_sigma_as_it_scales_depth() -> None:
    metric = _anchored(DepthEstimate(DEPTH, "depth", sigma=SHARE * DEPTH))
    factor = 40.0 / DEPTH.min()
    np.testing.assert_allclose(metric.depth_mm, factor * DEPTH, rtol=1e-6)
    np.testing.assert_allclose(metric.sigma_mm, factor * SHARE * DEPTH, rtol=1e-6)
    measured = _anchored(DepthEstimate(DEPTH, "measured", sigma=SHARE))
    np.testing.assert_array_equal(measured.sigma_mm, SHARE)


def test_nothing_is_said_of_a_disparity_nor_of_the_anchors_own_depth() -> None:
    assert _anchored(DepthEstimate(DEPTH, "depth")).sigma_mm is None
    assert _anchored(DepthEstimate(1 / DEPTH, "disparity", sigma=SHARE)).sigma_mm is None
    replaced = _anchored(DepthEstimate(DEPTH, "depth", sigma=SHARE), anchor="shading", fit="pseudo-stereo")
    assert replaced.sigma_mm is None
    blind = _anchored(DepthEstimate(np.full(SHAPE, np.nan, np.float32), "depth", sigma=SHARE))
    assert blind.sigma_mm is None


# ---- MAPIS


def _link() -> DenseCorrespondence:
    return DenseCorrespondence(np.zeros((*SHAPE, 2), np.float32), np.ones(SHAPE, bool), DISTANCE)


def _refined(sigmas: tuple[Any, Any], motion: np.ndarray | None = None, **changes: Any) -> list[RefinedDepth]:
    mapis = Mapis(MapisSettings(**({"filter_sigma_px": 0.0, "frame_scale": "none"} | changes)))
    results = [mapis.refine(DEPTH, "depth", CAMERA, None, None, sigma_mm=sigmas[0])]
    for raw in (OTHER, DEPTH):
        sigma = sigmas[1] if raw is OTHER else sigmas[0]
        results.append(mapis.refine(raw, "depth", CAMERA, _link(), motion, sigma_mm=sigma))
    return results


def test_the_blend_is_weighed_by_inverse_variance() -> None:
    refined = _refined((SHARE * DEPTH, SHARE_OTHER * OTHER), blend="linear")[1]
    trust = 1 - np.clip(DISTANCE, 0, 1)
    variance = SHARE**2 + 0.3 * np.maximum(SHARE_OTHER**2 - SHARE**2, 0)
    one, other = trust / variance, (1 - trust) / SHARE_OTHER**2
    np.testing.assert_allclose(refined.depth_mm, (one * DEPTH + other * OTHER) / (one + other), rtol=1e-5)
    weight = one / (one + other)
    share = weight * np.sqrt(variance) + (1 - weight) * SHARE_OTHER
    np.testing.assert_allclose(refined.sigma_mm, share * refined.depth_mm, rtol=1e-4)


def test_without_sigma_the_blend_is_the_perceptual_one_to_the_last_bit() -> None:
    weight = 1 - np.clip(DISTANCE, 0, 1)
    expected = np.where(weight > 0, weight * DEPTH + (1 - weight) * OTHER, OTHER)
    np.testing.assert_array_equal(_refined((None, None))[1].depth_mm, expected)


def test_the_scale_of_a_frame_is_that_of_its_sigma() -> None:
    mapis = Mapis(MapisSettings(filter_sigma_px=0.0))
    mapis.refine(DEPTH, "depth", CAMERA, None, None, sigma_mm=SHARE * DEPTH)
    link = replace(_link(), distance=np.ones(SHAPE, np.float32))
    refined = mapis.refine(2 * DEPTH, "depth", CAMERA, link, None, sigma_mm=SHARE * 2 * DEPTH)
    assert refined.scale == pytest.approx(0.5, rel=1e-5)
    np.testing.assert_allclose(refined.sigma_mm, SHARE * DEPTH, rtol=1e-4)


# ---- fusion


def _wall(sigma_mm: np.ndarray | None = None, depth_mm: np.ndarray | None = None) -> Frame:
    flat = np.full((120, 160), 48.0, np.float32)
    camera = PinholeCamera(150.0, 150.0, 79.5, 59.5, 160, 120)
    rgb, valid = np.full((*flat.shape, 3), 90, np.uint8), np.ones(flat.shape, bool)
    return Frame(0, 0.0, rgb, camera, valid, flat if depth_mm is None else depth_mm, np.eye(4), "", sigma_mm)


def _field(*frames: Frame, **changes: Any) -> Any:
    volume = TsdfVolume(FusionSettings(voxel_mm=1.0, max_depth_mm=150.0, **changes))
    for frame in frames:
        volume.integrate(frame)
    slots = volume._blocks.box(np.array([-1, 0, 6]), np.full(3, 2))
    return Voxels(*(dense(array[slots]) for array in volume._blocks.voxels))


def test_a_fused_pixel_counts_by_its_trust_and_never_more_than_without() -> None:
    sigma_mm = np.full((120, 160), 4.8, np.float32)
    sigma_mm[:, :60], sigma_mm[:, 100:] = 14.4, 0.1
    plain, weighed = _field(_wall()), _field(_wall(sigma_mm))
    # Voxel (x, 0, 48) mm projects to column 79.5 + 150 x / 48: x = -8 into the doubted left, 0 and 7 elsewhere.
    floor, median, doubted = 0.2**2, 0.1**2, 0.3**2
    share = (floor + median) / (floor + doubted)
    assert weighed.weight[0, 0, 0] == pytest.approx(share * plain.weight[0, 0, 0], rel=1e-4)
    assert weighed.weight[8, 0, 0] == pytest.approx(plain.weight[8, 0, 0], rel=1e-6)
    assert weighed.weight[15, 0, 0] == pytest.approx(plain.weight[15, 0, 0], rel=1e-6)
