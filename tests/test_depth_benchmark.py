"""The benchmark of depth without any download: closed forms of its measures, its tables, its scenes on real frames."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.cameras.camera import PinholeCamera
from scopemap.frame import Frame
from scopemap_bench.scripts import depth_measures as measures
from scopemap_bench.scripts import depth_scenes as scenes
from scopemap_bench.scripts import depth_without_download as bench
from scopemap_bench.scripts.depth_pictures import draw_scene, draw_sparsification

CAMERA = PinholeCamera(50.0, 50.0, 31.5, 23.5, 64, 48)
ALONG = np.linalg.norm(CAMERA.rays, axis=-1)
RNG = np.random.default_rng(0)


def textured(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(40, 200, (12, 16, 3), dtype=np.uint8)
    return cv2.resize(noise, (64, 48), interpolation=cv2.INTER_CUBIC)


def frame(index: int = 0, rgb: np.ndarray | None = None) -> Frame:
    return Frame(index, 0.0, textured() if rgb is None else rgb, CAMERA, np.ones((48, 64), bool))


def depths(count: int) -> list[np.ndarray]:
    return [RNG.uniform(10, 80, (48, 64)).astype(np.float32) for _ in range(count)]


def scored(truths_mm: list[np.ndarray], made: list[np.ndarray]) -> measures.SequenceScore:
    frames = [frame(k) for k in range(len(truths_mm))]
    return measures.score_sequence(frames, truths_mm, [measures.Prediction(depth_mm) for depth_mm in made])


# ---- sparsification


def test_uncertainty_equal_to_the_error_is_the_oracle_whose_curve_is_known() -> None:
    error = RNG.permutation(np.arange(1, 1001) / 1000)
    curve = measures.sparsification(error, error)
    np.testing.assert_allclose(curve, (1000 * (1 - measures.REMOVED) + 1) / 2000, rtol=1e-9)
    assert measures.area_between(curve, curve) == (0.0, 0.0)


def test_uncertainty_that_is_upside_down_costs_twice_as_much_as_knowing_nothing() -> None:
    """Errors evenly spread over 0..1: keeping the worst leaves (1 + r) / 2, the best (1 - r) / 2, any 1 / 2."""
    error = np.arange(1, 10001) / 10000
    curve, oracle = measures.sparsification(error, -error), measures.sparsification(error, error)
    area, share = measures.area_between(curve, oracle)
    assert area == pytest.approx(0.95**2, rel=1e-3)
    assert share == pytest.approx(2.0, rel=1e-3)


def test_the_same_uncertainty_everywhere_knows_nothing_however_the_errors_lie_in_the_image() -> None:
    error = np.linspace(0, 1, 20000)
    curve, oracle = (measures.sparsification(error, values) for values in (np.ones_like(error), error))
    np.testing.assert_allclose(curve, 0.5, atol=0.03)
    assert measures.area_between(curve, oracle)[1] == pytest.approx(1.0, abs=0.05)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 200))
def test_no_order_beats_the_oracle_and_all_start_at_the_mean(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    error, uncertainty = rng.exponential(size=count), rng.integers(0, 5, count).astype(float)
    curve, oracle = (measures.sparsification(error, values) for values in (uncertainty, error))
    assert curve[0] == pytest.approx(error.mean())
    assert (curve >= oracle - 1e-12).all()


# ---- uncertainty of a frame


def laplace_frame(b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Truth, and a prediction whose log error is Laplace distributed with scale b (H, W)."""
    truth_mm = np.random.default_rng(1).uniform(10, 80, b.shape)
    return truth_mm, truth_mm * np.exp(np.random.default_rng(2).laplace(scale=b))


def test_sigma_as_large_as_laplace_errors_covers_what_it_should() -> None:
    b = np.full((300, 400), 0.08)
    truth_mm, depth_mm = laplace_frame(b)
    rgb = np.zeros((300, 400, 3), np.uint8)
    for claimed, error_over_b in ((1.0, 1.0), (0.5, 2.0)):
        prediction = measures.Prediction(depth_mm, claimed * np.sqrt(2) * b * depth_mm)
        score, _ = measures.score_frame(rgb, truth_mm, prediction)
        expected = [1 - np.exp(-np.sqrt(2) * claimed * sigmas) for sigmas in (1, 2)]
        assert [score.within_1_sigma, score.within_2_sigma] == pytest.approx(expected, abs=0.01)
        assert score.error_over_b == pytest.approx(error_over_b, rel=0.02)
    assert pytest.approx((0.757, 0.941), abs=1e-3) == measures.LAPLACE_WITHIN


