"""The overlay finder of the runs: burned-in text goes, tissue stays, a camera at rest makes no overlay."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config, MaskSettings
from scopemap.engine.frame import Frame
from scopemap.engine.masking.masker import Masker
from scopemap.engine.masking.overlays import OverlayFinder
from scopemap.input.opening import open_sequence
from tests.support.drawn_clips import SIZE, Change, clip, text, tissue

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(300.0, 300.0, 159.5, 119.5, *SIZE)
EVERYWHERE = np.ones(SIZE[::-1], bool)


def found_in(pictures: list[np.ndarray], field: np.ndarray = EVERYWHERE) -> list[np.ndarray | None]:
    finder = OverlayFinder()
    return [finder(picture, field) for picture in pictures]


def strokes(change: Change) -> np.ndarray:
    return change(0, np.zeros((*SIZE[::-1], 3), np.uint8)).max(-1) > 100


def test_text_is_found_causally_and_little_else() -> None:
    found = found_in(clip(40, text()))
    assert all(one is None for one in found[:11])
    last = found[-1]
    assert last is not None
    assert last[strokes(text())].mean() > 0.97
    near = cv2.dilate(strokes(text()).astype(np.uint8), np.ones((11, 11))) > 0
    assert not (last & ~near).any()


def test_a_panel_is_filled() -> None:
    def panel(_: int, picture: np.ndarray) -> np.ndarray:
        out = picture.copy()
        cv2.rectangle(out, (40, 180), (140, 210), (10, 10, 30), -1)
        return text("ID 77", (50, 200))(0, out)

    last = found_in(clip(40, panel))[-1]
    assert last is not None
    assert last[182:209, 42:139].all()
    assert last.mean() < 1.6 * 100 * 30 / EVERYWHERE.size


def test_a_camera_at_rest_makes_no_overlay_whatever_moves_before_it() -> None:
    rng = np.random.default_rng(0)
    still = clip(1, text())[0]
    pictures = []
    for number in range(80):
        noisy = np.clip(still + rng.normal(0, 2, still.shape), 0, 255).astype(np.uint8)
        # An instrument that goes to and fro, and a lamp that flickers.
        cv2.rectangle(noisy, (60 + 3 * (number % 40), 80), (110 + 3 * (number % 40), 160), (150, 150, 160), -1)
        pictures.append(np.clip(noisy * (1 + 0.1 * np.sin(number)), 0, 255).astype(np.uint8))
    assert not any(one is not None for one in found_in(pictures))


def with_vessels(picture: np.ndarray) -> np.ndarray:
    """Tissue with sharp dark lines, as near as a picture has them."""
    out, (height, width) = picture.copy(), picture.shape[:2]
    for row in range(10, height, 30):
        along = np.linspace(0, width, 80)
        line = np.stack([along, row + 12 * np.sin(along / 36 + row)], -1).astype(np.int32)
        cv2.polylines(out, [line], False, (90, 20, 20), 2)
    return out


def noisy(picture: np.ndarray, number: int) -> np.ndarray:
    rng = np.random.default_rng(number)
    return np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).astype(np.uint8)


def breathing(count: int, share: float) -> list[np.ndarray]:
    """The camera rests, the tissue goes to and fro but for the right part of the view, so much of its width."""
    moving, still = clip(21), with_vessels(clip(1)[0])
    x = round(SIZE[0] * (1 - share))
    pictures = []
    for number in range(count):
        picture = moving[round(10 + 10 * np.sin(2 * np.pi * number / 40))].copy()
        picture[:, x:] = still[:, x:]
        pictures.append(noisy(picture, number))
    return pictures


def test_tissue_that_rests_while_the_rest_breathes_is_no_overlay() -> None:
    finder = OverlayFinder()
    assert not any(finder(picture, EVERYWHERE) is not None for picture in breathing(100, 0.2))
    assert finder.count > 20


def test_an_overlay_that_has_gone_is_not_kept_by_a_camera_at_rest() -> None:
    menu, finder = text("MENU", (60, 150)), OverlayFinder()
    pictures = clip(40, text())
    for number, picture in enumerate(pictures):
        found = finder(menu(number, picture), EVERYWHERE)
    assert found is not None
    assert found[strokes(menu)].mean() > 0.97
    near = cv2.dilate(strokes(menu).astype(np.uint8), np.ones((11, 11))) > 0
    for number in range(3):
        found = finder(noisy(pictures[-1], number), EVERYWHERE)
        assert found is not None
        assert found[strokes(text())].mean() > 0.97
        assert not (found & near).any()
    shown = finder(menu(0, pictures[-1]), EVERYWHERE)
    assert shown is not None
    assert shown[strokes(menu)].mean() > 0.97
    assert finder(tissue(39), EVERYWHERE) is None


def test_runs_leave_text_out_unless_told_and_as_the_paper_does() -> None:
    maskers = [Masker(MaskSettings(method=method)) for method in ("no-highlights", "no-highlights+no-overlays")]
    for number, picture in enumerate(clip(40, text())):
        frame = Frame(number, 0.0, picture, CAMERA, EVERYWHERE)
        masked, plain = (masker(frame).valid for masker in maskers)
    letters = strokes(text())
    assert masked[letters].mean() < 0.03
    # White letters are over-exposed, their edges are not.
    assert plain[letters].mean() > 0.1
    assert plain[~letters].mean() > 0.99
    assert not Config.load("default").mask.has("no-overlays")
    assert Config.load("paper").mask.has("no-overlays")


@pytest.mark.real
@pytest.mark.parametrize(
    ("path", "largest_share"),
    [("endoscopy/c3vd/cecum_t1_a", 0.0), ("endoscopy/c3vd/trans_t1_a", 0.0),
     ("endoscopy/video/laparoscopy_rvim.mp4", 0.0), ("endoscopy/video/colonoscopy_nflba_03.mp4", 0.0),
     ("rgbd/7scenes_kitchen_100f", 0.0),
     # A status bar of the robot, looked at by eye.
     ("endoscopy/endonerf/pulling_soft_tissues", 0.006)],
)  # fmt: skip
def test_real_tissue_is_no_overlay(real_data: Path, path: str, largest_share: float) -> None:
    methods = ("no-highlights", "no-highlights+no-overlays")
    on, off = (Masker(MaskSettings(method=method)) for method in methods)
    largest = 0.0
    for frame in open_sequence(real_data / path).frames():
        left_out = off(frame).valid & ~on(frame).valid
        largest = max(largest, float(left_out.mean()))
        assert not left_out[: int(0.9 * len(left_out))].any()
    assert largest <= largest_share
