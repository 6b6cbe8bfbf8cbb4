"""The table of depth without any download: closed forms of its measures, its estimators, its scenes on real frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame
from scopemap_bench.scripts import depth_without_download as bench
from scopemap_bench.scripts.depth_without_download import drawn

pytestmark = pytest.mark.networks

CAMERA = PinholeCamera(50.0, 50.0, 31.5, 23.5, 64, 48)
SHAPE = (300, 400)


def frame(rgb: np.ndarray | None = None) -> Frame:
    shape = (48, 64) if rgb is None else rgb.shape[:2]
    grey = np.random.default_rng(0).integers(40, 200, (*shape, 3), dtype=np.uint8)
    return Frame(0, 0.0, grey if rgb is None else rgb, CAMERA.resized(*shape[::-1]), np.ones(shape, bool))


def depths(count: int) -> list[np.ndarray]:
    return [np.random.default_rng(seed).uniform(10, 80, (48, 64)).astype(np.float32) for seed in range(count)]


def scored(truths_mm: list[np.ndarray], made: list[np.ndarray]) -> bench.SceneScore:
    return bench.score_scene([frame()] * len(made), truths_mm, [(depth_mm, None) for depth_mm in made])


@pytest.mark.parametrize("claimed", [1.0, 0.5])
def test_sigma_as_large_as_laplace_errors_covers_what_it_should(claimed: float) -> None:
    truth_mm = np.random.default_rng(1).uniform(10, 80, SHAPE)
    depth_mm = truth_mm * np.exp(np.random.default_rng(2).laplace(scale=0.08, size=SHAPE))
    made = (depth_mm, claimed * np.sqrt(2) * 0.08 * depth_mm)
    score = bench.score_scene([frame(np.zeros((*SHAPE, 3), np.uint8))], [truth_mm], [made])
    expected = [1 - np.exp(-np.sqrt(2) * claimed * sigmas) for sigmas in (1, 2)]
    assert [score.within_1_sigma, score.within_2_sigma] == pytest.approx(expected, abs=0.01)


def test_rank_is_one_where_sigma_orders_the_errors_and_none_without_sigma() -> None:
    # As many pixels too near as too far, the middle one exact: the median scale is 1.
    error = np.linspace(-0.4, 0.4, 801).reshape(1, -1)
    truth_mm = np.full(error.shape, 50.0)
    depth_mm = truth_mm * (1 + error)
    seen = [frame(np.zeros((1, 801, 3), np.uint8))]
    score = bench.score_scene(seen, [truth_mm], [(depth_mm, (0.01 + error**2) * depth_mm)])
    assert score.rank == pytest.approx(1.0, abs=1e-4)
    assert np.isnan(bench.score_scene(seen, [truth_mm], [(depth_mm, None)]).rank)


def test_errors_in_saturated_pixels_are_told_apart() -> None:
    truth_mm = np.full((48, 64), 40.0, np.float32)
    rgb, depth_mm = np.full((48, 64, 3), 100, np.uint8), truth_mm.copy()
    rgb[:, :16, 0], depth_mm[:, :16], depth_mm[:, 16:20] = 250, 60.0, 50.0
    score = bench.score_scene([frame(rgb)], [truth_mm], [(depth_mm, None)])
    assert score.saturated_ratio == pytest.approx(0.5 / (0.25 * 4 / 48))


def test_the_scale_of_each_frame_and_its_spread_are_those_put_in() -> None:
    truths_mm, factors = depths(4), np.array([0.5, 1.0, 1.5, 2.0])
    score = scored(truths_mm, [factor * truth for factor, truth in zip(factors, truths_mm, strict=True)])
    assert score.scale_log_std == pytest.approx(np.std(np.log(factors)))
    assert score.metric_abs_rel == pytest.approx(np.mean(abs(factors - 1)), abs=1e-6)
    assert score.abs_rel == pytest.approx(0.0, abs=1e-6)
    assert score.one_scale_abs_rel > 0.3


def test_pixels_and_frames_without_truth_or_depth_do_not_count() -> None:
    truth_mm = np.full((48, 64), 40.0, np.float32)
    depth_mm, nothing = truth_mm.copy(), np.full_like(truth_mm, np.nan)
    truth_mm[:8], depth_mm[8:16], depth_mm[0, 0] = np.nan, np.nan, 9000.0
    score = scored([truth_mm, nothing], [depth_mm, depth_mm])
    assert (score.abs_rel, score.delta, score.one_scale_abs_rel) == pytest.approx((0, 1, 0), abs=1e-6)
    assert np.isnan([scored([nothing], [depth_mm]).abs_rel, scored([nothing], [depth_mm]).one_scale_abs_rel]).all()


def test_each_weights_file_is_an_estimator_that_tells_sigma(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the extra networks")
    from training.export import export
    from training.network import ScopeNet

    file = tmp_path / "seed1" / "weights.onnx"
    file.parent.mkdir()
    export(ScopeNet().eval(), file, {})
    makers = bench.networks([str(file)])
    assert list(makers) == ["scopenet seed1/weights.onnx"]
    depth_mm, sigma_mm = makers["scopenet seed1/weights.onnx"]()(frame())
    assert sigma_mm is not None
    assert depth_mm.shape == sigma_mm.shape == (48, 64)
    assert min(depth_mm.min(), sigma_mm.min()) > 0
    assert list(bench.networks([])) == ["scopenet"]


def test_of_points_that_share_a_pixel_the_nearest_is_drawn() -> None:
    x, y = CAMERA.unproject(np.array([10, 20]))[:2]
    points_mm = np.array([[x * z, y * z, z] for z in (30.0, 20.0, 40.0)] + [[900.0, 0.0, 5.0]])
    depth_mm = drawn(points_mm, CAMERA)
    assert depth_mm[20, 10] == 20.0
    assert np.isfinite(depth_mm).sum() == 1


SCENES = ("cecum clouds", "trans_t1_a", "endonerf pulling")


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "stated"),
    [
        ("shading", [(0.095, 0.97), (0.116, 0.84), (0.128, 0.84)]),
        ("scopenet", [(0.101, 0.98), (0.107, 0.87), (0.104, 0.86)]),
    ],
)
def test_depth_has_the_figures_that_the_model_card_states(
    real_data: Path, name: str, stated: list[tuple[float, float]]
) -> None:
    makers = bench.WITHOUT_WEIGHTS | bench.networks([])
    table = bench.measure(real_data, (160, 128), {name: makers[name]})
    for scene, figures in zip(SCENES, stated, strict=True):
        assert (table[scene][name].abs_rel, table[scene][name].delta) == pytest.approx(figures, abs=0.006), scene
