"""Free-space evidence, on a wall with an instrument, a fold and a flap in front of it, in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.free_space import FreeSpace, reference_frames
from scopemap.engine.geometry.se3 import se3, so3_exp
from tests.support.tiny_phantom import FRAMES, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(150.0, 150.0, 119.5, 89.5, 240, 180)
WALL_MM, FRONT_MM, WIDTH_MM = 60.0, 40.0, 12.0
RED, PALE, GREY = (150, 60, 50), (200, 170, 120), (120, 120, 125)
COUNT = 24


def _frame(index: int, left_mm: float, colour: tuple[int, int, int], pose_error_rad: float = 0.0) -> Frame:
    """A wall seen by a camera that moves sideways, and a strip in front that begins at `left_mm` in the world."""
    x_mm = 0.4 * index
    rays = CAMERA.rays.astype(np.float64)
    on_strip_mm = x_mm + FRONT_MM * rays[..., 0] - left_mm
    strip = (on_strip_mm >= 0) & (on_strip_mm < WIDTH_MM)
    depth_mm = np.where(strip, FRONT_MM, WALL_MM).astype(np.float32)
    noise = np.random.default_rng(index).integers(-3, 4, (*strip.shape, 3))
    rgb = (np.where(strip[..., None], colour, RED) + noise).astype(np.uint8)
    pose = se3(so3_exp(np.array([0.0, pose_error_rad * (-1) ** index, 0.0])), np.array([x_mm, 0.0, 0.0]))
    return Frame(index, index / 30, rgb, CAMERA, np.ones(strip.shape, bool), depth_mm, pose, highlights=~strip & False)


def _shares(frames: list[Frame]) -> tuple[float, float]:
    """Return which shares of the strip and of the wall are left out."""
    free_space = FreeSpace(frames[place] for place in reference_frames(range(len(frames))))
    kept = np.array([free_space.without(frame).valid for frame in frames])
    front = np.array([frame.depth_mm for frame in frames]) < WALL_MM
    return float((~kept[front]).mean()), float((~kept[~front]).mean())


def _passing(colour: tuple[int, int, int]) -> list[Frame]:
    """Frames in which the strip passes from the left to the right."""
    return [_frame(index, -30.0 + 3.0 * index, colour) for index in range(COUNT)]


def test_an_instrument_is_left_out_and_the_wall_is_kept() -> None:
    tool, wall = _shares(_passing(GREY))
    # At the border of the picture, where the instrument leaves it, too few other frames see what is behind.
    assert tool > 0.93
    # One cell around the instrument, an eleventh of its width.
    assert wall < 0.05


def test_a_highlight_on_an_instrument_is_left_out_too() -> None:
    frames = _passing(GREY)
    free_space, seen = FreeSpace(frames), frames[COUNT // 2]
    strip = np.asarray(seen.depth_mm) < WALL_MM
    left = free_space.without(replace(seen, valid=~strip, highlights=strip))
    assert left.highlights is not None
    assert left.highlights.sum() < 0.03 * strip.sum()


def test_pixels_next_to_instruments_of_the_network_are_left_out() -> None:
    frame = _frame(0, 90.0, GREY)
    found = np.zeros_like(frame.valid)
    found[60:120, 100:160] = True
    left = FreeSpace([frame]).without(replace(frame, valid=~found, instruments=found)).valid
    assert not left[56:124, 96:164].any()
    assert left.sum() > left.size - 76 * 76


def test_tissue_that_moves_has_its_colour_and_is_kept() -> None:
    assert _shares(_passing(RED)) == (0.0, 0.0)


@pytest.mark.parametrize("error_rad", [0.0, 0.02], ids=["true poses", "poses off by 3 px"])
def test_the_edge_of_a_fold_of_another_colour_is_kept(error_rad: float) -> None:
    assert _shares([_frame(index, -4.0, PALE, error_rad) for index in range(COUNT)]) == (0.0, 0.0)


def test_one_frame_alone_contradicts_nothing() -> None:
    assert _shares([_frame(0, 0.0, GREY), _frame(1, 30.0, GREY)]) == (0.0, 0.0)


def test_what_stays_in_most_frames_is_no_instrument_that_passes() -> None:
    frames = [_frame(index, -4.0 if index % 4 else 90.0, GREY) for index in range(COUNT)]
    assert _shares(frames)[0] == 0.0


def test_depths_that_differ_in_scale_contradict_nothing_by_themselves() -> None:
    frames = [_frame(index, -4.0, PALE) for index in range(COUNT)]
    factors = np.random.default_rng(1).uniform(0.8, 1.2, (COUNT, 1, 1)).astype(np.float32)
    depths_mm = np.array([frame.depth_mm for frame in frames]) * factors
    free_space = FreeSpace(replace(f, depth_mm=mm) for f, mm in zip(frames, depths_mm, strict=True))
    for frame, depth_mm in zip(frames, depths_mm, strict=True):
        assert free_space.without(replace(frame, depth_mm=depth_mm)).valid.all()
    assert free_space.notice is None


def test_views_are_spread_and_their_number_is_bounded() -> None:
    assert reference_frames(range(10)) == list(range(10))
    some = reference_frames(range(100_000))
    assert len(some) == 256
    assert (some[0], some[-1]) == (0, 99_999)


@pytest.mark.parametrize(
    ("preset", "method"), [("default", "scopemap"), ("default", "no-free-space"), ("realtime", "scopemap")]
)
def test_a_run_fuses_no_instrument_and_says_so(tmp_path: Path, preset: str, method: str) -> None:
    folder = write_tiny(tmp_path / "phantom")
    for index in range(FRAMES):
        columns = slice(15 * index, 15 * index + 20)
        for name, factor in (("color.png", None), ("depth.tiff", 0.6)):
            file = str(folder / f"{index:04d}_{name}")
            picture = cv2.imread(file, cv2.IMREAD_UNCHANGED)
            picture[40:90, columns] = 110 if factor is None else factor * picture[40:90, columns]
            cv2.imwrite(file, picture)
    config = with_true_depth(folder, preset, fusion__method=method)
    result = reconstruct(open_sequence(folder, settings=config.input), config)
    said = [notice for notice in result.provenance["notices"] if notice["code"] == "fusion-free-space"]
    assert len(said) == (method == "scopemap")
    if said:
        assert said[0]["values"]["frames"] >= FRAMES - 2
        assert 0.02 < said[0]["values"]["share"] < 0.12
