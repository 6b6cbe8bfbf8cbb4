"""The exponent of predicted depth: its closed forms, its fit to flow without any pose, and the way through a run."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from chosen_settings import chosen
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_phantom import only_images, with_true_depth, write_tiny

from scopemap import open_sequence, reconstruct
from scopemap.cameras.camera import PinholeCamera
from scopemap.cli.options import parse_settings
from scopemap.cli.run import summary_lines
from scopemap.config import Config, DepthSettings
from scopemap.depth import power_law
from scopemap.depth.anchor import AnchoredDepth
from scopemap.depth.create import create_depth
from scopemap.depth.estimate import DepthEstimate
from scopemap.depth.power_law import (
    PairFit,
    apply_power_law,
    fit_exponent,
    modelled_flow,
    pair_exponent,
    ray_lengths,
    sequence_exponent,
)
from scopemap.depth.shading import ShadingDepth
from scopemap.errors import SettingsError
from scopemap.frame import Frame
from scopemap.geometry.se3 import se3, so3_exp, transform

CAMERA = PinholeCamera(110.0, 112.0, 78.0, 66.0, 160, 128)
SIZE = (CAMERA.height, CAMERA.width)
EVERYWHERE = np.ones(SIZE, bool)
ALONG = ray_lengths(CAMERA)


def tunnel_mm() -> np.ndarray:
    """Depth of a bent, folded tube: 14 to 90 mm."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    away = np.hypot(u - 95, v - 55) / 110
    folds = 1 + 0.08 * np.sin(u / 9) * np.cos(v / 11)
    return (14 + 76 * np.exp(-3 * away)) * folds


TRUE_MM = tunnel_mm()


def moved(at_mm: tuple[float, ...], turn_rad: tuple[float, ...] = (0.02, -0.03, 0.04)) -> np.ndarray:
    """Flow (H, W, 2) px of the tube seen by a camera that moved so."""
    points = transform(se3(so3_exp(np.array(turn_rad)), np.array(at_mm)), CAMERA.rays * TRUE_MM[..., None])
    return CAMERA.project(points) - CAMERA.project(CAMERA.rays)


def squeezed(exponent: float = 1.3, scale: float = 0.2) -> np.ndarray:
    """Predicted depth of which the true one is the power `exponent`, of another scale."""
    return scale * (TRUE_MM * ALONG) ** (1 / exponent) / ALONG


def fitted(depth_mm: np.ndarray, flow: np.ndarray, usable: np.ndarray = EVERYWHERE) -> PairFit:
    fit = pair_exponent(depth_mm, flow, usable, CAMERA)
    assert fit is not None
    return fit


# ---- stretching


def test_an_exponent_of_one_changes_nothing() -> None:
    np.testing.assert_allclose(apply_power_law(TRUE_MM, CAMERA, 1.0, 30.0), TRUE_MM, rtol=1e-6)


@settings(max_examples=20, deadline=None)
@given(exponent=st.floats(0.5, 2.0), pivot_mm=st.floats(10.0, 80.0))
def test_the_reciprocal_exponent_undoes_it(exponent: float, pivot_mm: float) -> None:
    there = apply_power_law(TRUE_MM, CAMERA, exponent, pivot_mm)
    np.testing.assert_allclose(apply_power_law(there, CAMERA, 1 / exponent, pivot_mm), TRUE_MM, rtol=1e-5)


def test_the_pivot_stays_and_ratios_of_distance_are_raised_to_the_power() -> None:
    depth_mm = (np.where(np.arange(SIZE[1]) < 80, 30.0, 60.0) / ALONG).astype(np.float32)
    distance = apply_power_law(depth_mm, CAMERA, 1.5, 30.0) * ALONG
    np.testing.assert_allclose(distance[:, :80], 30.0, rtol=1e-5)
    np.testing.assert_allclose(distance[:, 80:], 30.0 * 2**1.5, rtol=1e-5)


