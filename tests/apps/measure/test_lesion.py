"""Sizes of a lesion against closed forms, a hemisphere on a plane; masks carried through a drawn tube; the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap.apps.measure.intervals import SIGMAS
from scopemap.apps.measure.lesion import carried_masks, measure_lesion, shaft_width
from scopemap.apps.measure.measure import Known, known_scale
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.geometry.lesion_shape import LesionShape, extents, lesion_shape
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import transform
from scopemap.result.result import Result
from tests.support.drawn_run import CAMERA, FRAMES, draw_run, pose_of, tube
from tests.support.front_door import call, refused

WALL_MM, RADIUS_MM = 40.0, 5.0
WIDE = PinholeCamera(200.0, 200.0, 119.5, 95.5, 240, 192)
RADIUS = 10.0  # of the tube


def hemisphere(aside_mm: float, lean: float) -> tuple[np.ndarray, np.ndarray]:
    """Mask and depth of half a ball on a plane, seen at an angle, rad."""
    normal = np.array([np.sin(lean), 0, -np.cos(lean)])
    middle = np.array([aside_mm, 0, WALL_MM])
    rays = WIDE.rays.astype(np.float64)
    wall = (middle @ normal) / (rays @ normal)
    a, b, c = (rays**2).sum(-1), rays @ middle, middle @ middle - RADIUS_MM**2
    ball = (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    seen = (b**2 > a * c) & ((rays * ball[..., None] - middle) @ normal > 0)
    return seen, np.where(seen, ball, wall)


def shape(mask: np.ndarray, depth_mm: np.ndarray, camera: PinholeCamera = WIDE) -> LesionShape:
    found = lesion_shape(mask, depth_mm, camera)
    assert found is not None
    return found


@pytest.mark.parametrize("aside_mm", [0.0, 8.0])
def test_a_hemisphere_from_above(aside_mm: float) -> None:
    found = shape(*hemisphere(aside_mm, 0.0))
    # Beside its outline depth is what is farther inside, so nearer.
    assert found.diameter == pytest.approx(2 * RADIUS_MM, rel=0.06)
    assert found.cross == pytest.approx(2 * RADIUS_MM, rel=0.06)
    assert found.along == pytest.approx(np.pi * RADIUS_MM, rel=0.05)
    assert found.area == pytest.approx(2 * np.pi * RADIUS_MM**2, rel=0.08)
    assert found.height == pytest.approx(RADIUS_MM, rel=0.05)
    assert found.facing == pytest.approx(np.cos(np.arctan(aside_mm / WALL_MM)), abs=0.02)


def test_a_slanted_view_is_less_certain() -> None:
    above, slanted = shape(*hemisphere(0.0, 0.0)), shape(*hemisphere(0.0, 0.8))
    # What stands out is taken to be smaller than it looks, for depth of a network is too smooth; this one is exact.
    assert 0.85 * above.diameter < slanted.diameter < 0.97 * above.diameter
    assert slanted.height == pytest.approx(RADIUS_MM, rel=0.1)
    assert slanted.facing < above.facing
    disc = np.hypot(*np.moveaxis(WIDE.rays[..., :2], -1, 0)) < 0.1
    level, steep = (shape(disc, WALL_MM / (1 + lean * WIDE.rays[..., 0])) for lean in (0.0, 1.5))
    assert level.sigma < 0.01 < steep.sigma
    assert level.diameter == pytest.approx(0.2 * WALL_MM, rel=0.012)


def test_extents_of_a_box_are_its_diagonal_and_what_is_across_it() -> None:
    corners = np.array([[x, y, 7.0] for x in (0, 3) for y in (0, 4)])
    assert extents(corners) == pytest.approx((5.0, 2 * 12 / 5), rel=1e-6)
    assert extents(corners[:2]) == (0.0, 0.0)


def test_what_is_behind_an_outline_does_not_count() -> None:
    mask, depth_mm = hemisphere(0.0, 0.0)
    exact = shape(mask, depth_mm).diameter
    rim = mask & ~(cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) > 0)
    assert shape(mask, np.where(rim, 80.0, depth_mm)).diameter == pytest.approx(exact, rel=0.02)
    assert lesion_shape(mask, np.where(mask, np.nan, depth_mm), WIDE) is None


def test_the_width_of_a_shaft_is_that_beside_its_tip(tmp_path: Path) -> None:
    run, mask = draw_run(tmp_path / "run"), np.zeros((64, 80), np.uint8)
    cv2.line(mask, (79, 10), (40, 30), 255, 8)
    cv2.circle(mask, (75, 10), 9, 255, -1)  # wider where it enters
    cv2.imwrite(str(tmp_path / "shaft.png"), mask)
    ends = shaft_width(run, tmp_path / "shaft.png")
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(8.5, abs=1.2)
    assert np.linalg.norm(ends.mean(axis=0) - [45, 27]) < 6


# ---- in a tube of radius 10 mm


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scale = {"known": True, "measured": True, "source": "measured depth"}
    return draw_run(tmp_path_factory.mktemp("lesion") / "run", scale=scale)


@pytest.fixture(scope="module")
def unknown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_run(tmp_path_factory.mktemp("lesion") / "run")


def patch(index: int) -> np.ndarray:
    """Which pixels of a frame show a patch of the wall, 6 mm along the tube and 8 mm around it."""
    seen = render_mesh(tube(), CAMERA, pose_of(index)).depth_mm
    points = transform(pose_of(index), (CAMERA.rays * seen[..., None]).reshape(-1, 3).astype(float))
    angle = np.arctan2(points[:, 1], points[:, 0])
    inside = (np.abs(angle - 1.2) < 0.4) & (points[:, 2] > 22) & (points[:, 2] < 28)
    return np.asarray(inside.reshape(seen.shape))


def masks_of(folder: Path, frames: range) -> Path:
    folder.mkdir()
    for index in frames:
        cv2.imwrite(str(folder / f"mask_{index:04d}.png"), 255 * patch(index).astype(np.uint8))
    return folder


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_a_reference_beside_the_lesion_errs_less_than_its_frame(unknown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.apps.measure.measure._depth_errors", lambda *of: np.full(2, 0.1))
    scale = known_scale(Result(unknown), Known(0, np.array([[10.0, 20], [10, 44]]), 5.0))
    of_frame, of_views = (np.log(changes.factors[1]) / SIGMAS for changes in (scale.changes, scale.from_views))
    picking = np.sqrt(2) / 24
    assert 0.99 * np.hypot(picking, 0.3 * 0.1 / np.sqrt(2)) < of_views < 0.07 < of_frame


def test_a_mask_is_carried_to_the_other_frames(known: Path) -> None:
    run = Result(known)
    carried = carried_masks(run, 2, patch(2))
    assert len(carried) >= 8
    for index in (0, 5, 8):
        assert overlap(carried[index], patch(index)) > 0.82
    assert (carried[2] == patch(2)).all()


def test_frames_to_which_a_part_is_carried_do_not_count(known: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = {n: patch(n) & (np.cumsum(patch(n).any(axis=0)) <= 5) for n in (0, 1)}
    monkeypatch.setattr("scopemap.apps.measure.lesion.carried_masks", lambda *of: part | {2: patch(2)})
    monkeypatch.setattr("scopemap.apps.measure.lesion._LEAST_PX", 20)
    found = measure_lesion(known, patch(2), 2)
    assert list(found.masks) == [2]


def test_what_is_in_front_ends_a_mask(known: Path) -> None:
    run = Result(known)
    file = known / "depth" / "000005.png"
    kept = file.read_bytes()
    near = np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) // 3
    cv2.imwrite(str(file), near)
    try:
        assert 5 not in carried_masks(run, 2, patch(2))
    finally:
        file.write_bytes(kept)


def measured(capfd: pytest.CaptureFixture[str], run: Path, *more: object) -> dict[str, Any]:
    capfd.readouterr()
    assert call("measure", run, "--json", *more) == 0
    return dict(json.loads(capfd.readouterr().out))


def test_a_patch_of_the_tube(known: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = masks_of(tmp_path / "masks", range(12))
    exact = {"area": 48.0, "largest diameter": np.hypot(6, 2 * RADIUS * np.sin(0.4))}
    ways = [("--lesion", folder), ("--lesion", folder / "mask_0003.png", "--frame", 3)]
    for way in ways:
        found = measured(capfd, known, *way, "--pictures", tmp_path / "outlines")
        assert "measured depth" in found["scale"]
        sizes = {one["what"]: one for one in found["measures"]}
        for what, true in exact.items():
            assert sizes[what]["value"] == pytest.approx(true, rel=0.3 if what == "area" else 0.15), what
            assert sizes[what]["low"] < true < sizes[what]["high"]
        assert sizes["largest diameter"]["unit"] == "mm"
        assert sizes["height"]["low"] <= sizes["height"]["value"] < 2
    assert list((tmp_path / "outlines").glob("*.jpg"))
    assert measured(capfd, known, "--lesion", folder / "mask_0003.png", "--second", 3.2 / 25) == found


@pytest.mark.parametrize("second", [-1.0, 40.0])
def test_a_time_that_the_result_does_not_show_is_refused(
    second: float, known: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The nearest frame may be minutes away, where only a part of the video was run."""
    mask = masks_of(tmp_path / "masks", range(3, 4)) / "mask_0003.png"
    for what in (("--lesion", mask), ("--points", "10,10 20,10")):
        said = refused(capfd, "measure", known, *what, "--second", second)
        assert f"no frame with a pose is at {second:g} s" in said


