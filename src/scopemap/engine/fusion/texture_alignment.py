"""Where a frame really shows a surface: up to some pixels beside where its pose and the surface say.

Poses and depth err by some pixels, and tissue moves. Vessels would be cut at the seams between frames, and lie beside
their place in every other frame. The flow from what other frames show there, moved by the surface into the frame's own
view, is that error; its mean over many frames brings all of them to one common place (Zhou and Koltun, "Color map
optimization", SIGGRAPH 2014, find such a place by joint optimisation of poses and warps).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np
import trimesh

from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.local_contrast import local_mean
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.models.device import cpu_threads

_SAME_SURFACE = 0.03  # by hand: between the depths of a point in two views, of them: it is not hidden
_LEAST_OVERLAP = 0.05  # by hand: of the picture
_LARGEST_SHIFT = 1 / 40  # by hand: of the width; flow beyond it is wrong
# Chosen of 4 and 12 px on laparoscopy_rvim 60:120 (SSIM of frames left out 0.827 and 0.826; 0.808 without shifts).
_SMOOTHED = 1 / 80  # sigma, of the width
_LIGHT = 1 / 20  # by hand: sigma, of the width, of the light that is taken out
_CONTRAST = 160.0  # by hand: grey levels of 8 bits for a factor of e
_LEAST_LEVEL = 8.0  # by hand: darker levels are noise
_EDGE_PX = 5  # by hand: where the mask of what both show is left out


def shifts_px(mesh: trimesh.Trimesh, frames: Sequence[Frame], others: Sequence[Frame]) -> Iterator[np.ndarray]:
    """Yield, for each frame, how far from where its pose places a point of the surface the frame shows it.

    mesh : world mm. frames, others : with pose and mask. Each shift is (H, W, 2) float32, px to the right and down, at
    the pixels where the poses place the points: the mean over the frame itself and the others, 0 where nothing of the
    surface is seen.
    """
    some = {frame.index: frame for frame in (*others, *frames)}
    # Kernels, OpenCV and arithmetic of whole pictures run without Python's lock.
    with ThreadPoolExecutor(cpu_threads()) as pool:
        depth_mm = dict(zip(some, pool.map(partial(_depth_mm, mesh), some.values()), strict=True))
        seen_by = [(one, np.nan_to_num(depth_mm[one.index])) for one in others]
        yield from pool.map(lambda frame: _shift_px(depth_mm[frame.index], frame, seen_by), frames)


def _shift_px(depth_mm: np.ndarray, frame: Frame, others: Sequence[tuple[Frame, np.ndarray]]) -> np.ndarray:
    assert frame.T_world_camera is not None
    flow_of = DisFlow()  # its buffers are for one thread
    seen = np.isfinite(depth_mm)
    points = transform(frame.T_world_camera, frame.camera.rays * np.where(seen, depth_mm, 1)[..., None])
    total, weight = np.zeros((*depth_mm.shape, 2), np.float32), np.ones(depth_mm.shape, np.float32)
    sigma_px = max(1.0, _SMOOTHED * frame.camera.width)
    for other, other_mm in others:
        if other.index == frame.index:
            continue
        assert other.T_world_camera is not None
        in_other = transform(inverse(other.T_world_camera), points)
        pixels = np.nan_to_num(other.camera.project(in_other), nan=-1e4).astype(np.float32)
        x, y = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
        there_mm = cv2.remap(other_mm, x, y, cv2.INTER_NEAREST)
        both = cv2.remap(other.valid.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
        both &= seen & frame.valid & (np.abs(there_mm / in_other[..., 2] - 1) < _SAME_SURFACE)
        if both.mean() < _LEAST_OVERLAP:
            continue
        flow = flow_of.estimate_small(_even(cv2.remap(other.rgb, x, y, cv2.INTER_LINEAR), both), _even(frame.rgb, both))
        trusted = both & (np.hypot(*np.moveaxis(flow, -1, 0)) < _LARGEST_SHIFT * frame.camera.width)
        share = cv2.erode(trusted.astype(np.float32), np.ones((_EDGE_PX, _EDGE_PX), np.uint8))
        total += cv2.GaussianBlur(flow * share[..., None], (0, 0), sigma_px)
        weight += cv2.GaussianBlur(share, (0, 0), sigma_px)
    return total / weight[..., None]


def _depth_mm(mesh: trimesh.Trimesh, frame: Frame) -> np.ndarray:
    assert frame.T_world_camera is not None
    return render_mesh(mesh, frame.camera, frame.T_world_camera).depth_mm


def _even(rgb: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the grey picture (H, W, 3) uint8 without light and exposure, grey where nothing is known."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    levels, weight = np.log(np.maximum(grey, _LEAST_LEVEL)), known.astype(np.float32)
    levels -= local_mean(levels, _LIGHT * known.shape[1], weight, downscale=4)
    even = np.clip(128 + _CONTRAST * levels * weight, 0, 255).astype(np.uint8)
    return cv2.cvtColor(even, cv2.COLOR_GRAY2RGB)
