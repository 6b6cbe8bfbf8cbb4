"""Multi-view depth: a wall with relief, seen by a moving camera, whose depth is known exactly."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.geometry.se3 import se3, so3_exp
from scopemap.engine.mapping.multiview_depth import (
    KeyframeDepths,
    PosedImage,
    choose_neighbours,
    normalised_contrast,
    triangulate_depth,
)

CAMERA = PinholeCamera(fx=110.0, fy=110.0, cx=79.5, cy=63.5, width=160, height=128)
WALL_MM = 60.0
FRAMES = 9
MIDDLE = FRAMES // 2


def _texture() -> np.ndarray:
    noise = np.random.default_rng(3).normal(size=(600, 600)).astype(np.float32)
    mixed = sum(cv2.GaussianBlur(noise, (0, 0), sigma) * sigma for sigma in (1.5, 3.0, 6.0))
    return np.asarray(128 + 45 * mixed / mixed.std(), np.float32)


TEXTURE = _texture()


def _pose(number: int, step_mm: float = 2.0) -> np.ndarray:
    """Sideways motion with a small turn."""
    return se3(so3_exp(np.array([0.0, 0.004 * (number - MIDDLE), 0.0])), np.array([step_mm * (number - MIDDLE), 0, 0]))


def _relief_mm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return WALL_MM + 6 * np.sin(x / 12) * np.cos(y / 10)


def _seen(T_world_camera: np.ndarray, shift_mm: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Picture and depth, mm, of the wall from a pose; shift_mm: the wall has moved so far in x."""
    rays = CAMERA.rays @ T_world_camera[:3, :3].T
    origin, along = T_world_camera[:3, 3], np.full(CAMERA.rays.shape[:2], WALL_MM)
    for _ in range(12):  # each step leaves a third of the error
        point = origin + rays * along[..., None]
        along = (_relief_mm(point[..., 0] - shift_mm, point[..., 1]) - origin[2]) / rays[..., 2]
    point = origin + rays * along[..., None]
    x, y = (4 * (point[..., 0] - shift_mm) + 300).astype(np.float32), (4 * point[..., 1] + 300).astype(np.float32)
    grey = np.clip(cv2.remap(TEXTURE, x, y, cv2.INTER_LINEAR), 0, 255).astype(np.uint8)
    return cv2.merge([grey] * 3), ((point - origin) @ T_world_camera[:3, 2]).astype(np.float32)


def _image(number: int, error: float | np.ndarray = 0.0, shift_mm: float = 0.0, gain: float = 1.0) -> PosedImage:
    rgb, depth_mm = _seen(_pose(number), shift_mm)
    rgb = np.clip(gain * rgb, 0, 255).astype(np.uint8)
    return PosedImage(normalised_contrast(rgb), (depth_mm * np.exp(error)).astype(np.float32), _pose(number))


def _bias() -> np.ndarray:
    """An error of ln depth that varies over the image, up to 12 %."""
    u, v = np.meshgrid(np.linspace(-1, 1, CAMERA.width), np.linspace(-1, 1, CAMERA.height))
    return 0.06 + 0.06 * np.sin(3 * u) * np.cos(2 * v)


def _error(depth_mm: np.ndarray) -> float:
    """Median of |ln| against the truth in the middle of the middle frame."""
    return float(np.median(np.abs(np.log(depth_mm / _seen(_pose(MIDDLE))[1]))[16:-16, 24:-24]))


def test_a_wrong_depth_is_corrected_to_a_fraction() -> None:
    wrong = _image(MIDDLE, _bias())
    neighbours = [_image(number, _bias(), gain=0.8 if number % 2 else 1.0) for number in (2, 3, 5, 6)]
    found = triangulate_depth(wrong, neighbours, CAMERA, DisFlow())
    assert _error(wrong.depth_mm) > 0.05
    assert _error(found.depth_mm) < 0.2 * _error(wrong.depth_mm)
    assert np.median(found.sigma) < 0.06


def test_tissue_that_moves_is_not_triangulated() -> None:
    """The wall slides to and fro by as much as the camera moves: neighbours contradict each other."""
    neighbours = [_image(number, shift_mm=3.0 * (-1) ** number) for number in (1, 2, 3, 5, 6, 7)]
    assert triangulate_depth(_image(MIDDLE), neighbours, CAMERA, DisFlow()) is None


