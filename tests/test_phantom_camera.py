"""The phantom's camera: motion blur, exposure that lags, scattered light and video coding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scopemap.cameras.camera import PinholeCamera
from scopemap.cameras.formats.writing import write_calibration
from scopemap.cameras.lenses import FisheyeCamera
from scopemap.geometry.se3 import se3, so3_exp
from scopemap.io.opening import open_sequence
from scopemap_bench.phantom.exposing import MAX_SAMPLES, VideoCoding, exposure_times, lagging_gains
from scopemap_bench.phantom.march import march, rays_of
from scopemap_bench.phantom.render import Phantom, light, prepare, render_frame
from scopemap_bench.phantom.spec import PhantomSpec
from scopemap_bench.phantom.writer import write_phantom

SMALL = PhantomSpec(width=64, height=48, frames=6, seed=3, noise=0.0)


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return prepare(SMALL)


def turning(phantom: Phantom, step_rad: float) -> Phantom:
    """The phantom with a camera that yaws by `step_rad` from frame to frame."""
    start = phantom.poses[2]
    poses = np.stack([start @ se3(so3_exp(np.array([0, n * step_rad, 0])), np.zeros(3)) for n in range(5)])
    return replace(phantom, poses=poses)


def test_light_is_sampled_as_often_as_pixels_move(phantom: Phantom) -> None:
    camera, (_, surface) = SMALL.camera, light(phantom, 2)
    for step_px, expected in ((0.0, 1), (16.0, 4), (100.0, MAX_SAMPLES)):
        moving = turning(phantom, step_px / camera.fx)
        times = exposure_times(2, 0.5, moving.poses, surface, camera)
        # Rotation moves the corners farther than the centre.
        assert expected <= len(times) <= 2 * expected if step_px else times == [2]
        assert np.mean(times) == pytest.approx(2.0)
        assert np.ptp(times) < 0.5


def test_motion_blurs_across_its_direction_alone_and_leaves_depth(phantom: Phantom) -> None:
    moving = turning(phantom, 8.0 / SMALL.camera.fx)
    sharp, surface = light(moving, 2)
    blurred, same = light(replace(moving, spec=replace(SMALL, shutter=1.0)), 2)
    np.testing.assert_array_equal(surface.depth_mm, same.depth_mm)
    np.testing.assert_allclose(blurred.mean(), sharp.mean(), rtol=0.1)

    def roughness(image: np.ndarray, axis: int) -> float:
        return float(np.abs(np.diff(np.log(image[..., 1] + 1e-9), 2, axis)).mean())

    assert roughness(blurred, 1) < 0.5 * roughness(sharp, 1)
    assert roughness(blurred, 0) > 1.5 * roughness(blurred, 1)
    still = turning(phantom, 0.0)
    np.testing.assert_array_equal(light(replace(still, spec=replace(SMALL, shutter=1.0)), 2)[0], light(still, 2)[0])


def test_gains_follow_late() -> None:
    wanted = np.array([1.0, 4.0, 4.0, 4.0, 4.0])
    np.testing.assert_allclose(lagging_gains(wanted, 0.0), wanted)
    late = lagging_gains(wanted, 2.0)
    np.testing.assert_allclose(np.log(late) / np.log(4), 1 - np.exp(-np.arange(5) / 2))


def test_coding_is_coarser_with_a_larger_factor_and_repeatable(phantom: Phantom) -> None:
    frames = [render_frame(phantom, n)[0][:47, :63] for n in range(4)]
    errors = {}
    for crf in (10, 40):
        coding = VideoCoding(crf, 63, 47)
        first = [coding(rgb) for rgb in frames]
        again = VideoCoding(crf, 63, 47)
        for one, rgb in zip(first, frames, strict=True):
            assert one.shape == rgb.shape
            np.testing.assert_array_equal(one, again(rgb))
        errors[crf] = [np.abs(a.astype(int) - b).mean() for a, b in zip(first, frames, strict=True)]
    assert max(errors[10]) < 6
    assert np.mean(errors[40]) > 1.5 * np.mean(errors[10])


def test_a_scene_is_seen_through_the_lens_of_a_calibration(tmp_path: Path) -> None:
    lens = FisheyeCamera(PinholeCamera(60.0, 60.0, 63.0, 48.0, 128, 96), (-0.14, 0.0, 0.0015, -0.0001))
    write_calibration(lens, tmp_path / "lens.yaml")
    spec = replace(SMALL, frames=2, camera_file=tmp_path / "lens.yaml")
    write_phantom(spec, tmp_path / "seen")
    sequence = open_sequence(tmp_path / "seen")
    found = sequence.rectifier.source
    assert isinstance(found, FisheyeCamera)
    assert found.plane == lens.resized(64, 48).plane
    # Both cameras show the same surface: what the lens saw at a pixel is at the place where a pinhole sees it.
    fisheye, pinhole = prepare(spec), prepare(replace(SMALL, frames=2))
    rays = rays_of(fisheye.spec.camera)
    seen = march(fisheye.volume, fisheye.spec.camera, fisheye.poses[0], fisheye.motion.at(0)).depth_mm
    assert np.isnan(rays[0, 0]).all()
    assert np.isnan(seen[0, 0])
    points = (rays * seen[..., None])[20:28, 28:36].reshape(-1, 3)
    plain = march(pinhole.volume, SMALL.camera, pinhole.poses[0], pinhole.motion.at(0)).depth_mm
    x, y = np.rint(SMALL.camera.project(points)).astype(int).T
    # Nearly everywhere: behind the edges of folds a pixel's rounding sees something else.
    assert np.mean(np.abs(plain[y, x] / points[:, 2] - 1) < 0.05) > 0.8
    rgb, _ = render_frame(fisheye, 0)
    assert rgb[0, 0].max() < 20 < rgb[24, 32].max()
