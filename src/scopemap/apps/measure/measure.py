"""Distances and areas on the surface of a run, between pixels of a frame, with intervals.

An interval holds 95 % of what the measure may be by what is known of its errors: of the depth at each pixel, of the
pixels themselves, of the focal length, and of the scale. Errors are drawn; what two measures share, cancels in a ratio.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.geometry.surface_measures import SurfacePoint, area_inside, meet_surface, path_length
from scopemap.report.measured_surface import drawn, measure_errors, measured_depth, measured_mesh
from scopemap.runner.exported_run import ExportedRun, read_exported

_REFERENCE_ROW, _FIRST_ROW = 3, 9
"""Of the drawn numbers: 0 to 2 are what all share, then three for each point."""
_REFERENCE_SHARE, _MOST_SIGMA = 0.3, 0.05
"""Share of the depth's standard deviation at a reference that does not cancel in lengths beside it, and its most.

As a share of the depth, by phantoms (docs/measure.md): the surface is the mean of many views.
"""


@dataclass(frozen=True)
class Measure:
    """What was measured, its value, and the ends of its 95 % interval, NaN: unknown. unit : mm, mm2, or the reference.

    The value is infinite where the surface has a gap between the points.
    """

    what: str
    value: float
    low: float
    high: float
    unit: str

    @classmethod
    def of(cls, what: str, value: float, relative: np.ndarray, unit: str, sizes: dict[str, Any]) -> Measure:
        """Return a measure by its value and draws (D,) of what it may be over that; sizes : from `measure_errors`."""
        low, high = np.percentile(relative, [sizes["tail_percent"], 100 - sizes["tail_percent"]])
        return cls(what, float(value), float(value * min(low, 1.0)), float(value * max(high, 1.0)), unit)

    def __str__(self) -> str:
        if not np.isfinite(self.value):
            return f"{self.what}: none, the surface has a gap between the points"
        value, low, high = (
            np.format_float_positional(float(f"{one:.3g}"), trim="-") for one in (self.value, self.low, self.high)
        )
        return f"{self.what}: {value} {self.unit}" + (f" ({low} to {high})" if np.isfinite(self.low) else "")


@dataclass(frozen=True)
class _Picked:
    """Pixels (N, 2) of a frame, the surface's points there, their depth, and its relative standard deviation."""

    pixels: np.ndarray
    points: list[SurfacePoint]
    depth_mm: np.ndarray
    depth_error: np.ndarray


@dataclass(frozen=True)
class _Errors:
    """Draws of what all measures of a frame share: depth of the whole frame, focal length and scale, (D,) factors.

    sizes : from `measure_errors`.
    """

    depth: np.ndarray
    focal: np.ndarray
    scale: np.ndarray
    sizes: dict[str, Any]


def measure(
    folder: Path, frame: int, pixels: np.ndarray, reference: np.ndarray | None = None, reference_mm: float | None = None
) -> list[Measure]:
    """Return distances between two pixels (2, 2) of a frame, straight and along the surface, or the area inside more.

    pixels : x, y of the frame's rectified picture, as large as its depth map; (0, 0) is the middle of its first pixel.
    reference : two pixels (2, 2) of the same frame whose straight distance is the unit of what is returned, or is
    `reference_mm`; needed where the run's scale is unknown. Raises `InputError` where the frame, or a surface at a
    pixel, is not there, and where neither the run nor a reference gives a scale.
    """
    if reference is None and reference_mm is not None:
        raise SettingsError("a length of the reference without its two points: give both")
    run = read_exported(folder)
    scale = known_scale(run, None if reference is None else Known(frame, reference, reference_mm))
    pose, mesh = _pose(run, frame), measured_mesh(run, frame)
    picked, errors = _picked(run, mesh, frame, pose, pixels), _drawn(run)
    if len(pixels) > 2:
        area = area_inside(mesh, pixels, run.camera, pose)
        if area <= 0:
            raise InputError(f"no surface is seen inside the polygon of frame {frame}")
        relative = _relative(run, picked, errors, _flat_area, _FIRST_ROW) * scale.draws**2
        return [Measure.of("area", area / scale.divisor**2, relative, scale.square, scale.sizes)]
    relative = _relative(run, picked, errors, _straight, _FIRST_ROW) * scale.draws
    straight = _straight(np.stack([point.position for point in picked.points]))
    along = path_length(mesh, *picked.points)
    found = {"straight": straight, "along the surface": along}
    return [Measure.of(what, value / scale.divisor, relative, scale.unit, scale.sizes) for what, value in found.items()]


@dataclass(frozen=True)
class Known:
    """A reference: two pixels (2, 2) of a frame, and their straight distance, mm; None: it is the unit."""

    frame: int
    pixels: np.ndarray
    length_mm: float | None = None


@dataclass(frozen=True)
class KnownScale:
    """The scale of a run's millimetres: what lengths are divided by, draws (D,) of its error, and the unit.

    from_views : draws (D,) for lengths from many frames: they err by the focal length, and not by one frame's depth.
    words : what the scale rests on. sizes : of the errors, from `measure_errors`.
    """

    divisor: float
    draws: np.ndarray
    from_views: np.ndarray
    unit: str
    words: str
    sizes: dict[str, Any]

    @property
    def square(self) -> str:
        """The unit of areas."""
        return {"mm": "mm2"}.get(self.unit, "times the reference's square")


