"""Two views in one picture: found where they are, and never in an ordinary picture."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest

from scopemap.input.video_format.stereo_packing import packing
from tests.support.drawn_clips import circle, inside, tissue
from tests.support.drawn_videos import HEIGHT, WIDTH, above, above_squeezed, beside, beside_squeezed, stereo

NUMBERS = range(0, 40, 5)
Draw = Callable[[int], np.ndarray]


@pytest.mark.parametrize(
    ("draw", "layout", "squeezed", "size", "aspect"),
    [
        (beside, "left-right", False, (WIDTH, HEIGHT), 1.0),
        (above, "top-bottom", False, (WIDTH, HEIGHT), 1.0),
        (beside_squeezed, "left-right", True, (WIDTH // 2, HEIGHT), 2.0),
        (above_squeezed, "top-bottom", True, (WIDTH, HEIGHT // 2), 0.5),
    ],
)
def test_two_views_are_found(draw: Draw, layout: str, squeezed: bool, size: tuple[int, int], aspect: float) -> None:
    pictures = [draw(number) for number in NUMBERS]
    found = packing(pictures)
    assert found is not None
    assert (found.layout, found.squeezed, found.pixel_aspect) == (layout, squeezed, aspect)
    assert found.correlation > 0.6
    assert found.view_size(pictures[0].shape[1], pictures[0].shape[0]) == size
    np.testing.assert_array_equal(found.views(pictures[0])[0], pictures[0][: size[1], : size[0]])


def test_views_in_circles_are_found() -> None:
    change = inside(circle)
    pictures = [np.hstack([change(0, view) for view in stereo(number)]) for number in NUMBERS]
    found = packing(pictures)
    assert found is not None
    assert found.layout == "left-right"


@pytest.mark.parametrize("black", [0, 16])
def test_black_around_small_circles_does_not_count(black: int) -> None:
    """Black is level 16 in pictures that were not converted from the range of video."""
    change = inside(lambda mask: cv2.circle(mask, (160, 120), 70, 1, -1))
    left = np.maximum(change(0, tissue(0)), np.uint8(black))
    assert packing([np.hstack([left, np.roll(left, -10, axis=1)])]) is not None


@cache
def _blurred(seed: int, scale_px: float, deviation: float) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, (2 * HEIGHT, 2 * WIDTH)).astype(np.float32)
    blurred = cv2.GaussianBlur(noise, (0, 0), scale_px)
    return 110 + blurred / blurred.std() * deviation


def _grey(levels: np.ndarray) -> np.ndarray:
    return np.clip(levels, 0, 255).astype(np.uint8)[..., None].repeat(3, 2)


@pytest.mark.parametrize("disparity", [-0.02, 0.01, 0.03, 0.05])
@pytest.mark.parametrize("stack", [np.hstack, np.vstack])
def test_other_disparities_are_found(disparity: float, stack: Callable[..., np.ndarray]) -> None:
    assert packing([stack(stereo(number, disparity)) for number in NUMBERS]) is not None


@pytest.mark.parametrize(("scale_px", "deviation"), [(20, 6), (5, 12)])
@pytest.mark.parametrize("gap", [0.5, 0.45])
@pytest.mark.parametrize("peak", [150, 400])
def test_reflections_of_two_lamps_are_not_stereo(scale_px: float, deviation: float, gap: float, peak: float) -> None:
    v, u = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH]
    pictures = []
    for number in range(8):
        levels = _blurred(number, scale_px, deviation)
        for side in (-1, 1):
            away = np.hypot(u - 2 * WIDTH * (0.45 + 0.02 * number + side * gap / 2), v - HEIGHT * (0.7 + 0.1 * number))
            levels = levels + peak * np.exp(-(away**2) / 300)
        pictures.append(_grey(levels))
    assert packing(pictures) is None
    assert not any(packing([one]) for one in pictures)


@pytest.mark.parametrize(("scale_px", "deviation"), [(25, 8), (6, 20)])
@pytest.mark.parametrize("level", [200, 255])
def test_text_in_both_halves_is_not_stereo(scale_px: float, deviation: float, level: int) -> None:
    pictures = [_grey(_blurred(number, scale_px, deviation)) for number in range(6)]
    for view in pictures:
        for left in (20, 20 + WIDTH):
            cv2.putText(view, "PATIENT 123", (left, HEIGHT), cv2.FONT_HERSHEY_SIMPLEX, 0.8, [level] * 3, 2)
            cv2.rectangle(view, (left, HEIGHT + 20), (left + 100, HEIGHT + 60), [level] * 3, 2)
    assert packing(pictures) is None


def test_stereo_with_text_over_both_views_is_found() -> None:
    pictures = [beside(number) for number in NUMBERS]
    for view in pictures:
        for left in (10, 10 + WIDTH):
            cv2.putText(view, "PATIENT", (left, HEIGHT // 2), cv2.FONT_HERSHEY_SIMPLEX, 0.8, [255] * 3, 2)
    assert packing(pictures) is not None


def test_a_lumen_is_not_stereo() -> None:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    radius = np.hypot(u - WIDTH / 2, v - HEIGHT / 2)
    light = np.exp(-(((radius - 90) / 60) ** 2)) * (0.8 + 0.2 * np.cos(radius / 7))
    assert packing([(light[..., None] * [220, 120, 90]).astype(np.uint8)] * 3) is None


def test_what_is_too_little_is_not_stereo() -> None:
    assert packing([]) is None
    assert packing([np.full((HEIGHT, WIDTH, 3), 90, np.uint8)]) is None
    assert packing([np.hstack([tissue(n), tissue(n, seed=4)]) for n in NUMBERS]) is None
    assert packing([tissue(0)[:20, :20]]) is None
    assert packing([tissue(0)[:1]]) is None
    # One picture of many that happens to look like two views proves nothing.
    assert packing([beside(0)] + [np.zeros_like(beside(0))] * 9) is None
