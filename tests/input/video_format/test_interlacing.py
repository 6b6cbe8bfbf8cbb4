"""Two fields in one picture: motion tells them, texture and noise do not."""

from __future__ import annotations

import re
from itertools import islice, product
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.input.video_format.interlacing import (
    LEAST_COMBING,
    combing,
    deinterlaced,
    fields_alternate,
    is_interlaced,
    is_shortly_after,
)
from tests.support.drawn_clips import tissue
from tests.support.drawn_videos import HEIGHT, WIDTH, woven

NUMBERS = range(0, 40, 5)
C3VD = "endoscopy/c3vd"
PROGRESSIVE = ("endoscopy/hamlyn/rectified01_part/image01", "endoscopy/endonerf/pulling_soft_tissues/images")
VIDEOS = ("colonoscopy_nflba_03", "laparoscopy_rvim", "laparoscopy_endo3r_rgb3")


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
    assert combing(_comb(first, second)) > LEAST_COMBING


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


# ---- two successive pictures


def _moved(picture: np.ndarray, at: float) -> np.ndarray:
    """The picture `at` px further to the right and a third as much down."""
    shift = np.array([[1, 0, at], [0, 1, at / 3]])
    size = picture.shape[1::-1]
    return cv2.warpAffine(picture, shift, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def _striped(picture: np.ndarray, period: float) -> np.ndarray:
    stripes = np.sin(2 * np.pi * np.arange(picture.shape[0]) / period)[:, None, None]
    return np.clip(picture + 25.0 * stripes, 0, 255).astype(np.uint8)


def _glossy(picture: np.ndarray) -> np.ndarray:
    rng, out = np.random.default_rng(5), picture.copy()
    for u, v in rng.integers(0, picture.shape[1::-1], (150, 2)).tolist():
        cv2.ellipse(out, (u, v), (3, 1), float(rng.uniform(0, 180)), 0, 360, (255, 255, 255), -1)
    return out


def _coded(picture: np.ndarray, quality: int) -> np.ndarray:
    jpg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(jpg, cv2.IMREAD_COLOR))


def _doubled(picture: np.ndarray) -> np.ndarray:
    return picture[::2].repeat(2, 0)


def _flickering(picture: np.ndarray) -> np.ndarray:
    out = picture.astype(float)
    out[1::2] *= 1.06
    return np.clip(out, 0, 255).astype(np.uint8)


LOOKS = {
    "plain": lambda rgb: rgb,
    "glossy": _glossy,
    **{f"stripes {period}": lambda rgb, period=period: _striped(rgb, period) for period in (2.05, 2.1, 2.3, 3.0, 5.0)},
}
CODED = {"raw": lambda rgb: rgb, "q80": lambda rgb: _coded(rgb, 80), "q50": lambda rgb: _coded(rgb, 50)}


@pytest.mark.parametrize("look", [*LOOKS, "doubled", "flickering"])
@pytest.mark.parametrize("step_px", [0.0, 1.5, 6.0])
def test_progressive_clips_are_not_interlaced(look: str, step_px: float) -> None:
    shown = {"doubled": _doubled, "flickering": _flickering} | LOOKS
    for scene in range(0, 20, 5):
        # Stripes that stay, as an overlay's or a coder's do, and stripes that move as the tissue does.
        pairs = [
            [shown[look](_moved(tissue(scene), n * step_px)) for n in (1, 2)],
            [_moved(shown[look](tissue(scene)), n * step_px) for n in (1, 2)],
        ]
        for (first, second), (coded, code) in product(pairs, CODED.items()):
            assert not is_interlaced([code(first)], [code(second)]), (scene, coded)


@pytest.mark.parametrize(("look", "step_px"), [("plain", 8.0), ("glossy", 8.0), ("plain", 12.0), ("stripes 5.0", 12.0)])
def test_woven_clips_are_interlaced(look: str, step_px: float) -> None:
    shown = [LOOKS[look](tissue(scene)) for scene in range(0, 40, 5)]
    fields = [[_moved(picture, n * step_px / 2) for picture in shown] for n in range(4)]
    for coded, code in CODED.items():
        for top, bottom in ((0, 1), (1, 0)):
            pictures, later = (
                [code(_comb(*pair)) for pair in zip(fields[at + top], fields[at + bottom], strict=True)]
                for at in (0, 2)
            )
            assert is_interlaced(pictures, later), (coded, top)