def test_what_is_unknown_or_not_positive_is_unknown() -> None:
    depth_mm = np.full(SIZE, 20.0, np.float32)
    depth_mm[0, :3] = (np.nan, 0.0, -5.0)
    assert np.flatnonzero(np.isnan(apply_power_law(depth_mm, CAMERA, 1.2, 20.0))).tolist() == [0, 1, 2]


# ---- one pair


@pytest.mark.parametrize("at_mm", [(1.5, -1.0, 0.3), (0.4, 0.2, -3.0), (-1.0, 0.5, 2.0)])
@pytest.mark.parametrize("exponent", [0.8, 1.0, 1.3])
def test_the_exponent_comes_back_from_exact_flow(at_mm: tuple[float, ...], exponent: float) -> None:
    fit = fitted(squeezed(exponent), moved(at_mm))
    assert fit.exponent == pytest.approx(exponent, abs=0.02)
    assert fit.deviation < 0.02
    assert fit.inlier_share == 1.0


def test_the_fit_gives_back_the_flow_and_the_motion() -> None:
    flow, depth_mm = moved((1.5, -1.0, 0.3)), squeezed(1.3, scale=0.2)
    depth_mm[3, 4] = np.nan
    fit = fitted(depth_mm, flow)
    again = modelled_flow(depth_mm, CAMERA, fit)
    assert np.isnan(again[3, 4]).all()
    np.testing.assert_allclose(again[10:, 10:], flow[10:, 10:], atol=0.02)
    np.testing.assert_allclose(fit.T_other_reference[:3, :3], so3_exp(np.array((0.02, -0.03, 0.04))), atol=1e-3)
    towards = fit.T_other_reference[:3, 3] / np.linalg.norm(fit.T_other_reference[:3, 3])
    np.testing.assert_allclose(towards, np.array((1.5, -1.0, 0.3)) / np.linalg.norm((1.5, -1.0, 0.3)), atol=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_the_exponent_comes_back_from_noise_and_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    flow = moved((1.2, -0.8, -1.5)) + rng.normal(0, 0.3, (*SIZE, 2))
    wild = rng.random(SIZE) < 0.1
    flow[wild] = rng.uniform(-20, 20, (int(wild.sum()), 2))
    fit = fitted(squeezed(), flow)
    assert fit.exponent == pytest.approx(1.3, abs=0.1)
    assert abs(fit.exponent - 1.3) < 4 * fit.deviation
    assert 0.8 < fit.inlier_share < 0.97


def test_the_deviation_is_what_fits_of_new_noise_differ_by() -> None:
    rng = np.random.default_rng(5)
    fits = [fitted(squeezed(), moved((1.2, -0.8, -1.5)) + rng.normal(0, 0.5, (*SIZE, 2))) for _ in range(10)]
    found = np.std([fit.exponent for fit in fits], ddof=1)
    assert 0.4 < found / np.mean([fit.deviation for fit in fits]) < 2.5


def test_errors_that_neighbours_share_make_the_deviation_larger() -> None:
    rng = np.random.default_rng(6)
    fine = rng.normal(0, 0.1, SIZE)
    smooth = cv2.GaussianBlur(rng.normal(0, 1, SIZE), (0, 0), 12)
    flow = moved((1.2, -0.8, -1.5))
    alone, shared = (fitted(squeezed() * np.exp(error), flow) for error in (fine, 0.1 * smooth / smooth.std()))
    assert shared.deviation > 2 * alone.deviation


def test_what_is_said_to_be_uncertain_counts_less() -> None:
    depth_mm, wrong = squeezed(), np.zeros(SIZE, bool)
    wrong[:, :60] = True
    depth_mm = np.where(wrong, depth_mm * 1.35, depth_mm)
    flow = moved((1.2, -0.8, -1.5))
    told = pair_exponent(depth_mm, flow, EVERYWHERE, CAMERA, np.where(wrong, 0.5, 0.02).astype(np.float32))
    untold = pair_exponent(depth_mm, flow, EVERYWHERE, CAMERA)
    assert told is not None
    assert untold is None or abs(told.exponent - 1.3) < abs(untold.exponent - 1.3)


def test_pixels_that_cannot_be_used_do_not_count() -> None:
    usable = EVERYWHERE.copy()
    usable[:, 100:] = False
    flow, depth_mm = moved((1.2, -0.8, -1.5)), squeezed()
    flow[~usable], depth_mm[:20] = np.nan, np.nan
    assert fitted(depth_mm, flow, usable).exponent == pytest.approx(1.3, abs=0.02)


def test_a_camera_that_only_turns_tells_nothing() -> None:
    assert pair_exponent(squeezed(), moved((0.0, 0.0, 0.0), (0.05, -0.1, 0.1)), EVERYWHERE, CAMERA) is None


def test_a_sphere_has_no_range_that_could_be_apply_power_law() -> None:
    flat = (30.0 + np.sin(np.arange(SIZE[1]) / 7)) / ALONG
    points = transform(se3(np.eye(3), np.array([1.5, 0.5, 0.3])), CAMERA.rays * flat[..., None])
    rng = np.random.default_rng(2)
    flow = CAMERA.project(points) - CAMERA.project(CAMERA.rays) + rng.normal(0, 0.2, (*SIZE, 2))
    assert pair_exponent(flat, flow, EVERYWHERE, CAMERA) is None


def test_flow_that_no_motion_explains_tells_nothing() -> None:
    rng = np.random.default_rng(1)
    random = np.stack([cv2.GaussianBlur(rng.normal(0, 1, SIZE), (0, 0), 8) for _ in range(2)], -1)
    assert pair_exponent(squeezed(), 6 * random / random.std(), EVERYWHERE, CAMERA) is None


def test_too_few_pixels_tell_nothing() -> None:
    usable = np.zeros(SIZE, bool)
    usable[:10, :10] = True
    assert pair_exponent(squeezed(), moved((1.2, -0.8, -1.5)), usable, CAMERA) is None


# ---- a sequence


def fits(*exponents: float, deviation: float = 0.05) -> list[PairFit]:
    return [PairFit(exponent, deviation, 5.0, 0.3, 0.95, 30.0, np.eye(4)) for exponent in exponents]


def test_pairs_that_agree_give_their_exponent_and_one_that_does_not_is_outvoted() -> None:
    assert sequence_exponent(fits(*[1.25] * 6)).exponent == pytest.approx(1.25)
    found = sequence_exponent(fits(1.22, 1.24, 1.25, 1.26, 1.28, 3.0))
    assert found.exponent == pytest.approx(1.25, abs=0.03)
    assert (found.pairs, found.reason) == (6, "")


def test_certain_pairs_count_more() -> None:
    found = sequence_exponent([*fits(1.2, 1.21, 1.19, deviation=0.02), *fits(1.5, 1.5, 1.5, deviation=0.4)])
    assert found.exponent == pytest.approx(1.2, abs=0.07)


def test_more_pairs_are_more_certain() -> None:
    few, many = (sequence_exponent(fits(*[1.15, 1.25, 1.2, 1.18] * n)) for n in (1, 9))
    assert many.deviation == pytest.approx(few.deviation / 3, rel=0.05)


@pytest.mark.parametrize(("found", "clipped"), [(3.0, 2.0), (0.3, 0.5)])
def test_the_exponent_is_clipped(found: float, clipped: float) -> None:
    assert sequence_exponent(fits(*[found] * 5)).exponent == clipped


def test_few_or_contradictory_pairs_leave_it_at_one_and_say_why() -> None:
    few = sequence_exponent(fits(1.3, 1.3))
    assert (few.exponent, few.pairs) == (1.0, 2)
    assert few.describe(80) == "depth exponent: left at 1, 2 pair(s) of frames could be fitted, 4 needed"
    torn = sequence_exponent(fits(0.6, 0.7, 1.0, 1.6, 1.9, 2.2))
    assert torn.exponent == 1.0
    assert "contradict" in torn.reason
    assert sequence_exponent([]).exponent == 1.0


# ---- in the anchor


def frame(valid: bool = True) -> Frame:
    return Frame(0, 0.0, np.full((*SIZE, 3), 100, np.uint8), CAMERA, np.full(SIZE, valid))


def anchored(**changes: object) -> AnchoredDepth:
    settings = chosen(DepthSettings, **{"backend": "scopenet", "exponent": 1.3} | changes)
    return AnchoredDepth(settings, ShadingDepth(settings))


def test_the_median_distance_of_the_first_usable_frame_is_held_as_pivot() -> None:
    first, later = squeezed().astype(np.float32), (2 * squeezed()).astype(np.float32)
    pivot = float(np.median(first * ALONG))
    anchor = anchored()
    assert np.isnan(anchor.depth_mm(DepthEstimate(later, "depth"), frame(valid=False))).all()
    for values in (first, later):
        depth_mm = anchor.depth_mm(DepthEstimate(values, "depth"), frame())
        np.testing.assert_allclose(depth_mm, apply_power_law(values, CAMERA, 1.3, pivot), rtol=1e-5)


def test_sigma_as_a_share_grows_with_the_exponent() -> None:
    values = squeezed().astype(np.float32)
    share = np.linspace(0.01, 0.3, values.size, dtype=np.float32).reshape(SIZE)
    metric = anchored().metric(DepthEstimate(values, "depth", sigma=share * values), frame())
    assert metric.sigma_mm is not None
    np.testing.assert_allclose(metric.sigma_mm / metric.depth_mm, 1.3 * share, rtol=1e-4)


def test_a_stated_range_still_fixes_the_scale_of_stretched_depth() -> None:
    metric = anchored(near_far_mm=(10.0, 90.0)).depth_mm(DepthEstimate(squeezed().astype(np.float32), "depth"), frame())
    ends = metric[np.isfinite(metric)]
    assert np.sqrt((ends.min() / 10.0) * (ends.max() / 90.0)) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("kind", ["disparity", "measured"])
def test_what_is_not_predicted_depth_is_not_apply_power_law(kind: str) -> None:
    values = squeezed().astype(np.float32)
    with pytest.raises(SettingsError, match=rf"depth.exponent=1.3 is for predicted depth; .* gives {kind}"):
        anchored().metric(DepthEstimate(values, kind), frame())  # type: ignore[arg-type]
    plain = anchored(exponent=1.0).metric(DepthEstimate(values, "measured"), frame())
    np.testing.assert_array_equal(plain.depth_mm, values)


def test_an_exponent_that_is_still_to_be_fitted_is_refused() -> None:
    with pytest.raises(SettingsError, match="is resolved by a run before it starts"):
        anchored(exponent="fit").metric(DepthEstimate(squeezed(), "depth"), frame())


# ---- the setting


@pytest.mark.parametrize(("text", "value"), [("fit", "fit"), ("1.2", 1.2), ("1", 1.0)])
def test_the_setting_is_read_from_text_and_goes_through_a_file(text: str, value: float | str, tmp_path: Path) -> None:
    config = Config.load(settings=parse_settings([f"depth.exponent={text}"]))
    assert config.depth.exponent == value == Config.load(settings={"depth.exponent": text}).depth.exponent
    (tmp_path / "c.toml").write_text(config.toml())
    assert Config.load(file=tmp_path / "c.toml") == config


@pytest.mark.parametrize("value", ["auto", 0, -1, 9, float("nan")])
def test_an_impossible_exponent_is_refused(value: object) -> None:
    with pytest.raises(SettingsError, match=r"depth\.exponent"):
        Config.load(settings={"depth.exponent": value})


def test_the_fit_takes_the_place_of_the_word_and_of_nothing_else() -> None:
    given = {"tracking.advanced.huber": 2.0, "depth.advanced.shading_exponent": 0.5}
    config = Config.load(settings={"depth.exponent": "fit", **given})
    found = sequence_exponent(fits(*[1.25] * 6)).applied(config)
    assert found == Config.load(settings={"depth.exponent": 1.25, **given})


# ---- a run


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("exponent") / "phantom")


