"""Frames one at a time: the same results as by a run, own depth and own flow, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scopemap import Config, CustomDepth, Reconstructor, Result, open_sequence, reconstruct
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.finish import finished
from scopemap.runner.provenance import Limits
from tests.support.front_door import warned
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(100.0, 100.0, 79.5, 63.5, 160, 128)
FRAMES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("steps") / "phantom", frames=FRAMES)


def _assert_equal(one: Result, other: Result) -> None:
    np.testing.assert_array_equal(one.trajectory.T_world_camera, other.trajectory.T_world_camera)
    np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
    np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
    np.testing.assert_array_equal(one.trajectory.status, other.trajectory.status)


@pytest.mark.parametrize("preset", ["default", "realtime"])
def test_stepping_gives_what_a_run_gives(preset: Any, folder: Path) -> None:
    config = Config.load(preset, settings={"tracking.keyframe_every": 2})
    by_run = reconstruct(open_sequence(folder), config)
    with Reconstructor(config, open_sequence(folder)) as one:
        steps = [one.step(frame) for frame in one.frames()]
        one_by_one = one.result()
    _assert_equal(one_by_one, by_run)
    overlapping = Reconstructor(config, open_sequence(folder))
    for step, alone in zip(overlapping.steps(overlapping.frames(), ahead=1), steps, strict=True):
        np.testing.assert_array_equal(step.frame.depth_mm, alone.frame.depth_mm)
    _assert_equal(overlapping.result(), by_run)


def test_a_pose_does_not_wait_for_the_surface(folder: Path) -> None:
    with Reconstructor("realtime", open_sequence(folder)) as one:
        faces: list[int] = []
        for _ in one.steps(one.frames(), posed=lambda step: faces.append(len(one.surface().faces))):
            faces.append(len(one.surface().faces))
    assert faces[0] == 0  # posed
    assert faces[1] > 0  # fused


def _pictures(folder: Path) -> list[np.ndarray]:
    return [cv2.imread(str(file))[..., ::-1] for file in sorted(folder.glob("*_color.png"))]


def test_pictures_with_a_camera_are_what_a_sequence_is(folder: Path) -> None:
    sequence = open_sequence(folder)
    config = Config.load("realtime")
    by_run = reconstruct(sequence, config)
    one = Reconstructor(config, sequence.rectifier.source)
    assert one.camera == sequence.camera
    for picture in _pictures(folder):
        one.step(picture)
    assert len(one.surface().faces) > 100  # as tracked
    final: list[Frame] = []
    found = one.result(final.append)
    poses = np.stack([np.asarray(frame.T_world_camera) for frame in final])
    np.testing.assert_array_equal(poses, found.trajectory.T_world_camera)
    np.testing.assert_array_equal(found.trajectory.T_world_camera, by_run.trajectory.T_world_camera)
    assert found.provenance["camera"]["source"] == "given"


def test_a_step_holds_pose_depth_and_points(folder: Path) -> None:
    one = Reconstructor(Config.load("realtime"), CAMERA)
    first, second = (one.step(picture) for picture in _pictures(folder)[:2])
    assert (first.track.status, second.track.status) == ("initial", "ok")
    points, colours = second.frame.point_cloud()
    assert points.shape == colours.shape == (np.count_nonzero(second.frame.valid & (second.frame.depth_mm > 0)), 3)
    pixel = CAMERA.project((points - second.frame.T_world_camera[:3, 3]) @ second.frame.T_world_camera[:3, :3])
    row, column = np.round(pixel[17]).astype(int)[::-1]
    np.testing.assert_array_equal(second.frame.rgb[row, column], colours[17])
    assert len(Frame(0, 0.0, second.frame.rgb, CAMERA, second.frame.valid).point_cloud()[0]) == 0


def _flat(rgb: np.ndarray) -> np.ndarray:
    return np.full(rgb.shape[:2], 40.0)


def test_own_depth_and_flow_replace_those_of_the_settings(folder: Path) -> None:
    shifts = []

    def flow(rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        shifts.append(1)
        return np.zeros((*rgb_from.shape[:2], 2))

    pictures = _pictures(folder)[:2]
    one = Reconstructor(Config.load("realtime"), CAMERA, depth=CustomDepth(_flat, "measured", "flat"), flow=flow)
    steps = [one.step(picture) for picture in pictures]
    np.testing.assert_array_equal(steps[0].raw_mm, np.float32(40))
    assert steps[0].raw_mm.shape == (128, 160)
    facts = one.result().provenance
    assert facts["estimators"]["depth"] == "flat (measured, a function of the caller)"
    assert facts["estimators"]["keyframe_flow"] == "own"
    assert facts["scale"]["known"]
    assert not shifts  # measured depth is tracked by itself
    predicted = Reconstructor(Config.load("realtime"), CAMERA, depth=CustomDepth(_flat, "metric"), flow=flow)
    for picture in pictures:
        predicted.step(picture)
    assert shifts
    assert not predicted.result().provenance["scale"]["known"]


def test_kinds_of_own_depth_mean_different_scales(folder: Path) -> None:
    picture = _pictures(folder)[0]
    config = Config.load(settings={"depth.near_far_mm": [20, 80]})
    ramp = np.tile(np.linspace(1, 4, 160), (128, 1))
    by_range = Reconstructor(config, CAMERA, depth=CustomDepth(lambda rgb: ramp, "disparity")).step(picture).raw_mm
    assert np.nanpercentile(by_range, [2, 98]) == pytest.approx([20, 80], rel=0.2)
    assert by_range[64, 5] > by_range[64, 150]
    own_mm = Reconstructor(None, CAMERA, depth=CustomDepth(lambda rgb: 10 * ramp, "metric")).step(picture).raw_mm
    np.testing.assert_allclose(own_mm, 10 * ramp, rtol=1e-6)


@pytest.mark.parametrize(
    ("function", "fault"),
    [
        (lambda rgb: np.ones((3, 3)), r"shape \(128, 160\), got \(3, 3\)"),
        (lambda rgb: np.ones(rgb.shape[:2], np.uint8), "expected floats with NaN for unknown, got uint8"),
        (lambda rgb: np.full(rgb.shape[:2], np.inf), "infinite or negative"),
    ],
)
def test_what_own_depth_returns_is_checked(function: Callable[[np.ndarray], np.ndarray], fault: str) -> None:
    one = Reconstructor(None, CAMERA, depth=CustomDepth(function, "metric"))
    tissue = np.random.default_rng(0).integers([120, 50, 40], [180, 90, 80], (128, 160, 3)).astype(np.uint8)
    with pytest.raises(InputError, match=fault):
        one.step(tissue)
    two = Reconstructor(None, CAMERA, flow=lambda a, b: np.zeros((2, 2, 2)))
    with pytest.raises(InputError, match="custom flow: expected floats of shape"):
        [two.step(tissue + step) for step in range(3)]


def test_own_parts_without_a_kind_or_a_function_are_refused() -> None:
    with pytest.raises(SettingsError, match="of kind 'depth': choose one of disparity, metric, measured"):
        CustomDepth(_flat, "depth")  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="state the kind"):
        Reconstructor(None, CAMERA, depth=_flat)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="expected a function of two pictures, got str"):
        Reconstructor(None, CAMERA, flow="dis")  # type: ignore[arg-type]


def test_pictures_that_do_not_fit_are_refused() -> None:
    one, black = Reconstructor(Config.load("realtime"), CAMERA), np.zeros((128, 160, 3), np.uint8)
    with pytest.raises(ValueError, match=r"expected a picture \(h, w, 3\) uint8, got float64"):
        one.step(black.astype(float))
    with pytest.raises(ValueError, match="image: expected an array of shape"):
        one.step(np.zeros((64, 64, 3), np.uint8))
    assert one.step(black, time_s=2.5, index=7).frame.time_s == 2.5
    with pytest.raises(ValueError, match="frame 7 after frame 7"):
        one.step(black, index=7)
    with pytest.raises(ValueError, match="another camera"):
        one.step(Frame(9, 0.0, np.zeros((64, 64, 3), np.uint8), CAMERA.resized(64, 64), np.ones((64, 64), bool)))
    with pytest.raises(InputError, match="no frame of pictures could be used"):
        one.result()
    with pytest.raises(ValueError, match="closed"):
        one.step(black)


def test_beyond_the_limit_of_stored_frames_the_result_is_what_was_shown(folder: Path) -> None:
    config = Config.load("realtime", settings={"tracking.keyframe_every": 2})
    codes = {}
    for stored in (FRAMES, FRAMES - 1):
        one = Reconstructor(config, open_sequence(folder), limits=Limits(stored=stored))
        steps = [one.step(frame) for frame in one.frames()]
        shown, result = one.surface(), one.result()
        tracked = np.stack([np.asarray(step.frame.T_world_camera) for step in steps])
        is_shown = np.array_equal(result.trajectory.T_world_camera, tracked)
        assert is_shown == (stored < FRAMES)
        bounds = finished(shown, result.config.fusion).bounds
        assert np.allclose(bounds, result.mesh.bounds, rtol=0, atol=1e-3) == is_shown
        assert result.provenance["surface"]["frames"] > 0
        codes[stored] = {notice["code"] for notice in result.provenance["notices"]}
    assert "mapping-adjusted" in codes[FRAMES]
    assert {code for code in codes[FRAMES - 1] if code.startswith("mapping")} == {"mapping-local"}
    by_run = reconstruct(open_sequence(folder), config)
    assert "mapping-local" not in {notice["code"] for notice in by_run.provenance["notices"]}


def test_limits_bound_what_is_kept(folder: Path) -> None:
    config = Config.load("realtime", settings={"fusion.every": 1})
    one = Reconstructor(config, open_sequence(folder), limits=Limits(frames=4, maps=1, blocks=1))
    steps = [one.step(frame) for frame in one.frames()]
    assert one.surface_is_full
    faces = len(one.surface().faces)
    result = one.result()
    assert [step.track.status for step in steps] == ["initial"] + ["ok"] * (FRAMES - 1)
    kept = result.trajectory.indices.tolist()
    assert 0 < len(kept) <= 4
    assert (kept[0], kept[-1]) == (0, FRAMES - 1)
    assert "The result keeps the last 4 frames; " in " ".join(warned(result.provenance))
    alone = Reconstructor(config, open_sequence(folder))
    alone.step(next(iter(alone.frames())))
    assert len(alone.surface().faces) == faces  # the first frame alone was fused
