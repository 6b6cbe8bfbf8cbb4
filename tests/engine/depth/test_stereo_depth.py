"""Depth from two views: closed forms, the left-right check, calibrations of a pair, inputs, a phantom, errors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.cameras.rectification import StereoPair, working_camera
from scopemap.engine.config import Config, InputSettings
from scopemap.engine.depth.stereo import StereoDepth, disparity_of
from scopemap.engine.errors import CalibrationError, InputError, SettingsError
from scopemap.engine.frame import Frame
from scopemap.input.camera_files.pair import read_pair
from scopemap.input.opening import open_sequence
from scopemap.runner.depth_backends import create_depth
from scopemap.runner.reconstruct import reconstruct
from scopemap_bench.phantom.spec import PhantomSpec
from tests.support.drawn_inputs import save, write_c3vd
from tests.support.drawn_pairs import (
    BENT,
    HEIGHT,
    LEFT,
    T_BENT,
    WIDTH,
    beside,
    plane_depth_mm,
    view,
    write_kalibr,
    write_opencv,
    write_scared,
    write_stereo_phantom,
)

pytestmark = pytest.mark.slow

PAIR = StereoPair(LEFT, LEFT, beside(), "")
BENT_PAIR = StereoPair(LEFT, BENT, T_BENT, "")
SIZE = (WIDTH, HEIGHT)
FRONTAL = np.array([0.0, 0.0, 1.0]), 60.0  # at 20 px of disparity
SLANTED = np.array([0.25, -0.3, 1.0]), 55.0
USE = InputSettings(stereo="use")


def _frame(camera: PinholeCamera, views: tuple[np.ndarray, np.ndarray] | None) -> Frame:
    size = (camera.height, camera.width)
    return Frame(0, 0.0, np.zeros((*size, 3), np.uint8), camera, np.ones(size, bool), views=views)


@pytest.mark.parametrize("width", [WIDTH, WIDTH // 2])
@pytest.mark.parametrize(
    ("pair", "plane"), [(PAIR, FRONTAL), (PAIR, SLANTED), (BENT_PAIR, FRONTAL), (BENT_PAIR, SLANTED)]
)
def test_a_plane_is_where_it_is(pair: StereoPair, plane: tuple[np.ndarray, float], width: int) -> None:
    camera = working_camera(pair.left, (width, width * HEIGHT // WIDTH))
    views = view(pair.left, np.eye(4), plane), view(pair.right, pair.T_right_left, plane)
    estimate = StereoDepth(pair, camera).estimate(_frame(camera, views))
    assert estimate.kind == "measured"
    assert estimate.values.dtype == np.float32
    known = np.isfinite(estimate.values)
    assert known.mean() > 0.8
    error = estimate.values[known] / plane_depth_mm(camera, np.eye(4), plane)[known] - 1
    assert np.abs(error).mean() < 0.01
    assert abs(np.median(error)) < (1e-4 if (pair, plane[1]) == (PAIR, 60.0) else 0.004)


def test_what_the_other_view_does_not_show_is_unknown() -> None:
    near, far = ((np.array([0.0, 0.0, 1.0]), mm) for mm in (30.0, 60.0))  # 40 and 20 px
    left, right = (view(LEFT, T, far)[..., 0] for T in (np.eye(4), beside()))
    left[:, 150:200], right[:, 110:160] = (view(LEFT, T, near)[:, c, 0] for T, c in (
        (np.eye(4), slice(150, 200)), (beside(), slice(110, 160))))  # fmt: skip
    found = disparity_of(left, right, 80)
    # The strip hides what is up to 20 px left of it from the right view; the left margin is out of its picture.
    assert np.isfinite(found[:, 134:146]).mean() < 0.1
    assert not np.isfinite(found[:, :18]).any()
    assert np.nanmedian(found[:, 158:192]) == pytest.approx(40, abs=0.1)
    assert np.nanmedian(found[:, 40:120]) == pytest.approx(20, abs=0.1)
    assert np.isfinite(found[:, 158:192]).mean() > 0.9
    assert not np.isfinite(disparity_of(left, np.full_like(right, 90), 80)).any()


def test_a_frame_without_its_second_view_has_no_depth() -> None:
    estimate = StereoDepth(PAIR, LEFT).estimate(_frame(LEFT, None))
    assert np.isnan(estimate.values).all()


# ---- calibrations


def _written(folder: Path, form: str) -> Path:
    if form == "scared.json":
        return write_scared(folder / form, BENT_PAIR)
    if form == "camchain.yaml":
        return write_kalibr(folder / form, BENT_PAIR)
    if form == "intrinsics.yml":
        write_opencv(folder / "extrinsics.yml", BENT_PAIR, "- - - - R T")
        return write_opencv(folder / form, BENT_PAIR, "M1 D1 M2 D2")
    names = {"scared.yaml": "M1 D1 M2 D2 R T", "named.yml": "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T"}
    return write_opencv(
        folder / form, BENT_PAIR, names.get(form, "K1 D1 K2 D2 R T"), 1000.0 if form == "m.yml" else 1.0
    )


@pytest.mark.parametrize(
    "form",
    ["pair.yaml", "pair.xml", "m.yml", "named.yml", "scared.yaml", "intrinsics.yml", "scared.json", "camchain.yaml"],
)
def test_a_pair_is_read_in_every_form(form: str, tmp_path: Path) -> None:
    pair = read_pair(_written(tmp_path, form), SIZE)
    np.testing.assert_allclose(pair.T_right_left, T_BENT, atol=1e-6)
    np.testing.assert_allclose(pair.left.central.matrix, LEFT.matrix, atol=1e-6)
    pixels = np.array([[20.0, 30.0], [300.0, 200.0]])
    np.testing.assert_allclose(pair.right.unproject(pixels), BENT.unproject(pixels), atol=1e-5)
    unit = {"camchain.yaml": "T in m (Kalibr)", "m.yml": "T in m (assumed by its length)"}
    assert unit.get(form, "T in mm (assumed by its length)") in pair.source


def test_a_pair_of_another_size_is_scaled_with_its_images(tmp_path: Path) -> None:
    pair = read_pair(write_kalibr(tmp_path / "c.yaml", BENT_PAIR), (WIDTH // 2, HEIGHT // 2), "scale")
    assert pair.left.central.fx == pytest.approx(LEFT.fx / 2)
    assert pair.right.central.fx == pytest.approx(BENT.central.fx / 2)
    np.testing.assert_allclose(pair.T_right_left, T_BENT, atol=1e-9)


@pytest.mark.parametrize(
    ("pair", "names", "unit_mm", "message"),
    [
        (PAIR, "K D", 1.0, "it is of one camera; depth from two views"),
        (PAIR, "K1 D1 K2 D2", 1.0, "it has no R"),
        (PAIR, "K1 D1 K2 D2 R T", 20.0, "its T is 0.2 long, of no unit that is known: give it in mm"),
        (StereoPair(LEFT, LEFT, np.diag([1.0, 1, 2, 1]) @ beside(), ""), "K1 D1 K2 D2 R T", 1.0, "is no rotation"),
        (StereoPair(LEFT, LEFT, beside(-4), ""), "K1 D1 K2 D2 R T", 1.0, "at x -4.00, .* does not lie to the right"),
    ],
)
def test_what_is_no_pair_is_refused(pair: StereoPair, names: str, unit_mm: float, message: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=message):
        read_pair(write_opencv(tmp_path / "pair.yaml", pair, names, unit_mm), SIZE)


def test_files_that_hold_no_mapping_are_refused(tmp_path: Path) -> None:
    for content in ("300 300 159 127", "{", ""):
        (tmp_path / "c.yaml").write_text(content)
        with pytest.raises(CalibrationError, match="--stereo use"):
            read_pair(tmp_path / "c.yaml", SIZE)


# ---- inputs


def _views(number: int) -> list[np.ndarray]:
    return [np.roll(view(LEFT, T, FRONTAL), 5 * number, axis=0) for T in (np.eye(4), beside())]


def _write_views(folder: Path, kind: str) -> tuple[Path, str]:
    """Three pictures; of two folders the right one lacks the middle one. Return the input and the setting."""
    for number in range(3):
        left, right = _views(number)
        whole = {"use": np.hstack([left, right]), "use:top-bottom": np.vstack([left, right])}.get(kind, left)
        for name in ("views", "right"):
            (folder / name).mkdir(exist_ok=True)
        save(folder / "views" / f"{number}.png", whole)
        if number != 1:
            save(folder / "right" / f"{number}.png", right)
    return folder / "views", kind.replace("FILE", str(folder / "right"))


@pytest.mark.parametrize("kind", ["use", "use:top-bottom", "use:FILE"])
def test_frames_carry_both_views(kind: str, tmp_path: Path) -> None:
    source, stereo = _write_views(tmp_path, kind)
    calibration = write_opencv(tmp_path / "pair.yaml", PAIR)
    sequence = open_sequence(source, camera=calibration, settings=InputSettings(stereo=stereo, redact=((0, 0, 3, 2),)))
    assert any("baseline 4.000 mm, T in mm (assumed" in str(note) for note in sequence.notes)
    for frame in sequence.frames():
        if kind == "use:FILE" and frame.index == 1:
            assert frame.views is None
            continue
        for found, drawn in zip(frame.views or (), _views(frame.index), strict=True):
            assert not found[:2, :3].any() or kind != "use:FILE"
            np.testing.assert_array_equal(found[2:], drawn[2:])
    assert any("3 frames of the left view, 2" in str(w) for w in sequence.warnings) == (kind == "use:FILE")
    one = open_sequence(source, settings=InputSettings(stereo="none" if kind == "use:FILE" else "auto"))
    assert all(frame.views is None for frame in one.frames())


def test_what_is_missing_is_said_in_a_sentence(tmp_path: Path) -> None:
    source, _ = _write_views(tmp_path, "use")
    config = Config.load(settings={"input.stereo": "use"})
    assert config.depth.backend == "stereo"
    assert Config.load(settings={"input.stereo": "use", "depth.backend": "shading"}).depth.backend == "shading"
    with pytest.raises(CalibrationError, match="needs the calibration of the pair: --camera FILE with both"):
        reconstruct(open_sequence(source, settings=USE), config)
    one = write_opencv(tmp_path / "one.yaml", PAIR, "K D")
    with pytest.raises(CalibrationError, match="it is of one camera"):
        reconstruct(open_sequence(source, camera=one, settings=USE), config)
    pair = write_opencv(tmp_path / "pair.yaml", PAIR)
    both = open_sequence(source, camera=pair, settings=USE)
    for settings, used in ((Config().depth, both.pair), (config.depth, None)):
        with pytest.raises(SettingsError, match="go together"):
            create_depth(settings, both.rectifier, "cpu", pair=used)
    with pytest.raises(InputError, match="finds no two views in its pictures; give use:left-right"):
        open_sequence(tmp_path / "right", camera=pair, settings=USE)
    with pytest.raises(InputError, match="the right view's pictures are 320x256 px, the left one's 640x256 px"):
        open_sequence(source, camera=pair, settings=InputSettings(stereo=f"use:{tmp_path / 'right'}"))
    with pytest.raises(InputError, match="'c3vd' defines the view"):
        open_sequence(write_c3vd(tmp_path / "c3vd"), settings=USE)
    with pytest.raises(SettingsError, match=r"input\.stereo"):
        Config.load(settings={"input.stereo": "both"})


# ---- the phantom


def test_a_stereo_phantom_is_measured_in_mm(tmp_path: Path) -> None:
    spec = PhantomSpec(scene="laparoscopy", frames=5, width=480, height=384, fov_deg=70.0, seed=3, speed=3)
    folder = write_stereo_phantom(tmp_path, spec)
    sequence = open_sequence(folder / "views", camera=folder / "pair.yaml", settings=USE)
    result = reconstruct(sequence, Config.load(settings={"input.stereo": "use"}), out=tmp_path / "result")
    scale = {"known": True, "measured": True, "stated": False, "source": "measured depth"}
    assert result.provenance["scale"] == scale
    assert "SGBM" in result.provenance["estimators"]["depth"]
    assert result.provenance["tracked"] == 5
    depth = StereoDepth(sequence.pair, sequence.camera)  # type: ignore[arg-type]
    truth = open_sequence(folder / "truth", size=(sequence.camera.width, sequence.camera.height))
    ratios = []
    for frame, (_, true) in zip(sequence.frames(), truth, strict=True):
        ratio = depth.estimate(frame).values / true.depth_mm  # type: ignore[union-attr]
        ratios.append(ratio[np.isfinite(ratio)])
        assert ratios[-1].size > 0.6 * ratio.size
    ratio = np.concatenate(ratios)
    assert np.abs(ratio - 1).mean() < 0.02
    assert np.median(ratio) == pytest.approx(1, abs=0.01)
    assert cv2.imread(str(next((tmp_path / "result" / "depth").glob("*.png"))), cv2.IMREAD_UNCHANGED).any()