def squeezed_files(phantom: Path, folder: Path, exponent: float) -> Path:
    """True depth of the phantom, its range squeezed, as files of predicted depth."""
    sequence = open_sequence(phantom)
    along, folder = ray_lengths(sequence.camera), only_images(phantom, folder)
    for view, truth in sequence:
        assert truth is not None
        assert truth.depth_mm is not None
        depth_mm = 20 * (truth.depth_mm * along / 20) ** (1 / exponent) / along
        units = np.nan_to_num(depth_mm * 100).astype(np.uint16)
        cv2.imwrite(str(folder / f"{view.name.replace('_color.png', '_depth.png')}"), units)
    return folder


def test_a_run_fits_the_exponent_and_says_so(phantom: Path, tmp_path: Path) -> None:
    depth = squeezed_files(phantom, tmp_path / "depth", 1.4)
    kind = {"depth__files_kind": "depth", "depth__files_scale_mm": 0.01, "networks__flow": "dis"}
    config = with_true_depth(depth, depth__exponent="fit", **kind)
    result = reconstruct(open_sequence(phantom), config, out=tmp_path / "out")
    assert isinstance(result.config.depth.exponent, float)
    assert result.config.depth.exponent == pytest.approx(1.4, abs=0.15)
    note = next(note for note in result.provenance["notes"] if note.startswith("depth exponent"))
    assert f"{result.config.depth.exponent:.2f} +- " in note
    assert f"note: {note}" in summary_lines(result)
    assert result.provenance["seconds"]["depth exponent"] > 0
    # The file of the run repeats it to the last bit, without fitting again.
    again = reconstruct(open_sequence(phantom), Config.load(file=tmp_path / "out" / "config.toml"))
    np.testing.assert_array_equal(again.trajectory.T_world_camera, result.trajectory.T_world_camera)
    assert not any(note.startswith("depth exponent") for note in again.provenance["notes"])


