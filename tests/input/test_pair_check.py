"""A pair is checked before it is believed: rows, sign and size of the disparity against what the calibration states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.engine.cameras.rectification import StereoPair
from scopemap.engine.config import Config, InputSettings
from scopemap.engine.errors import CalibrationError
from scopemap.engine.geometry.se3 import inverse, se3_exp
from scopemap.input.opening import open_sequence
from scopemap.input.pair_check import ImagePair, check_pair
from scopemap.runner.reconstruct import reconstruct
from tests.support.drawn_inputs import save
from tests.support.drawn_pairs import BENT, LEFT, LENS, T_BENT, beside, view, write_opencv, write_scared

PAIR = StereoPair(LEFT, LEFT, beside(), "pair of a drawing")
BENT_PAIR = StereoPair(LEFT, BENT, T_BENT, "pair of a drawing")
# As SCARED's: principal points far apart, hardly turned, rows some pixels apart.
SHIFTED = PinholeCamera(300.0, 300.0, 182.0, 124.0, LEFT.width, LEFT.height)
T_SHIFTED = inverse(se3_exp(np.array([0.002, 0.001, 0.003, 4.0, 0.02, 0.05])))
SHIFTED_PAIR = StereoPair(LEFT, SHIFTED, T_SHIFTED, "pair of a drawing")
PAIRS = {"ideal": PAIR, "bent": BENT_PAIR, "shifted": SHIFTED_PAIR}
PLANES = [(np.array([0.25, -0.3, 1.0]), 55.0), (np.array([0.0, 0.1, 1.0]), 75.0)]


def _seen(pair: StereoPair) -> list[ImagePair]:
    return [(view(pair.left, np.eye(4), plane), view(pair.right, pair.T_right_left, plane)) for plane in PLANES]


def _rectified(pair: StereoPair) -> list[ImagePair]:
    """What data sets publish as rectified: both cameras turned to be parallel, with one principal point."""
    R_left, R_right, P_left, P_right = pair.rectification((LEFT.width, LEFT.height))
    return [
        (_warped(left, pair.left, R_left, P_left), _warped(right, pair.right, R_right, P_right))
        for left, right in _seen(pair)
    ]


def _warped(picture: np.ndarray, camera: PinholeCamera | OpenCvCamera, R: np.ndarray, P: np.ndarray) -> np.ndarray:
    lens = np.array(LENS) if isinstance(camera, OpenCvCamera) else np.zeros(5)
    maps = cv2.initUndistortRectifyMap(
        camera.central.matrix, lens, R, P[:, :3], (LEFT.width, LEFT.height), cv2.CV_32FC1
    )
    return cv2.remap(picture, *maps, cv2.INTER_LINEAR)


def test_a_pattern_that_repeats_shows_nothing() -> None:
    tile = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (64, 64)), (0, 0), 3)
    levels = np.clip(128 + 400 * np.tile(tile, (5, 6)), 0, 255).astype(np.uint8)[..., None].repeat(3, 2)
    left, right = (levels[: LEFT.height, begin : begin + LEFT.width] for begin in (0, 24))
    assert check_pair(PAIR, [(left, right)]).endswith("its views have 0 points in common")


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_views_that_fit_are_believed(name: str) -> None:
    assert check_pair(PAIRS[name], _seen(PAIRS[name])) == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bent", "shifted"])
def test_views_that_are_rectified_already_are_refused(name: str) -> None:
    with pytest.raises(CalibrationError, match="the views are rectified already and pair of a drawing is not"):
        check_pair(PAIRS[name], _rectified(PAIRS[name]))


def test_the_error_says_what_would_be_measured() -> None:
    with pytest.raises(CalibrationError, match=r"it would measure (\d+)") as caught:
        check_pair(SHIFTED_PAIR, _rectified(SHIFTED_PAIR))
    wrong, right = (float(text.split(" mm")[0]) for text in str(caught.value).split("measure ")[1].split(" for "))
    assert right == pytest.approx(65, abs=12)
    assert wrong < 0.6 * right


@pytest.mark.slow
def test_rectified_views_with_their_own_calibration_are_believed() -> None:
    _, _, P, _ = BENT_PAIR.rectification((LEFT.width, LEFT.height))
    camera = replace(LEFT, fx=P[0, 0], fy=P[1, 1], cx=P[0, 2], cy=P[1, 2])
    baseline = float(np.linalg.norm(T_BENT[:3, 3]))
    assert check_pair(StereoPair(camera, camera, beside(baseline), "rectified"), _rectified(BENT_PAIR)) == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_views_the_wrong_way_round_are_refused(name: str) -> None:
    with pytest.raises(CalibrationError, match="the views do not fit pair of a drawing"):
        check_pair(PAIRS[name], [(right, left) for left, right in _seen(PAIRS[name])])


@pytest.mark.parametrize("rows", [4, -9])
def test_rows_that_differ_are_refused(rows: int) -> None:
    with pytest.raises(CalibrationError, match=rf"rows differ by {abs(rows)}\.\d px, without it by {abs(rows)}\.\d px"):
        check_pair(PAIR, [(left, np.roll(right, rows, 0)) for left, right in _seen(PAIR)])


def test_principal_points_that_rows_cannot_confirm_are_a_warning() -> None:
    beside_each_other = StereoPair(LEFT, replace(LEFT, cx=LEFT.cx + 20), beside(), "pair of a drawing")
    assert "rows do not show whether" in check_pair(beside_each_other, _seen(PAIR))


def test_views_without_texture_are_not_checked() -> None:
    flat = np.full((LEFT.height, LEFT.width, 3), 120, np.uint8)
    assert "was not checked: its views have 0 points" in check_pair(PAIR, [(flat, flat)])


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_scared, write_opencv])
def test_a_run_is_refused_by_one_sentence(write: object, tmp_path: Path) -> None:
    (tmp_path / "views").mkdir()
    for number, (left, right) in enumerate(_rectified(BENT_PAIR)):
        save(tmp_path / "views" / f"{number}.png", np.hstack([left, right]))
    file = write(tmp_path / ("pair.json" if write is write_scared else "pair.yaml"), BENT_PAIR)  # type: ignore[operator]
    sequence = open_sequence(tmp_path / "views", camera=file, settings=InputSettings(stereo="use:left-right"))
    with pytest.raises(CalibrationError, match="the views are rectified already"):
        reconstruct(sequence, Config.load(settings={"input.stereo": "use:left-right"}))
