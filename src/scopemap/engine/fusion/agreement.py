"""How well a fused mesh agrees with frames, without any truth: the mesh is rendered again at their poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import FusionSettings
from scopemap.engine.depth.estimate import PerceptualDistance
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.albedo import lit_by_lamp
from scopemap.engine.geometry.rendering import Rendering, render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.geometry.similarity import structural_similarity
from scopemap.engine.models.device import cpu_threads

_NEAR = float(np.log(1.1))  # within 10 %
_Item = TypeVar("_Item")
_Found = TypeVar("_Found")
_SAME_SURFACE = 0.02  # by hand: between a vertex and what is rendered at its pixel, of its depth: it is not hidden


class FrameAgreement(NamedTuple):
    """Agreement of a mesh with one frame.

    coverage : share, 0..1, of the pixels with known depth where the mesh is seen.
    depth_error : median of |ln(depth of the mesh / depth of the frame)| where both are known; NaN where nowhere.
    ssim : mean structural similarity of grey values over all pixels with known depth; holes are black.
    within_10_percent : share, 0..1, of the pixels with known depth where the mesh is seen within 10 % of it.
    lpips : mean perceptual distance over the same pixels, all others black in both pictures; NaN: not measured.
    """

    coverage: float
    depth_error: float
    ssim: float
    within_10_percent: float
    lpips: float = float("nan")


def lit_like(rendering: Rendering, camera: PinholeCamera, rgb: np.ndarray, depth_mm: np.ndarray) -> Rendering:
    """Return the rendering of a mesh in the colours of the tissue as the lamp shows it, exposed as a frame is.

    The light is that of fusion (`fusion/albedo.py`) at the mesh's own distance. One number is fitted to the frame's
    grey levels, its gain. rgb : (H, W, 3) uint8. depth_mm : (H, W), NaN = unknown or not usable.
    """
    lit = lit_by_lamp(rendering.rgb, rendering.depth_mm, camera)
    seen = (depth_mm > 0) & np.isfinite(rendering.depth_mm)
    shown, wanted = (cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY)[seen] for image in (lit, rgb))
    gain = float(shown @ wanted / max(float(shown @ shown), 1.0))
    return rendering._replace(rgb=np.clip(np.round(gain * lit), 0, 255).astype(np.uint8))


def compare_rendering(
    rendering: Rendering, rgb: np.ndarray, depth_mm: np.ndarray, perceptual: PerceptualDistance | None = None
) -> FrameAgreement:
    """Return the agreement of a rendering of a mesh with the frame at whose pose it was rendered.

    rgb : (H, W, 3) uint8. depth_mm : (H, W), NaN = unknown or not usable. lpips is measured by `perceptual`, if given.
    """
    known = depth_mm > 0
    seen = known & np.isfinite(rendering.depth_mm)
    error = np.abs(np.log(rendering.depth_mm[seen] / depth_mm[seen]))
    grey, shown = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (rgb, rendering.rgb))
    similarity = structural_similarity(grey, shown)
    lpips = float("nan")
    if perceptual is not None and known.any():
        frame, view = (np.where(known[..., None], image, np.uint8(0)) for image in (rgb, rendering.rgb))
        lpips = float(perceptual.compare(frame, view).map[known].mean())
    return FrameAgreement(
        float(seen.sum() / max(known.sum(), 1)),
        float(np.median(error)) if error.size else float("nan"),
        float(similarity[known].mean()) if known.any() else float("nan"),
        float((error <= _NEAR).sum() / max(known.sum(), 1)),
        lpips,
    )


def agreement_figures(agreements: Iterable[FrameAgreement]) -> dict[str, float]:
    """Return the number of frames, mean and least coverage, mean and least share within 10 %, median depth error, mean
    SSIM and LPIPS, where known.
    """
    rows = list(agreements)
    columns = np.array(rows).reshape(-1, len(FrameAgreement._fields)).T
    coverage, depth_error, ssim, within, lpips = (column[np.isfinite(column)] for column in columns)
    figures: dict[str, float] = {"frames": len(rows)}
    if coverage.size:
        figures |= {"coverage_mean": float(coverage.mean()), "coverage_least": float(coverage.min())}
        figures |= {"within_10_percent_mean": float(within.mean()), "within_10_percent_least": float(within.min())}
    if depth_error.size:
        figures["depth_error"] = float(np.median(depth_error))
    if ssim.size:
        figures["ssim"] = float(ssim.mean())
    if lpips.size:
        figures["lpips"] = float(lpips.mean())
    return figures


class RenderedFrame(NamedTuple):
    """A frame with depth and pose, the vertices (V, 3) of a surface, world mm, and its rendering."""

    frame: Frame
    vertices: np.ndarray
    rendering: Rendering


def rendered_frames(mesh: trimesh.Trimesh, frames: list[Frame]) -> list[RenderedFrame]:
    """Return renderings of a fusion's surface at some of its frames; [] without a surface or frames."""
    usable = [frame for frame in frames if frame.T_world_camera is not None and frame.depth_mm is not None]

    def rendered(frame: Frame) -> RenderedFrame:
        rendering = render_mesh(mesh, frame.camera, np.asarray(frame.T_world_camera))
        return RenderedFrame(frame, np.asarray(mesh.vertices), rendering)

    return _in_threads(rendered, usable) if len(mesh.faces) else []


