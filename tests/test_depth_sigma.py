"""How the uncertainty of depth flows: from the estimate through anchor, blend and fusion, in closed form."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chosen_settings import chosen
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_phantom import only_images, write_tiny

from scopemap import Config, open_sequence, reconstruct
from scopemap.cameras.camera import PinholeCamera
from scopemap.config import DepthSettings, FusionSettings, MapisSettings
from scopemap.config.mapping import FusionAdvanced
from scopemap.depth.anchor import AnchoredDepth
from scopemap.depth.correspondence import DenseCorrespondence
from scopemap.depth.estimate import DepthEstimate
from scopemap.depth.mapis import Mapis, RefinedDepth
from scopemap.depth.shading import ShadingDepth
from scopemap.estimators import create_estimators
from scopemap.frame import Frame
from scopemap.fusion.surface_fusion import TsdfVolume
from scopemap.geometry.se3 import se3
from scopemap.geometry.uncertainty import blended_sigma, by_variance, depth_trust, faded_sigma, relative_sigma
from scopemap.odometry import Step
from scopemap.preprocessing import Estimators
from scopemap_bench.phantom.spec import PhantomSpec

SHAPE = (48, 64)
CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5, 64, 48)
RNG = np.random.default_rng(11)
DEPTH, OTHER = (RNG.uniform(30, 60, SHAPE).astype(np.float32) for _ in range(2))
SHARE, SHARE_OTHER = (RNG.uniform(0.02, 0.4, SHAPE).astype(np.float32) for _ in range(2))
DISTANCE = RNG.uniform(0, 1.4, SHAPE).astype(np.float32)
APPROACH = se3(np.eye(3), np.array([0.0, 0.0, -5.0]))
SPEC = PhantomSpec(scene="colon", frames=6, width=160, height=128, seed=4)


# ---- the mathematics


def test_a_share_is_sigma_over_depth_and_unknown_where_either_is() -> None:
    depth = np.array([[50.0, 50.0, np.nan, 50.0, -1.0, 50.0]], np.float32)
    sigma = np.array([[5.0, np.nan, 5.0, np.inf, 5.0, 0.0]], np.float32)
    np.testing.assert_allclose(relative_sigma(depth, sigma), [[0.1, np.nan, np.nan, 1e3, np.nan, 1e-4]], rtol=1e-6)
    assert relative_sigma(depth, sigma).dtype == np.float32
    assert np.isnan(relative_sigma(depth, None)).all()
    with pytest.raises(ValueError, match="sigma_mm"):
        relative_sigma(depth, sigma[:, :2])


def test_trust_is_the_inverse_variance_against_the_median_pixel() -> None:
    share = np.array([[0.05, 0.1, 0.3]], np.float32)
    depth = np.array([[20.0, 40.0, 70.0]], np.float32)
    expected = (0.1**2 + 0.1**2) / (0.1**2 + share**2)
    np.testing.assert_allclose(depth_trust(depth, share * depth, 0.1), expected, rtol=1e-5)


@given(st.floats(0.001, 0.9), st.floats(0.001, 1e6))
@settings(max_examples=30, deadline=None)
def test_sigma_in_proportion_to_depth_says_nothing(share: float, floor_share: float) -> None:
    np.testing.assert_allclose(depth_trust(DEPTH, np.float32(share) * DEPTH, floor_share), 1.0, rtol=1e-5)


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


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_equal_shares_leave_every_weight_to_the_last_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weight, share = rng.random(500, np.float32), rng.random(500, np.float32) + np.float32(1e-4)
    np.testing.assert_array_equal(by_variance(weight, share, share), weight)


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


def test_frames_and_estimates_refuse_a_sigma_of_another_size() -> None:
    rgb, valid = np.zeros((*SHAPE, 3), np.uint8), np.ones(SHAPE, bool)
    with pytest.raises(ValueError, match=r"Frame\.depth_sigma_mm"):
        Frame(0, 0.0, rgb, CAMERA, valid, DEPTH, depth_sigma_mm=DEPTH[1:])
    with pytest.raises(ValueError, match=r"DepthEstimate\.sigma"):
        DepthEstimate(DEPTH, "depth", sigma=DEPTH[1:])


def _anchored(estimate: DepthEstimate, **changes: Any) -> Any:
    values = chosen(DepthSettings, **({"backend": "depth-anything", "anchor": "factor", "factor": 25.0} | changes))
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
    replaced = _anchored(DepthEstimate(DEPTH, "depth", sigma=SHARE), anchor="shading", fit_shift=False)
    assert replaced.sigma_mm is None
    blind = _anchored(DepthEstimate(np.full(SHAPE, np.nan, np.float32), "depth", sigma=SHARE))
    assert blind.sigma_mm is None


# ---- MAPIS


def _link() -> DenseCorrespondence:
    return DenseCorrespondence(np.zeros((*SHAPE, 2), np.float32), np.ones(SHAPE, bool), DISTANCE)


def _refined(sigmas: tuple[Any, Any], motion: np.ndarray | None = None, **changes: Any) -> list[RefinedDepth]:
    mapis = Mapis(chosen(MapisSettings, **({"filter_sigma_px": 0.0, "frame_scale": "none"} | changes)))
    results = [mapis.refine(DEPTH, "depth", CAMERA, None, None, sigma_mm=sigmas[0])]
    for raw in (OTHER, DEPTH):
        sigma = sigmas[1] if raw is OTHER else sigmas[0]
        results.append(mapis.refine(raw, "depth", CAMERA, _link(), motion, sigma_mm=sigma))
    return results


def test_the_blend_is_weighed_by_inverse_variance() -> None:
    refined = _refined((SHARE * DEPTH, SHARE_OTHER * OTHER), blend="linear", sigma_fading=0.2)[1]
    trust = 1 - np.clip(DISTANCE, 0, 1)
    variance = SHARE**2 + 0.2 * np.maximum(SHARE_OTHER**2 - SHARE**2, 0)
    one, other = trust / variance, (1 - trust) / SHARE_OTHER**2
    np.testing.assert_allclose(refined.depth_mm, (one * DEPTH + other * OTHER) / (one + other), rtol=1e-5)
    weight = one / (one + other)
    share = weight * np.sqrt(variance) + (1 - weight) * SHARE_OTHER
    np.testing.assert_allclose(refined.sigma_mm, share * refined.depth_mm, rtol=1e-4)


@pytest.mark.parametrize("motion", [None, APPROACH])
@pytest.mark.parametrize("share", [0.01, 0.3])
def test_sigma_in_proportion_to_depth_blends_as_none(share: float, motion: np.ndarray | None) -> None:
    plain = _refined((None, None), motion)
    same = _refined((np.float32(share) * DEPTH, np.float32(share) * OTHER), motion)
    for one, other in zip(plain, same, strict=True):
        np.testing.assert_allclose(one.depth_mm, other.depth_mm, rtol=2e-6)
        assert np.isnan(one.sigma_mm).all()
        np.testing.assert_allclose(other.sigma_mm, share * other.depth_mm, rtol=1e-5)


def test_without_sigma_the_blend_is_the_perceptual_one_to_the_last_bit() -> None:
    weight = 1 - np.clip(DISTANCE, 0, 1)
    expected = np.where(weight > 0, weight * DEPTH + (1 - weight) * OTHER, OTHER)
    np.testing.assert_array_equal(_refined((None, None))[1].depth_mm, expected)


def test_a_pixel_that_knows_nothing_takes_what_was_seen_and_gives_nothing() -> None:
    glare = np.zeros(SHAPE, bool)
    glare[10:20, 10:30] = True
    sigma = 0.1 * OTHER
    blinded = np.where(glare, 1e9, sigma).astype(np.float32)
    trusted = glare & (DISTANCE < 0.99)
    taken = _refined((0.1 * DEPTH, blinded), sigma_fading=0.0)[1]
    np.testing.assert_allclose(taken.depth_mm[trusted], DEPTH[trusted], rtol=1e-4)
    given_up = _refined((np.where(glare, 1e9, 0.1 * DEPTH).astype(np.float32), sigma))[1]
    doubtful = glare & (DISTANCE > 0.01)
    np.testing.assert_allclose(given_up.depth_mm[doubtful], OTHER[doubtful], rtol=1e-4)


def test_sigma_may_be_said_of_one_frame_and_not_of_the_next() -> None:
    plain, mixed = _refined((None, None)), _refined((SHARE * DEPTH, None))
    np.testing.assert_array_equal(plain[1].depth_mm, mixed[1].depth_mm)
    np.testing.assert_allclose(mixed[1].sigma_mm, SHARE * mixed[1].depth_mm, rtol=1e-5)


def test_the_scale_of_a_frame_is_that_of_its_sigma() -> None:
    mapis = Mapis(chosen(MapisSettings, filter_sigma_px=0.0))
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
    volume = TsdfVolume(
        FusionSettings(voxel_mm=1.0, max_depth_mm=150.0, advanced=FusionAdvanced(min_weight=0.2, **changes))
    )
    for frame in frames:
        volume.integrate(frame)
    return volume._blocks.dense(np.array([-1, 0, 6]), 2)


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


def test_fusing_with_sigma_in_proportion_or_switched_off_is_fusing_without() -> None:
    plain = _field(_wall())
    wild = RNG.uniform(0.1, 30, (120, 160)).astype(np.float32)
    np.testing.assert_array_equal(_field(_wall(np.full((120, 160), 4.8, np.float32))).weight, plain.weight)
    np.testing.assert_allclose(_field(_wall(wild), depth_sigma_share=1e6).weight, plain.weight, rtol=1e-5)
    assert np.abs(_field(_wall(wild)).weight - plain.weight).max() > 0.1


def test_a_pixel_whose_sigma_is_huge_does_not_move_the_surface() -> None:
    near = np.full((120, 160), 48.0, np.float32)
    near[:, :60] = 46.0
    sigma_mm = np.where(near < 47, 1e9, 4.8).astype(np.float32)
    told, untold = (_field(_wall(), _wall(sigma, near)) for sigma in (sigma_mm, None))
    assert told.tsdf[0, 0, 0] == pytest.approx(0.0, abs=1e-3)
    assert abs(untold.tsdf[0, 0, 0]) > 0.5


# ---- the whole story


class _Telling:
    """Shading that says how certain it is: as a share of depth, by column."""

    name = "telling"

    def __init__(self, inner: Any, left: float) -> None:
        self.inner, self.left = inner, left

    def estimate(self, frame: Frame) -> DepthEstimate:
        estimate = self.inner.estimate(frame)
        share = np.full(estimate.values.shape, 0.1, np.float32)
        share[:, : share.shape[1] // 2] = self.left
        return replace(estimate, sigma=share * estimate.values)

    def provenance(self) -> dict[str, str]:
        return {"depth": self.name}


def test_sigma_flows_to_every_stage_of_a_run(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = only_images(write_tiny(tmp_path / "phantom"), tmp_path / "images")
    create, runs = create_estimators, {}
    # Shading tells no uncertainty of its own. Equal sigmas change no weight but that of the back end's depth prior.
    light = {"networks.flow": "dis", "networks.perceptual": "structure", "mapping.method": "none"}
    config = Config.load(settings={"depth.backend": "shading", **light})
    for name, left in {"none": None, "equal": 0.1, "doubted": 1.0}.items():

        def telling(config: Config, sequence: Any, own: Any, left: float | None = left) -> Estimators:
            parts = create(config, sequence)
            return parts if left is None else replace(parts, depth=_Telling(parts.depth, left))

        monkeypatch.setattr("scopemap.runner.preparation.create_estimators", telling)
        steps: list[Step] = []
        runs[name] = reconstruct(open_sequence(folder), config, observers=(steps.append,)), steps[-1]
    result, step = runs["doubted"]
    assert step.frame.depth_sigma_mm is not None
    half = step.frame.depth_mm.shape[1] // 2
    shares = step.frame.depth_sigma_mm / step.frame.depth_mm
    assert np.nanmedian(shares[:, : half - 20]) > 2 * np.nanmedian(shares[:, half + 20 :])
    plain, equal = runs["none"][0].trajectory.T_world_camera, runs["equal"][0].trajectory.T_world_camera
    np.testing.assert_allclose(equal, plain, atol=1e-4)
    assert len(result.mesh.vertices) != len(runs["none"][0].mesh.vertices)
