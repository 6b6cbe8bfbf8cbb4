"""Focal length from motion: exact on synthetic points, honest deviations, none where it is undetermined."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.config import Config
from scopemap.engine.errors import CalibrationError
from scopemap.engine.geometry.se3 import so3_exp
from scopemap.input.focal_length.from_motion import (
    FocalEstimate,
    WindowFit,
    adjust_window,
    combine,
    with_focal_from_motion,
)
from scopemap.input.focal_length.windows import Window
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.result.wording import in_words
from scopemap.runner.reconstruct import reconstruct
from tests.support.front_door import said
from tests.support.turning_clip import focal_of, write_clip

pytestmark = pytest.mark.slow

HALF_PX = 160.0
ROTATION_DEG, TRANSLATION = (6.0, 4.0, 2.0), (0.25, -0.15, 0.1)


def _window(
    fov_deg: float,
    *,
    seed: int = 0,
    noise_px: float = 0.0,
    rotation_deg: tuple[float, float, float] = ROTATION_DEG,
    translation: tuple[float, float, float] = TRANSLATION,
    distortion: float = 0.0,
) -> Window:
    """200 points before a camera that turns and moves on, seen in 7 partners; its median depth is about 1."""
    rng = np.random.default_rng(seed)
    focal = focal_of(fov_deg, int(2 * HALF_PX))
    pixel = rng.uniform(-1, 1, (200, 2)) * [0.9 * HALF_PX, 0.7 * HALF_PX]
    point = np.concatenate([pixel / focal, np.ones((200, 1))], 1) * rng.uniform(0.6, 1.8, (200, 1))
    seen = []
    for share in np.arange(1, 8) / 7:
        moved = point @ so3_exp(np.radians(rotation_deg) * share).T + share * np.array(translation)
        seen.append(focal * moved[:, :2] / moved[:, 2:])
    everywhere = _distorted(np.stack(seen, 1), distortion)
    everywhere += rng.normal(0, noise_px, everywhere.shape)
    everywhere[rng.random(everywhere.shape[:2]) < 0.1] = np.nan
    return Window(_distorted(pixel, distortion), everywhere, HALF_PX)


def _distorted(straight: np.ndarray, distortion: float) -> np.ndarray:
    """Pixels that x (1 + distortion |x|^2 / h^2) makes straight, by fixed-point iteration."""
    pixel = straight.copy()
    for _ in range(50):
        pixel = straight / (1 + distortion * (pixel**2).sum(-1, keepdims=True) / HALF_PX**2)
    return pixel


def _error(fit: WindowFit | None, fov_deg: float) -> float:
    assert fit is not None
    return fit.log_focal - math.log(focal_of(fov_deg, int(2 * HALF_PX)))


ASSUMED_PX = focal_of(70.0, int(2 * HALF_PX))


@pytest.mark.parametrize("fov_deg", [45.0, 90.0, 115.0])
def test_without_noise_the_focal_length_is_exact(fov_deg: float) -> None:
    fit = adjust_window(_window(fov_deg), ASSUMED_PX)
    assert abs(_error(fit, fov_deg)) < 2e-3
    assert fit is not None
    assert fit.tilt_deg == pytest.approx(math.hypot(*ROTATION_DEG[:2]), rel=0.05)
    assert fit.residual_px < 0.05


@pytest.mark.parametrize("fov_deg", [60.0, 95.0])
def test_distortion_does_not_bias_the_focal_length(fov_deg: float) -> None:
    fit = adjust_window(_window(fov_deg, distortion=0.25), ASSUMED_PX)
    assert abs(_error(fit, fov_deg)) < 0.02
    assert fit is not None
    assert fit.distortion == pytest.approx(0.25, abs=0.02)


def test_the_standard_deviation_covers_the_error_by_noise() -> None:
    scores = []
    for seed in range(10):
        fit = adjust_window(_window(75.0, seed=seed, noise_px=0.3), ASSUMED_PX)
        assert fit is not None
        assert 1e-3 < fit.deviation < 0.1
        assert fit.residual_px == pytest.approx(0.3, rel=0.25)
        scores.append(_error(fit, 75.0) / fit.deviation)
    assert 0.3 < np.sqrt(np.mean(np.square(scores))) < 1.8


def test_pure_rotation_determines_the_focal_length() -> None:
    fits = [adjust_window(_window(85.0, seed=s, noise_px=0.2, translation=(0, 0, 0)), ASSUMED_PX) for s in range(3)]
    estimate = combine([fit for fit in fits if fit is not None], 2 * HALF_PX)
    assert estimate.reason == ""
    assert abs(math.log(estimate.focal_px / focal_of(85.0, int(2 * HALF_PX)))) < 2 * estimate.share


@pytest.mark.parametrize(
    "motion",
    [
        {"rotation_deg": (0, 0, 0), "translation": (0.02, 0.03, -0.5)},  # along the axis
        {"rotation_deg": (0, 0, 0), "translation": (0.4, 0.1, 0.0)},  # sideways
        {"rotation_deg": (0, 0, 25.0), "translation": (0, 0, -0.2)},  # rolling
        {"rotation_deg": (0, 0, 0), "translation": (0, 0, 0)},  # at rest
    ],
    ids=["forward", "sideways", "roll", "rest"],
)
def test_motion_without_tilt_does_not_determine_it(motion: dict) -> None:
    fits = [adjust_window(_window(100.0, seed=seed, noise_px=0.25, **motion), ASSUMED_PX) for seed in range(3)]
    estimate = combine([fit for fit in fits if fit is not None], 2 * HALF_PX)
    assert estimate.reason or estimate.share > 0.15


# ---- combination of windows


def _fit(fov_deg: float, deviation: float = 0.01, tilt_deg: float = 10.0) -> WindowFit:
    return WindowFit(math.log(focal_of(fov_deg, 320)), deviation, 0.2, tilt_deg, 0.0)


def test_less_tilt_and_disagreement_increase_the_deviation() -> None:
    two, many = (combine([_fit(80.0)] * count, 320.0) for count in (2, 20))
    assert two.fov_deg == pytest.approx(80.0)
    # Windows have a common error, so that many are little better than two.
    assert 0.035 < many.share < two.share < 0.05
    similar, different = combine([_fit(80.0)] * 4, 320.0), combine([_fit(60.0), _fit(100.0)] * 2, 320.0)
    assert different.share > 3 * similar.share
    assert "no endoscope" in combine([_fit(15.0)] * 3, 320.0).reason
    assert combine([_fit(80.0, tilt_deg=1.0)] * 5, 320.0).share == pytest.approx(0.4, rel=0.05)
    assert "turns too little" in combine([_fit(80.0, tilt_deg=0.01)] * 5, 320.0).reason
    assert "turns too little" in combine([_fit(80.0)], 320.0).reason


# ---- images


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clips") / "turning", 100.0, 48)


def test_a_run_uses_the_estimate_and_saves_its_deviation(turning: Path, tmp_path: Path) -> None:
    config = Config.load(settings={"depth.backend": "shading", "networks.flow": "none", "fusion.enabled": False})
    result = reconstruct(open_sequence(turning), config, out=tmp_path / "out")
    truth_px = focal_of(100.0)
    assert result.camera.fx == pytest.approx(truth_px, rel=0.1)
    facts = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert facts["camera"]["source"].startswith("estimated: from the motion of 48 frames, fx ")
    assert "focal length" in facts["seconds"]
    sigma_px = facts["camera"]["focal_sigma_px"]
    assert abs(result.camera.fx - truth_px) < 2 * sigma_px < 0.2 * truth_px
    for name in ("camera.yaml", "source_camera.yaml"):
        storage = cv2.FileStorage(str(tmp_path / "out" / name), cv2.FILE_STORAGE_READ)
        assert storage.getNode("focal_sigma_px").real() == pytest.approx(sigma_px)
        again = open_sequence(turning, camera=tmp_path / "out" / name)
        assert again.calibrated
        assert again.camera.fx == pytest.approx(result.camera.fx)


# ---- the setting


def _settings(focal: str) -> Config:
    return Config.load(settings={"input.focal": focal})


@pytest.fixture
def still(tmp_path: Path) -> Sequence:
    return open_sequence(write_clip(tmp_path / "still", 100.0, 12, turn_deg=0.0, way_mm=0.0))


@pytest.mark.parametrize("focal", ["auto", "assume"])
def test_a_camera_at_rest_stays_as_assumed(still: Sequence, focal: str) -> None:
    config = _settings(focal).model_copy(update={"fusion": Config().fusion.model_copy(update={"enabled": False})})
    result = reconstruct(still, config)
    assert result.camera == still.camera
    assert result.provenance["camera"]["focal_sigma_px"] is None
    camera, notes = result.provenance["camera"]["source"], said(result.provenance)
    assert camera.startswith("assumed: horizontal field of view 70 deg")
    assert ("the motion does not constrain it" in camera) == (focal == "auto")
    assert "--fov" not in camera  # it was not given
    assert not any("focal length:" in note for note in notes)
    assert ("focal length" in result.provenance["seconds"]) == (focal == "auto")


ESTIMATES = {
    "clear": FocalEstimate(84.0, 0.04, 100.0, 5),
    "wide": FocalEstimate(84.0, 0.2, 100.0, 5),
    "agrees": FocalEstimate(140.0, 0.05, 71.0, 5),
    "bent": FocalEstimate(84.0, 0.04, 100.0, 5, distortion=0.3),
    "none": FocalEstimate(math.nan, math.inf, math.nan, 0, reason="0 windows"),
}


@pytest.mark.parametrize(
    ("name", "focal", "taken", "message"),
    [
        ("clear", "auto", True, "fx 84 +- 3 px, horizontal field of view 100 deg"),
        ("bent", "auto", True, "radial distortion, about 30 %"),
        ("wide", "auto", False, "uncertain: fx 84 +- 17 px"),
        ("agrees", "auto", False, "consistent with the estimate from the motion: fx 140 +- 7 px"),
        ("none", "auto", False, "0 windows"),
        ("clear", "flow", True, "fx 84 +- 3 px"),
        ("wide", "flow", True, "fx 84 +- 17 px"),
        ("agrees", "flow", True, "fx 140 +- 7 px"),
    ],
)
def test_which_estimate_is_taken(
    still: Sequence, monkeypatch: pytest.MonkeyPatch, name: str, focal: str, taken: bool, message: str
) -> None:
    estimate = ESTIMATES[name]
    monkeypatch.setattr("scopemap.input.focal_length.from_motion.focal_from_motion", lambda *_: estimate)
    found, notes = with_focal_from_motion(still, _settings(focal))
    assert message in " ".join([found.camera_source, *map(in_words, notes)])
    if taken:
        assert found.camera.fx == pytest.approx(estimate.focal_px)
        assert found.focal_sigma_px == pytest.approx(estimate.sigma_px)
    else:
        assert found.camera is still.camera
        assert found.focal_sigma_px is None
    if name == "none":
        with pytest.raises(CalibrationError, match=r"input\.focal = flow.*0 windows"):
            with_focal_from_motion(still, _settings("flow"))
