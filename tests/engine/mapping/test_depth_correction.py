"""Depth correction field: closed forms are recovered, outliers do little harm, unknown depth stays unknown."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.config import MappingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import se3
from scopemap.engine.mapping import MAX_LOG_FACTOR, FrameCorrection
from scopemap.engine.mapping.correction import FinalFrames, KeyframeCorrection, KeyframeStep, TrackedPose
from scopemap.engine.mapping.depth_correction import COLUMNS, LEVELS, ROWS, DepthCorrectionField, fit_depth_correction
from tests.support import plane_scene

HEIGHT, WIDTH = 120, 160


def _points(rng: np.random.Generator, count: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 2) and ln depths (n,) of random points between 20 and 80 mm."""
    return rng.random((count, 2)), np.log(rng.uniform(20, 80, count))


def _image(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(20, 80, (HEIGHT, WIDTH)).astype(np.float32)


def _bend(x: np.ndarray, y: np.ndarray, log_depth: np.ndarray) -> np.ndarray:
    """An error that is linear in position and ln depth, which a trilinear grid represents exactly."""
    return 0.3 * (x - 0.5) - 0.2 * (y - 0.5) + 0.1 * (log_depth - np.log(40))


def test_an_error_linear_in_position_and_ln_depth_is_recovered() -> None:
    rng = np.random.default_rng(0)
    places, log_depth = _points(rng, 3000)
    error = _bend(*places.T, log_depth)
    field = fit_depth_correction(places, log_depth, error, np.full(len(error), 0.005), step_sigma=0.3)
    depth_mm = _image(rng)
    y, x = (np.mgrid[:HEIGHT, :WIDTH] + 0.5) / np.reshape([HEIGHT, WIDTH], (2, 1, 1))
    off = field.log_factor(depth_mm) - _bend(x, y, np.log(depth_mm))
    assert np.abs(off).mean() < 0.005
    assert np.abs(off).max() < 0.05


def test_a_quarter_of_outliers_does_little_harm() -> None:
    rng = np.random.default_rng(2)
    places, log_depth = _points(rng)
    error = _bend(*places.T, log_depth)
    noisy = np.where(rng.random(len(error)) < 0.25, error + rng.normal(0, 1.0, len(error)), error)
    fields = [fit_depth_correction(places, log_depth, e, np.full(len(e), 0.02), 0.1) for e in (error, noisy)]
    depth_mm = _image(rng)
    clean, spoilt = (field.log_factor(depth_mm) for field in fields)
    assert np.abs(clean - spoilt).mean() < 0.015


@pytest.mark.parametrize(("count", "sigma"), [(600, np.inf), (600, 1e3), (9, 0.01)])
def test_uncertain_or_few_points_change_nothing(count: int, sigma: float) -> None:
    rng = np.random.default_rng(3)
    places, log_depth = _points(rng, count)
    field = fit_depth_correction(places, log_depth, rng.normal(0, 1, count), np.full(count, sigma), 0.1)
    assert np.abs(field.log_factor(_image(rng))).max() < 1e-3


# The first example compiles a kernel.
@settings(deadline=None)
@given(st.floats(-3, 3), st.floats(0.01, 1.0), st.integers(0, 2**32 - 1))
def test_factors_are_bounded_and_unknown_depth_stays_unknown(error: float, step: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    places, log_depth = _points(rng, 60)
    field = fit_depth_correction(places, log_depth, np.full(60, error), np.full(60, 0.01), step)
    depth_mm = np.exp(rng.uniform(-3, 9, (20, 30))).astype(np.float32)
    depth_mm[rng.random(depth_mm.shape) < 0.3] = np.nan
    found = field.log_factor(depth_mm)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(found), np.isnan(depth_mm))
    assert np.nanmax(np.abs(found), initial=0) <= MAX_LOG_FACTOR + 1e-5


def test_a_frame_between_two_keyframes_interpolates_both_fields() -> None:
    fields = tuple(DepthCorrectionField(np.full((ROWS, COLUMNS, LEVELS), value), 3.0, 4.0) for value in (0.1, 0.3))
    correction = FrameCorrection(
        np.array([10, 20]), np.stack([np.eye(4)] * 2), np.array([0.0, 0.2]), 0.2, depth_fields=fields
    )
    depth_mm = np.array([[30.0, np.nan]], np.float32)
    for index, log in ((0, 0.1), (10, 0.1), (15, 0.2 + 0.1), (20, 0.3 + 0.2), (99, 0.3 + 0.2)):
        np.testing.assert_allclose(correction.depth_factors(index, depth_mm), np.exp([[log, np.nan]]), rtol=1e-5)
    camera, rgb, valid = plane_scene.CAMERA.resized(2, 1), np.zeros((1, 2, 3), np.uint8), np.ones((1, 2), bool)
    frame = Frame(15, 0.0, rgb, camera, valid, depth_mm, np.eye(4), depth_sigma_mm=0.1 * depth_mm)
    (done,) = FinalFrames(correction, {15: np.eye(4)}, lambda _: frame).frames(None)
    np.testing.assert_allclose(done.depth_sigma_mm / done.depth_mm, [[0.1, np.nan]], rtol=1e-5)
    assert correction.notice.values["depth_change"] == pytest.approx(0.2214, abs=1e-4)


def test_what_a_field_has_multiplied_depth_by_is_found_again() -> None:
    rng = np.random.default_rng(7)
    field = DepthCorrectionField(rng.normal(0, 0.1, (ROWS, COLUMNS, LEVELS)), np.log(25), np.log(70))
    depth_mm = _image(rng)  # nearer and farther than the levels, too
    depth_mm[0] = np.nan
    log = field.log_factor(depth_mm)
    found = field.log_factor_before(depth_mm * np.exp(log))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, log, atol=1e-4)
    # Where a field folds depth over, another depth gives the same corrected one.
    folded = DepthCorrectionField(rng.normal(0, 0.6, (ROWS, COLUMNS, LEVELS)), np.log(25), np.log(70))
    corrected_mm = depth_mm * np.exp(folded.log_factor(depth_mm))
    before = corrected_mm * np.exp(-folded.log_factor_before(corrected_mm))
    np.testing.assert_allclose(before * np.exp(folded.log_factor(before)), corrected_mm, rtol=1e-3)