def test_rank_and_sparsification_see_sigma_that_follows_the_errors_and_no_other() -> None:
    b = np.exp(np.random.default_rng(3).uniform(np.log(0.01), np.log(0.3), (300, 400)))
    truth_mm, depth_mm = laplace_frame(b)
    rgb = np.zeros((300, 400, 3), np.uint8)
    right, curves = measures.score_frame(rgb, truth_mm, measures.Prediction(depth_mm, np.sqrt(2) * b * depth_mm))
    shuffled = np.random.default_rng(4).permutation(b.ravel()).reshape(b.shape)
    wrong, _ = measures.score_frame(rgb, truth_mm, measures.Prediction(depth_mm, shuffled * depth_mm))
    assert right.rank > 0.5
    assert right.ause_share < 0.5
    assert wrong.rank == pytest.approx(0, abs=0.02)
    assert wrong.ause_share == pytest.approx(1, abs=0.05)
    assert curves[0, 0] == pytest.approx(right.abs_rel, rel=1e-5)


def test_rank_is_one_where_sigma_orders_the_errors() -> None:
    # As many pixels too near as too far, the middle one exact: the median scale is 1.
    error = np.linspace(-0.4, 0.4, 801).reshape(1, -1)
    truth_mm = np.full(error.shape, 50.0)
    depth_mm = truth_mm * (1 + error)
    prediction = measures.Prediction(depth_mm, (0.01 + error**2) * depth_mm)
    score, _ = measures.score_frame(np.zeros((1, 801, 3), np.uint8), truth_mm, prediction)
    assert score.scale == pytest.approx(1.0)
    assert score.rank == pytest.approx(1.0, abs=1e-4)
    assert score.ause == pytest.approx(0.0, abs=1e-3)


def test_without_sigma_nothing_is_said_of_it() -> None:
    score = scored(depths(2), depths(2))
    assert np.isnan([score.mean.rank, score.mean.ause, score.mean.within_1_sigma, score.mean.error_over_b]).all()
    assert score.sparsification == ()
    assert score.oracle == ()


def test_errors_in_saturated_pixels_are_told_apart() -> None:
    truth_mm = np.full((48, 64), 40.0, np.float32)
    rgb, depth_mm = np.full((48, 64, 3), 100, np.uint8), truth_mm.copy()
    rgb[:, :16, 0], depth_mm[:, :16] = 250, 60.0
    score, _ = measures.score_frame(rgb, truth_mm, measures.Prediction(depth_mm))
    assert score.saturated_share == pytest.approx(0.25)
    assert score.saturated_abs_rel == pytest.approx(0.5)
    assert score.unsaturated_abs_rel == 0
    assert score.abs_rel == pytest.approx(0.125)


def test_errors_beside_a_step_of_the_truth_are_told_apart() -> None:
    truth_mm = np.full((48, 64), 40.0, np.float32)
    truth_mm[:, 40:], truth_mm[0] = 44.1, np.nan
    depth_mm = truth_mm.copy()
    depth_mm[:, 39:41] *= 1.2
    score, _ = measures.score_frame(textured(), truth_mm, measures.Prediction(depth_mm))
    assert score.edge_share == pytest.approx(2 / 64)
    assert score.edge_abs_rel == pytest.approx(0.2, rel=1e-4)
    assert score.smooth_abs_rel == 0
    assert not measures.beside_steps(np.array([[40.0, 43.9, np.nan, 90.0]])).any()