def test_a_wall_without_texture_is_not_triangulated() -> None:
    """Flow sees nothing there, so neighbours would agree on whatever depth they start from."""
    flat = [_image(number, 0.2)._replace(contrast=np.full((128, 160), 128, np.uint8)) for number in range(2, 7)]
    assert triangulate_depth(flat[2], [flat[0], flat[1], flat[3], flat[4]], CAMERA, DisFlow()) is None


def test_what_one_neighbour_sees_alone_keeps_its_depth() -> None:
    image, neighbours = _image(MIDDLE, 0.1), [_image(number, 0.1) for number in (2, 3, 5, 6)]
    for neighbour in neighbours[1:]:
        neighbour.depth_mm[:, :60] = np.nan
    found = triangulate_depth(image, neighbours, CAMERA, DisFlow())
    assert np.abs(found.log_factor[20:-20, 90:140]).mean() > 0.08
    assert np.abs(found.log_factor[20:-20, 12:30]).mean() < 0.06
    assert found.sigma[20:-20, 12:30].mean() > 2 * found.sigma[20:-20, 90:140].mean()


def test_one_neighbour_is_not_enough() -> None:
    assert triangulate_depth(_image(MIDDLE), [_image(2)], CAMERA, DisFlow()) is None
    blind = _image(6)
    blind.depth_mm[:] = np.nan
    assert triangulate_depth(_image(MIDDLE), [_image(2), blind], CAMERA, DisFlow()) is None


def test_neighbours_are_on_both_sides_and_have_parallax() -> None:
    poses = {number: _pose(number, step_mm=0.5) for number in range(60)}
    depth_mm = np.full((CAMERA.height, CAMERA.width), WALL_MM, np.float32)
    chosen = choose_neighbours(30, depth_mm, CAMERA, poses)
    assert min(chosen) < 30 < max(chosen)
    # Parallax: focal length times distance over depth, px per unit of ln depth.
    parallax_px = [CAMERA.fx * 0.5 * abs(number - 30) / WALL_MM for number in chosen]
    assert all(3 < px < 25 for px in parallax_px), parallax_px


@pytest.mark.parametrize("black", [None, MIDDLE])
def test_frames_and_keyframes_that_fail_take_the_depth_of_the_keyframes_around_them(
    black: int | None,
) -> None:
    def read(number: int) -> tuple[np.ndarray, np.ndarray]:
        rgb, depth_mm = _seen(_pose(number))
        return (np.zeros_like(rgb) if number == black else rgb), (depth_mm * np.exp(_bias())).astype(np.float32)

    poses = {number: _pose(number) for number in range(FRAMES)}
    depths = KeyframeDepths(read, poses, [1, MIDDLE, 7], CAMERA, DisFlow())
    found = [depths.depth(number, _image(number, _bias()).depth_mm) for number in range(FRAMES)]
    depths.close()
    assert depths.notice.values == {"triangulated": 3 if black is None else 2, "keyframes": 3}
    assert all(one is not None for one in found)
    assert _error(found[MIDDLE].depth_mm) < 0.03
    assert np.median(np.abs(found[3].log_factor + _bias())[16:-16, 24:-24]) < 0.04


def _slow_pose(number: int) -> np.ndarray:
    return _pose(number - 12, 0.8)


@cache
def _slow_way() -> list[tuple[np.ndarray, np.ndarray]]:
    return [_seen(_slow_pose(number)) for number in range(33)]


@pytest.mark.parametrize("keyframes", [[0, 8, 16, 24, 32], [0, 4, 16, 21, 32], [7, 24]])
def test_depth_does_not_step_where_the_keyframe_changes(keyframes: list[int]) -> None:
    """The scale of the poses drifts by half a percent a frame, so that keyframes triangulate depths that differ."""
    seen = _slow_way()
    poses = {number: _slow_pose(number) for number in range(len(seen))}
    for T in poses.values():
        T[0, 3] *= 1 + 0.0025 * T[0, 3] / 0.8
    depths = KeyframeDepths(seen.__getitem__, poses, keyframes, CAMERA, DisFlow())
    found = [depths.depth(number, seen[number][1]) for number in range(len(seen))]
    depths.close()
    assert depths.notice.values["triangulated"] == len(keyframes)
    factors = np.stack([one.log_factor[16:-16, 24:-24] for one in found])
    steps = np.median(np.abs(np.diff(factors, axis=0)), axis=(1, 2))
    change = np.ptp(np.median(factors, axis=(1, 2)))
    assert change > 0.015
    # A tenth or less from any frame to the next: between the nearest keyframes are five to seventeen of them.
    assert steps.max() < 0.1 * change
