"""What a frame's picture is worth: less with blur, overexposure, darkness and haze; and that fusion goes by it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from scopemap.engine.config import MaskSettings, TrackingSettings
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.masking.masker import Masker
from scopemap.engine.tracking.sharpness import PictureQuality
from scopemap.engine.tracking.tracker import Tracker
from tests.support import plane_scene
from tests.support.drawn_surfaces import lenient, plane_frame
from tests.support.plane_scene import CAMERA, EVERYWHERE

TISSUE = (0.5 * plane_scene.see(np.eye(4)).rgb * [1.0, 0.6, 0.5] + [90, 30, 20]).astype(np.uint8)


def _blurred(much: float) -> np.ndarray:
    return cv2.GaussianBlur(TISSUE, (0, 0), 0.3 + 3 * much)


def _hazy(much: float) -> np.ndarray:
    return ((1 - 0.8 * much) * TISSUE + 0.8 * much * 170.0).astype(np.uint8)


def _overexposed(much: float) -> np.ndarray:
    rgb = TISSUE.copy()
    rgb[: round(0.8 * much * len(rgb))] = 255
    return rgb


def _dark(much: float) -> np.ndarray:
    rgb = TISSUE.copy()
    rgb[: round(0.8 * much * len(rgb))] = 3
    return rgb


def _after_clear(rgb: np.ndarray) -> float:
    """The quality of a picture, masked as in a run, after ten clear ones."""
    masker, quality = Masker(MaskSettings(method="no-overlays")), PictureQuality()
    frames = [masker(Frame(n, n / 30, shown, CAMERA, EVERYWHERE)) for n, shown in enumerate([TISSUE] * 10 + [rgb])]
    return [quality(frame.rgb, frame.valid) for frame in frames][-1]


@pytest.mark.parametrize("spoilt", [_blurred, _hazy, _overexposed, _dark])
def test_a_picture_is_worth_the_less_the_more_it_is_spoilt(spoilt: Callable[[float], np.ndarray]) -> None:
    found = [_after_clear(spoilt(much)) for much in (0.1, 0.4, 0.7, 1.0)]
    assert all(more < less for less, more in zip([1.0, *found], found, strict=False))
    assert 0.01 <= found[-1] < 0.4


def test_fluid_that_stays_for_two_seconds_is_not_worth_more_in_the_end() -> None:
    quality = PictureQuality()
    clear = [quality(TISSUE, EVERYWHERE) for _ in range(60)]
    fluid = [quality(_blurred(0.5), EVERYWHERE) for _ in range(60)]
    assert min(clear) == 1.0
    assert fluid[-1] == pytest.approx(fluid[0], abs=1e-6)
    assert fluid[0] < 0.6


@pytest.mark.parametrize("noise", [0, 1])
def test_pictures_without_colours_are_worth_as_much_as_others(noise: int) -> None:
    grey, rng = cv2.cvtColor(TISSUE, cv2.COLOR_RGB2GRAY)[..., None], np.random.default_rng(0)
    quality = PictureQuality()
    pictures = [np.clip(grey + rng.integers(-noise, noise + 1, TISSUE.shape), 0, 255).astype(np.uint8) for _ in "abc"]
    assert min(quality(picture, EVERYWHERE) for picture in pictures) > 0.9
    assert quality(cv2.GaussianBlur(pictures[0], (0, 0), 3.0), EVERYWHERE) < 0.7


def test_a_picture_without_a_usable_pixel_has_the_least_worth_and_is_no_measure_for_others() -> None:
    quality = PictureQuality()
    assert [quality(TISSUE, ~EVERYWHERE) for _ in range(3)] == [0.01] * 3
    assert quality(TISSUE, EVERYWHERE) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("weighted", "mean_mm"), [(True, 4 * 0.1 / 3.1), (False, 1.0)])
def test_an_unclear_frame_moves_the_surface_little(weighted: bool, mean_mm: float) -> None:
    """Three frames see the plane where it is; the depth of an unclear one is 4 mm off."""
    settings = lenient(method="scopemap" if weighted else "unweighted")
    volume, ahead = TsdfVolume(settings), np.array([0.0, 0.0, 1.0])
    for _ in range(3):
        volume.integrate(plane_frame(ahead, 50.0))
    volume.integrate(replace(plane_frame(ahead, 54.0), quality=0.1))
    off_mm = volume.extract_mesh().vertices[:, 2] - 50.0
    # It weighs a little less than that, too, because it is farther away.
    assert np.median(off_mm) == pytest.approx(mean_mm, rel=0.1)


@pytest.mark.slow
def test_an_unclear_frame_waits_for_a_clear_one_to_become_the_keyframe_but_not_for_long() -> None:
    assert keyframes([1.0] * 8) == [0, 3, 6]
    assert keyframes([1.0, 1.0, 1.0, 0.5, 0.5, 0.9, 1.0, 1.0]) == [0, 5]
    assert keyframes([1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5]) == [0, 6]


def test_a_camera_at_rest_needs_no_other_keyframe() -> None:
    assert keyframes([1.0] * 8, step_mm=0.02) == [0]


def test_every_nth_frame_is_a_keyframe_in_the_paper() -> None:
    assert keyframes([1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5], step_mm=0.02, keyframes_wait=False) == [0, 3, 6]


def keyframes(qualities: list[float], step_mm: float = 0.5, **settings: bool) -> list[int]:
    """Return the frames that become keyframes, of every third, where the camera moves by `step_mm` a frame."""
    tracker, found = Tracker(TrackingSettings(keyframe_every=3, **settings)), list[int]()
    for n, quality in enumerate(qualities):
        view = plane_scene.see(plane_scene.pose(at_mm=(step_mm * n, 0.0, 0.0)))
        frame = Frame(n, n / 30, view.rgb, CAMERA, EVERYWHERE, view.depth_mm, quality=quality)
        track = tracker.track(frame)
        assert track.status != "lost"
        frame = replace(frame, T_world_camera=track.T_world_camera)
        if track.decision.kind == "new" and tracker.update(frame, track.decision, measured=True):
            found.append(n)
    return found