def _comb(even: np.ndarray, odd: np.ndarray) -> np.ndarray:
    """Even rows of one picture, odd rows of the other."""
    comb = even.copy()
    comb[1::2] = odd[1::2]
    return comb


def test_slow_motion_is_told_where_coding_leaves_the_combs() -> None:
    fields = [_moved(tissue(3), n / 2) for n in range(4)]
    for one, other in (fields[:2], fields[2:]):
        one[1::2] = other[1::2]
    assert fields_alternate(fields[0], fields[2])
    assert is_shortly_after(fields[0], fields[2])
    assert not is_shortly_after(tissue(0), tissue(16))


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


def _real(path: Path, numbers: list[int]) -> list[np.ndarray]:
    """Pictures of a video, or of a folder's files in the order of their numbers."""
    if not path.is_dir():
        with av.open(str(path)) as video:
            shown = [frame.to_ndarray(format="rgb24") for frame in islice(video.decode(video=0), max(numbers) + 1)]
        return [shown[number] for number in numbers]
    kept = path.glob("*_color.*") if path.parent.name == "c3vd" else path.glob("*.*g")
    files = sorted(kept, key=lambda f: int(re.findall(r"\d+", f.name)[-1]))
    return [cv2.cvtColor(np.asarray(cv2.imread(str(files[number]))), cv2.COLOR_BGR2RGB) for number in numbers]


def _slope(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Motion from a picture's even rows to its odd ones over that to the next picture's even rows, and correlation.

    Measured by dense flow, not as `combing` does, and along the rows: down, the odd rows lie half a row apart.
    """
    fields = (first[::2], first[1::2], second[::2])
    even, odd, later = (cv2.GaussianBlur(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY), (0, 0), 1) for f in fields)
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    within, between = (dis.calc(even, other, np.zeros((*even.shape, 2), np.float32))[..., 0] for other in (odd, later))
    edges = cv2.GaussianBlur(np.abs(cv2.Sobel(even, cv2.CV_32F, 1, 0)), (0, 0), 5)
    told = edges > np.median(edges)
    return float(np.polyfit(between[told], within[told], 1)[0]), float(np.corrcoef(between[told], within[told])[0, 1])


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "numbers", "low", "least"), [("trans_t1_a", (3, 4), 0.4, 0.9), ("trans_t2_a", (29, 30), 0.1, 0.6)]
)
def test_c3vd_is_interlaced(real_data: Path, name: str, numbers: tuple[int, int], low: float, least: float) -> None:
    """The odd rows are half a frame later all over the picture; lossy coding, as of trans_t2_a, blends fields."""
    first, second = _real(real_data / C3VD / name, list(numbers))
    slope, correlation = _slope(first, second)
    assert low < slope < 0.6
    assert correlation > least
    assert combing(first) > 3 * LEAST_COMBING
    assert combing(deinterlaced(first)) < LEAST_COMBING
    assert fields_alternate(first, second)


@pytest.mark.real
@pytest.mark.parametrize("path", [*PROGRESSIVE, *(f"endoscopy/video/{name}.mp4" for name in VIDEOS)])
def test_real_progressive_pictures_are_told_from_woven_ones(real_data: Path, path: str) -> None:
    starts = range(10, 60, 6)
    pictures = _real(real_data / path, [n for start in starts for n in (start, start + 1, start + 3)])
    first, next_, later = pictures[::3], pictures[1::3], pictures[2::3]
    assert max(combing(picture) for picture in first) < LEAST_COMBING
    assert abs(np.median([_slope(*pair)[0] for pair in zip(first, later, strict=True)])) < 0.1
    assert not is_interlaced(first, next_)
    for others in (next_, later):
        for picture, other in zip(first, others, strict=True):
            other[::2] = picture[::2]
        assert is_interlaced(others)