def test_measured_depth_is_left_as_it_is(phantom: Path) -> None:
    config = with_true_depth(phantom, depth__exponent="fit", fusion__enabled=False)
    result = reconstruct(open_sequence(phantom), config)
    assert result.config.depth.exponent == 1.0
    assert "depth exponent: left at 1, measured needs no power law" in result.provenance["notes"]


def test_a_number_is_refused_where_depth_is_measured(phantom: Path) -> None:
    config = with_true_depth(phantom, depth__exponent=1.2, fusion__enabled=False)
    with pytest.raises(SettingsError, match=r"depth.exponent=1.2 is for predicted depth; .* gives measured"):
        reconstruct(open_sequence(phantom), config)


def test_the_bias_of_smooth_flow_is_taken_out(phantom: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without warping the partner by the model, flow that smooths parallax makes the exponent too small."""
    sequence = open_sequence(phantom)
    depth = squeezed_files(phantom, tmp_path / "depth", 1.2)
    config = with_true_depth(depth, depth__files_kind="depth", depth__files_scale_mm=0.01)
    estimator = create_depth(config.depth, sequence.rectifier, "cpu")
    realigned = fit_exponent(sequence, config, estimator).exponent
    monkeypatch.setattr(power_law, "_REALIGNMENTS", 0)
    plain = fit_exponent(sequence, config, estimator).exponent
    assert abs(realigned - 1.2) < 0.12
    assert abs(realigned - 1.2) < 0.5 * abs(plain - 1.2)


def test_too_few_frames_leave_it_as_it_is(phantom: Path) -> None:
    given = {"depth.backend": "shading", "depth.exponent": "fit", "fusion.enabled": False}
    still = open_sequence(phantom, frames=slice(0, 4))
    result = reconstruct(still, Config.load("realtime", settings=given))
    assert result.config.depth.exponent == 1.0
    assert "depth exponent: left at 1, 2 pair(s) of frames" in " ".join(result.provenance["notes"])


@pytest.mark.real
def test_real_frames_ask_for_little_where_depth_is_about_right(real_data: Path) -> None:
    """Shading's range is right on trans_t1_a: the power that fits its true depth best is 1.00."""
    sequence = open_sequence(real_data / "endoscopy" / "c3vd" / "trans_t1_a")
    found = fit_exponent(sequence, Config(), ShadingDepth(DepthSettings()))
    assert found.pairs >= 6
    assert found.exponent == pytest.approx(1.0, abs=0.1)
