"""What `inspect` says of motion, cuts, blur and texture, and what it expects a run to make of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from front_door import call

from scopemap.inspection.inspecting import Inspection, inspect

WIDTH, HEIGHT, FRAMES = 320, 240, 40


def _tissue(seed: int, contrast: float = 1.0) -> np.ndarray:
    """A reddish picture of some texture, larger than a frame."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(size=(900, 2400)).astype(np.float32), (0, 0), 2.0)
    level = 120 + contrast * 35 * noise / noise.std()
    return np.clip(np.stack([0.4 * level, 0.5 * level, level], -1), 20, 250).astype(np.uint8)


def _window(picture: np.ndarray, x: float, blur_px: int = 1) -> np.ndarray:
    x = abs((x + 1800) % 3600 - 1800)  # there and back
    cut = picture[200 : 200 + HEIGHT, round(x) : round(x) + WIDTH]
    return cv2.blur(cut, (blur_px, blur_px))


def _inspected(folder: Path, frames: list[np.ndarray]) -> Inspection:
    folder.mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number:04d}.png"), frame)
    return inspect(folder)


def _codes(found: Inspection) -> set[str]:
    return {finding.code for finding in found.findings}


def test_slow_and_sharp_is_good(tmp_path: Path) -> None:
    picture = _tissue(1)
    found = _inspected(tmp_path / "clip", [_window(picture, 3 * n) for n in range(FRAMES)])
    assert not _codes(found) & {"motion-fast", "unlike", "cut", "soft", "texture-low"}
    assert found.forecast.startswith("good: ")
    assert found.facts["motion_per_frame_share"] == pytest.approx(3 / WIDTH, rel=0.2)


def test_fast_motion_is_a_poor_forecast(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    picture = _tissue(2)
    found = _inspected(tmp_path / "clip", [_window(picture, 45 * n, blur_px=5) for n in range(FRAMES)])
    assert "motion-fast" in _codes(found) or "unlike" in _codes(found)
    assert found.forecast.startswith("poor: ")
    assert "separate maps" in found.forecast
    assert call("inspect", tmp_path / "clip", "--out", tmp_path / "seen.png") == 0
    said = capfd.readouterr().out
    assert f"forecast: {found.forecast}" in said
    assert "no problem was found" not in said


def test_a_cut_is_found_where_it_is(tmp_path: Path) -> None:
    one, other = _tissue(3), _tissue(4)
    shown = [_window(one if n < 17 else other, 3 * n) for n in range(FRAMES)]
    found = _inspected(tmp_path / "clip", shown)
    (cut,) = (finding for finding in found.findings if finding.code == "cut")
    assert cut.segments == ((17, 17),)
    assert "--frames 17:" in cut.advice or "--frames 18:" in cut.advice
    assert found.forecast.startswith("fair: ")
    assert "1 cut;" in found.forecast


def test_soft_frames_are_told(tmp_path: Path) -> None:
    picture = _tissue(5)
    shown = [_window(picture, 3 * n, blur_px=9 if 10 <= n < 16 else 1) for n in range(FRAMES)]
    found = _inspected(tmp_path / "clip", shown)
    (soft,) = (finding for finding in found.findings if finding.code == "soft")
    assert soft.segments == ((10, 15),)


def test_walls_without_texture_are_told(tmp_path: Path) -> None:
    ramp = np.linspace(60, 200, 2400)[None, :, None] * np.array([0.4, 0.5, 1.0]) * np.ones((900, 1, 1))
    found = _inspected(tmp_path / "clip", [_window(ramp.astype(np.uint8), 3 * n) for n in range(FRAMES)])
    assert "texture-low" in _codes(found)
    assert found.forecast.startswith("poor: walls without texture")


def test_every_tenth_frame_is_said_to_be_no_more(tmp_path: Path) -> None:
    picture = _tissue(6)
    folder = tmp_path / "clip"
    _inspected(folder, [_window(picture, 3 * n) for n in range(FRAMES)])
    assert inspect(folder, frames=slice(None, None, 10)).forecast.startswith("of one frame in 10: ")
