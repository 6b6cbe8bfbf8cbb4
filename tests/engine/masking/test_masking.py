"""Masking: field of view, highlights and exposure on drawn images, whose right mask is known, and on real frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MaskSettings
from scopemap.engine.frame import Frame, is_constant
from scopemap.engine.masking.masker import Masker
from scopemap.input.opening import open_sequence

SETTINGS = MaskSettings()
CAMERA = PinholeCamera(200.0, 200.0, 159.5, 119.5, 320, 240)
CENTRE, RADIUS = (160, 120), 105


def tissue(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.normal(0, 60, (240, 320)).astype(np.float32), (0, 0), 4)
    return np.clip(np.array([170.0, 90.0, 80.0]) + texture[..., None], 40, 220).astype(np.uint8)


def disc(radius: float) -> np.ndarray:
    return cv2.circle(np.zeros((240, 320), np.uint8), CENTRE, int(radius), 1, -1).astype(bool)


def frame(rgb: np.ndarray, valid: np.ndarray | None = None) -> Frame:
    return Frame(0, 0.0, rgb, CAMERA, np.ones(rgb.shape[:2], bool) if valid is None else valid)


def in_circle(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 9, (240, 320, 3), dtype=np.uint8)
    return np.where(disc(RADIUS)[..., None], tissue(seed), noise).astype(np.uint8)


def test_the_image_circle_is_found_and_shrunk() -> None:
    valid = Masker(SETTINGS)(frame(in_circle())).valid
    assert not valid[~disc(RADIUS)].any()
    assert valid[disc(RADIUS - 6)].all()
    assert not valid[disc(RADIUS) & ~disc(RADIUS - 2)].any()


def test_a_dark_lumen_is_in_the_field_and_a_hole_only_by_exposure() -> None:
    image = in_circle()
    image[disc(40)] = 3
    masker = Masker(SETTINGS)
    assert not masker(frame(image)).valid[disc(39)].any()
    # The lumen comes into the light: nothing of the first frame may keep it out.
    assert masker(frame(in_circle(1))).valid[disc(RADIUS - 6)].all()


def test_what_rectification_could_not_fill_stays_out_with_a_margin() -> None:
    rectified = disc(RADIUS)
    image = np.where(rectified[..., None], tissue(), 0).astype(np.uint8)
    valid = Masker(SETTINGS)(frame(image, rectified)).valid
    assert not valid[~disc(RADIUS - 2)].any()
    assert valid[disc(RADIUS - 6)].all()


def test_highlights_are_found_and_widened_but_bright_tissue_is_not_one() -> None:
    image = tissue()
    cv2.circle(image, (100, 100), 4, (235, 230, 228), -1)
    red = cv2.circle(np.zeros((240, 320), np.uint8), (220, 120), 30, 1, -1).astype(bool)
    image[red] = np.clip(image[red] * np.array([1.45, 1.2, 1.1]), 0, 255).astype(np.uint8)
    valid = Masker(SETTINGS)(frame(image)).valid
    spot = cv2.circle(np.zeros((240, 320), np.uint8), (100, 100), 5, 1, -1).astype(bool)
    assert not valid[spot].any()
    assert valid[red].all()
    assert (~valid).sum() < 2.5 * spot.sum()
    kept = Masker(MaskSettings(method="no-highlights"))(frame(image)).valid
    assert kept.all()


def test_clipped_pixels_go_but_red_alone_may_clip() -> None:
    image = tissue()
    image[50:90, 50:90] = (255, 250, 180)
    image[150:190, 50:90] = (255, 120, 100)
    valid = Masker(SETTINGS)(frame(image)).valid
    assert not valid[50:90, 50:90].any()
    assert valid[150:190, 50:90].all()


def test_a_black_frame_has_no_tissue_and_does_not_fail() -> None:
    black = np.zeros((240, 320, 3), np.uint8)
    masker = Masker(SETTINGS)
    assert not masker(frame(black)).valid.any()
    assert masker(frame(in_circle())).valid[disc(RADIUS - 6)].all()


@pytest.mark.parametrize("sigma", [2.0, 6.0])
def test_the_noise_of_a_black_image_is_not_tissue(sigma: float) -> None:
    rng = np.random.default_rng(1)
    dark = np.clip(rng.normal(2, sigma, tissue().shape), 0, 255).astype(np.uint8)
    assert is_constant(dark)
    assert Masker(MaskSettings())(frame(dark)).valid.mean() < 0.01
    noisy = np.clip(tissue() + rng.normal(0, sigma, dark.shape), 0, 255).astype(np.uint8)
    assert not is_constant(noisy)
    assert Masker(MaskSettings(method="no-highlights"))(frame(noisy)).valid.all()


@pytest.mark.real
def test_the_round_field_of_a_laparoscope(real_data: Path) -> None:
    """The clip shows a circle of 552 px in 1280x720, cut off above and below (measured by hand in the picture)."""
    masker = Masker(SETTINGS)
    video = real_data / "endoscopy" / "video" / "laparoscopy_rvim.mp4"
    valid = [masker(f).valid for f, _ in open_sequence(video, frames=slice(0, 60, 10))][-1]
    columns = np.flatnonzero(valid[80:100].any(0))
    assert 12 <= columns[0] <= 24
    assert 286 <= columns[-1] <= 298
    assert 0.65 < valid.mean() < 0.8