def surface_agreement(frames: list[RenderedFrame], settings: FusionSettings) -> dict[str, float]:
    """Return the figures of a fusion's surface with some of its frames; {} without any."""

    def agreement(one: RenderedFrame) -> FrameAgreement:
        frame, rendering = one.frame, one.rendering
        depth_mm = np.where(frame.valid, np.asarray(frame.depth_mm), np.nan)
        if settings.without_light:
            rendering = lit_like(rendering, frame.camera, frame.rgb, depth_mm)
        return compare_rendering(rendering, frame.rgb, depth_mm)

    return agreement_figures(_in_threads(agreement, frames)) if frames else {}


def vertex_sigmas(count: int, frames: list[RenderedFrame]) -> np.ndarray:
    """Return the standard deviation of each vertex along the lines of sight, (V,) float32, mm; NaN: no frame sees it.

    It is the root mean square, over the frames that see the vertex, of what their depth and the surface differ by or of
    the depth's own standard deviation where that is larger. Many frames do not make it smaller: their errors are alike.
    count : of the vertices, V.
    """
    total, seen_by = np.zeros(count), np.zeros(count)
    for seen, error in _in_threads(_vertex_errors, frames):
        total[seen] += error**2
        seen_by[seen] += 1
    mean = np.divide(total, seen_by, out=np.full(count, np.nan), where=seen_by > 0)
    return np.sqrt(mean).astype(np.float32)


def _vertex_errors(one: RenderedFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return which vertices (N,) a frame sees, and the deviation of each, (N,) mm."""
    frame, shown = one.frame, one.rendering.depth_mm
    in_camera = transform(inverse(np.asarray(frame.T_world_camera)), one.vertices)
    x, y = np.moveaxis(frame.camera.project(in_camera), -1, 0)
    inside = np.flatnonzero(
        (x >= -0.5) & (y >= -0.5) & (x < frame.camera.width - 0.5) & (y < frame.camera.height - 0.5)
    )
    column, row, z_mm = np.rint(x[inside]).astype(int), np.rint(y[inside]).astype(int), in_camera[inside, 2]
    error = np.abs(np.asarray(frame.depth_mm)[row, column] - z_mm)
    if frame.depth_sigma_mm is not None:
        error = np.fmax(error, np.asarray(frame.depth_sigma_mm)[row, column])
    seen = frame.valid[row, column] & np.isfinite(error) & (np.abs(shown[row, column] / z_mm - 1) < _SAME_SURFACE)
    return inside[seen], error[seen]


def _in_threads(function: Callable[[_Item], _Found], items: Iterable[_Item]) -> list[_Found]:
    """Return what a function returns for each item, in order; its work is done without Python's lock."""
    with ThreadPoolExecutor(cpu_threads()) as pool:
        return list(pool.map(function, items))