def _bent(number: int) -> Frame:
    """View of the plane whose depth is wrong by up to 30 %, varying from left to right, as a network's is."""
    at_mm, turn_rad = (2.0 * number, 0.6 * number, 0.5 * number), (0.01 * number, -0.01 * number, 0.02 * number)
    frame = plane_scene.frame(plane_scene.pose(at_mm=at_mm, turn_rad=turn_rad), number)
    bend = np.exp(0.3 * np.sin(np.linspace(-2, 2, plane_scene.CAMERA.width))).astype(np.float32)
    return replace(frame, depth_mm=frame.depth_mm * bend)


def _shape_error(frame: Frame, factors: np.ndarray) -> float:
    """Mean error of ln depth after alignment of its scale."""
    off = np.log(frame.depth_mm * factors / plane_scene.see(frame.T_world_camera).depth_mm)
    return float(np.abs(off - np.median(off)).mean())


@pytest.mark.slow
def test_distorted_depth_of_a_plane_seen_from_six_poses_is_corrected() -> None:
    frames = [_bent(number) for number in range(6)]
    results = {}
    for step_sigma in (0.0, 0.1):
        settings = MappingSettings(depth_step_sigma=step_sigma)
        correction = plane_scene.adjusted(frames, settings)
        assert not correction.refused
        results[step_sigma] = [_shape_error(f, correction.depth_factors(f.index, f.depth_mm)) for f in frames]
    assert min(results[0.0]) > 0.1
    assert max(results[0.1]) < 0.3 * min(results[0.0])


def _field(rng: np.random.Generator) -> DepthCorrectionField:
    """A field of some percent over 20 to 80 mm."""
    return DepthCorrectionField(rng.normal(0, 0.05, (ROWS, COLUMNS, LEVELS)), np.log(20), np.log(80))


@pytest.mark.parametrize("is_adjusted", [True, False])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_depth_does_not_step_where_the_keyframe_changes(is_adjusted: bool, scale: float) -> None:
    """Frames are stored with the correction of the keyframe that they were tracked against; the next one has its own.

    The camera moves evenly over a wall, so that depth as estimated stays the same.
    """
    rng, keyframes, every = np.random.default_rng(4), 4, 10
    own = [KeyframeCorrection(rng.normal(0, 0.05), _field(rng)) for _ in range(keyframes)]
    tracked = {n: TrackedPose(0, max(n - 1, 0) // every * every, se3(np.eye(3), [n, 0, 0])) for n in range(31)}
    number = np.arange(keyframes) * every
    steps = [KeyframeStep(), *(KeyframeStep(before=a, after=b) for a, b in itertools.pairwise(own))]
    worlds = {0: Similarity(scale, np.eye(3), np.zeros(3))}
    T, log_scale = np.tile(np.eye(4), (keyframes, 1, 1)), rng.normal(0, 0.05, keyframes) * is_adjusted
    fields = tuple(_field(rng) for _ in number) if is_adjusted else ()
    correction = FrameCorrection(number, T, log_scale, depth_fields=fields, S_common_map=worlds, tracked=tracked)
    correction = correction.with_steps([tracked[n] for n in number.tolist()], steps, worlds)
    frame, final_mm = plane_scene.frame(np.eye(4)), []
    frame = replace(frame, depth_mm=rng.uniform(20, 80, frame.valid.shape).astype(np.float32))
    for index in tracked:
        stored_mm = np.asarray(own[index // every].corrected(frame).depth_mm)
        final_mm.append(stored_mm * correction.depth_factors(index, stored_mm))
    log_depth = np.log(np.stack(final_mm))
    change = np.abs(np.diff(log_depth[::every], axis=0)).mean(axis=(1, 2))
    step = np.abs(np.diff(log_depth, axis=0)).mean(axis=(1, 2))
    assert change.min() > 0.02
    np.testing.assert_allclose(step.reshape(-1, every), np.repeat(change[:, None], every, 1) / every, rtol=0.1)