# ---- scale, exponent


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.2, 5), exponent=st.floats(0.4, 2.5), seed=st.integers(0, 2**32 - 1))
def test_scale_and_exponent_come_back_in_spite_of_outliers(scale: float, exponent: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    predicted = np.exp(rng.uniform(2, 5, 400))
    true = scale * predicted**exponent
    true[:80] *= rng.uniform(0.2, 5, 80)
    assert measures.power_fit(predicted, true) == pytest.approx((scale, exponent), rel=1e-3)
    kept = measures.power_fit(predicted, scale * predicted**exponent, exponent=exponent)
    assert kept == pytest.approx((scale, exponent))


def test_one_exponent_mends_distances_that_are_a_power_of_the_truth() -> None:
    truths_mm = depths(3)
    made = [(truth_mm * ALONG / 2) ** (1 / 1.3) / ALONG for truth_mm in truths_mm]
    score = scored(truths_mm, made)
    fit = score.scale_and_exponent
    assert (fit.scale, fit.exponent) == pytest.approx((2.0, 1.3), rel=1e-3)
    assert fit.abs_rel == pytest.approx(0.0, abs=1e-4)
    assert fit.delta == 1
    assert score.exponent_and_medians.abs_rel == pytest.approx(0.0, abs=1e-4)
    assert min(score.one_scale.abs_rel, score.abs_rel) > 0.05


def test_the_scale_of_each_frame_and_its_spread_are_those_put_in() -> None:
    truths_mm, factors = depths(4), np.array([0.5, 1.0, 1.5, 2.0])
    score = scored(truths_mm, [factor * truth for factor, truth in zip(factors, truths_mm, strict=True)])
    assert [found.scale for found in score.frames] == pytest.approx(list(1 / factors))
    assert score.scale_log_std == pytest.approx(np.std(np.log(factors)))
    assert [found.metric_abs_rel for found in score.frames] == pytest.approx(list(abs(factors - 1)), abs=1e-6)
    assert score.abs_rel == pytest.approx(0.0, abs=1e-6)
    assert score.one_scale.abs_rel > 0.3
    assert score.exponent_and_medians.abs_rel == pytest.approx(0.0, abs=1e-4)


def test_pixels_without_truth_or_depth_do_not_count() -> None:
    truth_mm = np.full((48, 64), 40.0, np.float32)
    depth_mm = truth_mm.copy()
    truth_mm[:8], depth_mm[8:16], depth_mm[0, 0] = np.nan, np.nan, 9000.0
    score = scored([truth_mm], [depth_mm])
    assert (score.abs_rel, score.delta, score.one_scale.abs_rel) == pytest.approx((0, 1, 0), abs=1e-6)


def test_a_frame_with_nothing_to_compare_leaves_the_mean_to_the_others() -> None:
    truths_mm = depths(2)
    score = scored([*truths_mm, np.full_like(truths_mm[0], np.nan)], [*truths_mm, truths_mm[0]])
    assert score.abs_rel == 0
    assert np.isnan(score.frames[2].abs_rel)
    empty = scored([np.full_like(truths_mm[0], np.nan)], [truths_mm[0]])
    assert np.isnan([empty.abs_rel, empty.one_scale.abs_rel]).all()


# ---- change over time


def steady(factors: list[float]) -> measures.Steadiness:
    clip = [frame(k) for k in range(len(factors))]
    truth_mm = depths(1)[0]
    valid = [item.valid for item in clip]
    return measures.steadiness(CAMERA, valid, [factor * truth_mm for factor in factors], measures.link_clip(clip))


def test_even_growth_of_depth_is_change_without_flicker() -> None:
    found = steady([1.03**k for k in range(5)])
    assert found.pairs == 4
    assert found.log_step_std == pytest.approx(0.0, abs=1e-5)
    assert found.change == pytest.approx(0.03 / 1.03, rel=1e-3)
    assert found.opw_change == pytest.approx(found.change, rel=1e-3)
    assert found.rtc == 0


def test_depth_to_and_fro_flickers_by_the_size_of_its_steps() -> None:
    found = steady([1.0, 1.05, 1.0, 1.05, 1.0])
    assert found.log_step_std == pytest.approx(np.log(1.05), rel=1e-3)
    assert steady([1.0, 1.0, 1.0]).rtc == 1


# ---- tables, files, pictures


def test_weights_of_several_seeds_share_a_row_with_mean_and_range() -> None:
    truth = depths(1)
    names = ["shading x ray z", "scopenet a/1", "scopenet b/2"]
    table = {"scene": {name: scored(truth, [truth[0] ** (1 - k / 10)]) for k, name in enumerate(names)}}
    lines = bench.summary(table).splitlines()
    assert [line.split("  ")[0] for line in lines] == ["AbsRel / delta<1.25", "shading x ray z", "scopenet"]
    first, second = (table["scene"][name].abs_rel for name in names[1:])
    assert f"{(first + second) / 2:.3f} ({min(first, second):.3f}..{max(first, second):.3f})" in lines[2]
    assert bench.spread([0.5], ".1f") == "0.5"
    assert bench.spread([np.nan, np.nan], ".1f") == "-"
    assert "exponent, medians" in bench.report(table, {})
    assert "uncertainty" not in bench.report(table, {})


def test_each_weights_file_is_an_estimator_that_tells_sigma(tmp_path: Path) -> None:
    from training.export import export
    from training.network import ScopeNet

    files = [tmp_path / f"seed{seed}" / "weights.onnx" for seed in (0, 1)]
    for file in files:
        file.parent.mkdir()
        export(ScopeNet().eval(), file, {})
    makers = bench.networks([str(file) for file in files])
    assert list(makers) == ["scopenet seed0/weights.onnx", "scopenet seed1/weights.onnx"]
    found = makers["scopenet seed1/weights.onnx"]()(frame())
    assert found.sigma_mm is not None
    assert found.depth_mm.shape == found.sigma_mm.shape == (48, 64)
    assert (found.depth_mm > 0).all()
    assert (found.sigma_mm > 0).all()
    assert list(bench.networks([])) == ["scopenet"]


def test_json_has_null_where_nothing_was_measured() -> None:
    kept = json.loads(json.dumps(bench.strict(asdict(scored(depths(1), depths(1)))), allow_nan=False))
    assert kept["mean"]["rank"] is None
    assert kept["sparsification"] == []
    assert kept["frames"][0]["abs_rel"] > 0


def test_pictures_are_drawn_with_and_without_sigma(tmp_path: Path) -> None:
    frames, truths_mm = [frame(0), frame(1)], depths(2)
    plain = [measures.Prediction(truth_mm) for truth_mm in truths_mm]
    unsure = [replace(item, sigma_mm=0.1 * item.depth_mm) for item in plain]
    for name, made in (("plain.png", plain), ("unsure.png", unsure)):
        draw_scene(frames, truths_mm, made, tmp_path / name)
    pictures = [cv2.imread(str(tmp_path / name)) for name in ("plain.png", "unsure.png")]
    assert pictures[0].shape == pictures[1].shape
    assert (pictures[0] != pictures[1]).any(-1).mean() > 0.02
    scores = {name: measures.score_sequence(frames, truths_mm, made) for name, made in (("a", plain), ("b", unsure))}
    draw_sparsification({"scene": scores}, tmp_path / "curves.png")
    assert cv2.imread(str(tmp_path / "curves.png")).std() > 0


def test_of_points_that_share_a_pixel_the_nearest_is_drawn() -> None:
    x, y = CAMERA.unproject(np.array([10, 20]))[:2]
    points_mm = np.array([[x * z, y * z, z] for z in (30.0, 20.0, 40.0)] + [[900.0, 0.0, 5.0]])
    depth_mm = scenes.drawn(points_mm, CAMERA)
    assert depth_mm[20, 10] == 20.0
    assert np.isfinite(depth_mm).sum() == 1


# ---- real frames


@pytest.mark.real
def test_shading_has_the_figures_that_the_document_states(real_data: Path) -> None:
    table = bench.measure(real_data, makers={"shading x ray z": bench.shading})
    stated = {
        "cecum clouds": (0.095, 0.97),
        "trans_t1_a": (0.116, 0.84),
        "trans_t1_a wide": (0.144, 0.82),
        "endonerf pulling": (0.128, 0.84),
    }
    for scene, figures in stated.items():
        score = table[scene]["shading x ray z"]
        assert (score.abs_rel, score.delta) == pytest.approx(figures, abs=0.006), scene


@pytest.mark.real
def test_the_shipped_network_has_the_figures_that_the_model_card_states(real_data: Path) -> None:
    (maker,) = bench.networks([]).values()
    table = bench.measure(real_data, (160, 128), {"scopenet": maker})
    stated = {"cecum clouds": (0.101, 0.98), "trans_t1_a": (0.107, 0.87), "endonerf pulling": (0.104, 0.86)}
    for scene, figures in stated.items():
        score = table[scene]["scopenet"]
        assert (score.abs_rel, score.delta) == pytest.approx(figures, abs=0.006), scene


@pytest.mark.real
@pytest.mark.parametrize(("scene", "count"), [("cecum clouds", 2), ("trans_t1_a", 10), ("endonerf pulling", 11)])
def test_a_scene_is_the_same_at_twice_the_size(real_data: Path, scene: str, count: int) -> None:
    make: Callable = scenes.SCENES[scene]
    small, large = (list(make(real_data, size)) for size in bench.SIZES)
    assert len(small) == len(large) == count
    for (few, few_mm), (many, many_mm) in zip(small, large, strict=True):
        assert many_mm.shape == many.valid.shape == (256, 320)
        assert np.isnan(few_mm[~few.valid]).all()
        assert few.depth_mm is None
        assert np.nanmedian(many_mm) == pytest.approx(np.nanmedian(few_mm), rel=0.08)