def test_points_are_measured_at_a_time(known: Path, capfd: pytest.CaptureFixture[str]) -> None:
    printed = []
    for time in (("--second", 3 / 25), ("--frame", 3)):
        capfd.readouterr()
        assert call("measure", known, "--points", "30,40 50,40", *time) == 0
        printed.append(capfd.readouterr().out)
    assert printed[0] == printed[1]


def test_many_frames_do_not_make_an_interval_vanish(known: Path, tmp_path: Path) -> None:
    def half(frames: range) -> float:
        one = measure_lesion(known, masks_of(tmp_path / str(len(frames)), frames)).measures[0]
        return (one.high - one.low) / 2 / one.value

    assert half(range(12)) > 0.8 * half(range(2, 3)) > 0.1


def test_an_unknown_scale_gives_no_bare_number(
    unknown: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = masks_of(tmp_path / "masks", range(12))
    assert "give two points as a reference" in refused(capfd, "measure", unknown, "--lesion", folder)
    ends = CAMERA.project(np.array([[RADIUS * np.cos(a), RADIUS * np.sin(a), 25.0] for a in (2.2, 3.2)]))
    pair = " ".join(f"{x:.4f},{y:.4f}" for x, y in ends)
    reference = ("--reference", pair, "--reference-frame", 0)
    ratio = measured(capfd, unknown, "--lesion", folder, *reference)
    mm = measured(capfd, unknown, "--lesion", folder, *reference, "--reference-mm", 2 * RADIUS * np.sin(0.5))
    assert ratio["measures"][0]["unit"] == "times the reference"
    assert "frame 0, taken to be 9.58851 mm apart" in mm["scale"]
    assert mm["measures"][0]["value"] == pytest.approx(9.8, rel=0.15)
    assert mm["measures"][0]["value"] == pytest.approx(2 * RADIUS * np.sin(0.5) * ratio["measures"][0]["value"])
    assert call("measure", unknown, "--lesion", folder, *reference) == 0
    assert "the scale rests on two points of frame 0" in capfd.readouterr().out


def test_what_cannot_be_measured_is_refused(known: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def said(*words: object) -> str:
        return refused(capfd, "measure", known, *words)

    outline = "20,20 40,20 40,40"
    assert "has no pose" in said("--lesion", outline, "--frame", FRAMES - 1)
    assert "2 corners" in said("--lesion", "20,20 40,20", "--frame", 0)
    assert "needs its frame" in said("--lesion", outline)
    assert "no surface where frame 0" in said("--lesion", "300,300 310,300 310,310", "--frame", 0)
    short = ("--reference", "20,20 24,20", "--reference-mm", 3)
    assert "the reference is 4.0 px long: 10 px are needed" in said("--lesion", outline, "--frame", 0, *short)
    cv2.imwrite(str(tmp_path / "large.png"), np.full((300, 200), 255, np.uint8))
    assert "200x300" in said("--lesion", tmp_path / "large.png", "--frame", 0)
    (tmp_path / "text.png").write_text("no picture")
    assert "is no image" in said("--lesion", tmp_path / "text.png", "--frame", 0)
    assert "no mask" in said("--lesion", masks_of(tmp_path / "late", range(FRAMES - 1, FRAMES)))
    assert "sees the whole lesion" in said("--lesion", "0,0 79,0 79,63 0,63", "--frame", 0)
    assert "needs its two points" in said("--lesion", outline, "--frame", 0, "--reference-mm", 3)
    for words in (["--frame", 0], ["--lesion", outline, "--points", outline], ["--points", outline]):
        assert call("measure", known, *words) == 2
    for words in (["--reference", "1,1"], ["--reference", "1,1 2,2", "--reference-mask", "x"]):
        assert call("measure", known, "--lesion", outline, "--frame", 0, *words) == 2


def test_masks_named_by_times_are_refused(known: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """0.001 was taken for frame 1."""
    (tmp_path / "masks").mkdir()
    for name in ("0.001", "0.002"):
        cv2.imwrite(str(tmp_path / f"masks/mask_{name}.png"), 255 * patch(2).astype(np.uint8))
    said = refused(capfd, "measure", known, "--lesion", tmp_path / "masks")
    assert "end in decimal numbers, such as mask_0.001.png" in said