def known_scale(run: ExportedRun, known: Known | None) -> KnownScale:
    """Return the scale that a run knows, or that of a reference. Raises `InputError` where neither gives one."""
    errors = _drawn(run)
    if known is None:
        if not run.scale_known:
            raise InputError(
                f"{run.path}: {run.scale}; give two points as a reference: measures are then multiples of their "
                "distance, and millimetres where that is given, too"
            )
        return KnownScale(1.0, errors.scale, errors.scale / errors.focal, "mm", run.scale, errors.sizes)
    far_px, least_px = float(np.linalg.norm(known.pixels[1] - known.pixels[0])), errors.sizes["reference_px"]
    if far_px < least_px:
        raise InputError(f"the reference is {far_px:.1f} px long: {least_px} px are needed")
    picked = _picked(run, measured_mesh(run, known.frame), known.frame, _pose(run, known.frame), known.pixels)
    length = _straight(np.stack([point.position for point in picked.points]))
    draws = 1 / _relative(run, picked, errors, _straight, _REFERENCE_ROW)
    if known.length_mm is None:
        unit, words = "times the reference", f"two points of frame {known.frame}, whose distance in mm is not known"
    else:
        unit, words = "mm", f"two points of frame {known.frame}, taken to be {known.length_mm:g} mm apart"
    beside = replace(picked, depth_error=np.sqrt(2) * (_REFERENCE_SHARE * picked.depth_error).clip(max=_MOST_SIGMA))
    own = replace(errors, depth=np.zeros_like(errors.depth))
    from_views = 1 / _relative(run, beside, own, _straight, _REFERENCE_ROW) / errors.focal
    return KnownScale(length / (known.length_mm or 1.0), draws, from_views, unit, words, errors.sizes)


def _pose(run: ExportedRun, frame: int) -> np.ndarray:
    row = np.flatnonzero(run.trajectory.indices == frame)
    if len(row):
        return np.asarray(run.trajectory.T_world_camera[row[0]])
    place = run.frames.place[run.frames["index"] == frame]
    where = f"it is in maps/{place[0]}, a folder of its own" if len(place) and place[0] > 0 else "it has no pose"
    raise InputError(f"frame {frame} is not in the result {run.path}: {where}")


def _picked(run: ExportedRun, mesh: trimesh.Trimesh, frame: int, pose: np.ndarray, pixels: np.ndarray) -> _Picked:
    points, depths = [], []
    for pixel in pixels:
        inside = (pixel >= -0.5).all() and (pixel < [run.camera.width - 0.5, run.camera.height - 0.5]).all()
        ray = run.camera.unproject(pixel)
        found = meet_surface(mesh, pose[:3, 3], pose[:3, :3] @ ray) if inside else None
        if found is None:
            size = f"{run.camera.width}x{run.camera.height} px"
            raise InputError(f"no surface at pixel {pixel[0]:g},{pixel[1]:g} of frame {frame}, whose size is {size}")
        points.append(found)
        depths.append(float((found.position - pose[:3, 3]) @ pose[:3, 2]))
    depth_mm = np.array(depths)
    return _Picked(pixels, points, depth_mm, _depth_errors(run, frame, pixels, depth_mm))


def _depth_errors(run: ExportedRun, frame: int, pixels: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Return relative standard deviations: the run's own, or what surface and frame differ by where that is more."""
    errors, coded = np.full(len(pixels), np.nan), measured_depth(run, frame)
    if coded is not None:
        shares = np.array([coded.shape[1] / run.camera.width, coded.shape[0] / run.camera.height])
        column, row = np.floor((pixels + 0.5) * shares).astype(int).T
        upper, lower, level = coded[row, column].astype(int).T
        units = np.where(upper + lower > 0, 256 * upper + lower, np.nan).astype(np.float32)
        own = units * np.float32(run.depth.scale_mm)
        errors = np.fmax(np.abs(own - depth_mm), run.depth.sigma_shares[level] * own) / depth_mm
    return np.where(np.isfinite(errors), errors, measure_errors(run)["depth"])


def _drawn(run: ExportedRun) -> _Errors:
    sizes = measure_errors(run)
    depth, focal, scale = drawn(0, 3, sizes["draws"])
    return _Errors(depth, 1 + sizes["focal"] * focal, np.exp(sizes["scale"] * scale), sizes)


def _relative(
    run: ExportedRun, picked: _Picked, errors: _Errors, figure: Callable[[np.ndarray], np.ndarray], first: int
) -> np.ndarray:
    """Return draws (D,) of a figure of the points over its value without errors; first : row of the drawn numbers.

    Half of the variance of a depth is that of the whole frame, half its own.
    """
    count = len(picked.pixels)
    own = drawn(first, 3 * count, errors.sizes["draws"]).reshape(3, count, -1).transpose(0, 2, 1)
    depths = picked.depth_mm * np.exp(picked.depth_error * (errors.depth[:, None] + own[0]) / np.sqrt(2))
    rays = run.camera.unproject(picked.pixels + errors.sizes["pixel_px"] * np.stack([own[1], own[2]], -1))
    rays[..., :2] /= errors.focal[:, None, None]
    points = rays * depths[..., None]
    exact = run.camera.unproject(picked.pixels) * picked.depth_mm[:, None]
    return np.asarray(figure(points) / np.maximum(figure(exact), 1e-9))


def _straight(points: np.ndarray) -> Any:
    """Return the distance of the first two of points (..., N, 3)."""
    return np.linalg.norm(points[..., 1, :] - points[..., 0, :], axis=-1)


def _flat_area(points: np.ndarray) -> Any:
    """Return the area of polygons (..., N, 3), projected to where it is largest."""
    from_first = points - points[..., :1, :]
    return 0.5 * np.linalg.norm(np.cross(from_first[..., :-1, :], from_first[..., 1:, :]).sum(axis=-2), axis=-1)
