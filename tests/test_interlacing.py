"""Two fields in one picture: motion tells them, texture and noise do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_clips import tissue
from drawn_videos import HEIGHT, WIDTH, woven
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.io.video_format.interlacing import LEAST_COMBING, combing, deinterlaced, is_interlaced

NUMBERS = range(0, 40, 5)


def _grey(values: np.ndarray) -> np.ndarray:
    return np.clip(values, 0, 255).astype(np.uint8)[..., None].repeat(3, 2)


def test_motion_between_the_fields_raises_combing() -> None:
    for gap in (1, 2, 4):
        assert min(combing(woven(number, gap)) for number in NUMBERS) > 3 * LEAST_COMBING
    assert is_interlaced([woven(number) for number in NUMBERS])
    assert max(combing(tissue(number)) for number in NUMBERS) < LEAST_COMBING / 2
    assert not is_interlaced([tissue(number) for number in NUMBERS])


@pytest.mark.parametrize("size", [(720, 576), (720, 480), (1920, 1080)])
def test_broadcast_sizes_are_told(size: tuple[int, int]) -> None:
    first, second = (cv2.resize(tissue(number), size, interpolation=cv2.INTER_CUBIC) for number in (3, 4))
    assert combing(first) < LEAST_COMBING
    first[1::2] = second[1::2]
    assert combing(first) > LEAST_COMBING


@pytest.mark.parametrize("period", [2.0, 2.3, 3.0, 4.0, 5.0, 7.0])
def test_fine_horizontal_texture_is_no_comb(period: float) -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    lines = np.sign(np.sin(2 * np.pi * (v + 0.3) / period))
    assert combing(_grey(128 + 100 * lines)) < LEAST_COMBING
    assert combing(_grey(tissue(3)[..., 0] + 25 * lines)) < LEAST_COMBING
    assert combing(_grey(128 + 60 * np.sin(2 * np.pi * (v + 0.3 * u) / period))) < LEAST_COMBING
    side = 5 * round(period)
    assert combing(_grey(255.0 * ((u // side + v // side) % 2))) < LEAST_COMBING


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0, 25))
def test_noise_is_no_comb(seed: int, deviation: float) -> None:
    noise = np.random.default_rng(seed).normal(0, deviation, (HEIGHT, WIDTH, 3))
    assert combing(np.clip(tissue(2) + noise, 0, 255).astype(np.uint8)) < LEAST_COMBING
    assert combing(np.clip(128 + noise, 0, 255).astype(np.uint8)) < LEAST_COMBING


def test_what_has_no_two_fields_is_no_comb() -> None:
    for shape in ((1, 1), (2, 2), (31, 400), (400, 31), (33, 32)):
        assert combing(np.random.default_rng(0).integers(0, 255, (*shape, 3), dtype=np.uint8)) < LEAST_COMBING
    assert not is_interlaced([])


def test_a_clip_at_rest_needs_only_some_motion() -> None:
    still = [tissue(0)] * 6
    assert is_interlaced([*still, woven(5), woven(9)])
    assert not is_interlaced([*still, *still, woven(5)])


def test_one_field_is_left_where_it_was() -> None:
    comb = woven(3)
    out = deinterlaced(comb)
    np.testing.assert_array_equal(out[::2], tissue(3)[::2])
    assert combing(out) < LEAST_COMBING
    np.testing.assert_allclose(out[1:-1:2], (comb[:-2:2].astype(float) + comb[2::2]) / 2, atol=0.51)


@pytest.mark.parametrize("height", [1, 2, 3, 4, 5])
def test_a_slope_is_not_shifted_by_half_a_row(height: int) -> None:
    slope = np.broadcast_to(10 * np.arange(height)[:, None, None], (height, 4, 3)).astype(np.uint8)
    out = deinterlaced(slope)
    # The last row of an even number has nothing below it.
    inner = height - 1 if height % 2 == 0 else height
    np.testing.assert_array_equal(out[:inner], slope[:inner])
    assert out.shape == slope.shape
