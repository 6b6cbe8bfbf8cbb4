"""Distances and areas on the surface of a run, between pixels of a frame, with intervals.

An interval holds 95 % of what the measure may be by what is known of its errors: of the depth at each pixel, of the
pixels themselves, of the focal length, and of the scale (`intervals.py`). What two measures share, cancels in a ratio.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from scopemap.apps.measure.intervals import SIGMAS, LogChanges
from scopemap.apps.measure.measured_surface import (
    DEPTH_ERROR,
    PIXEL_ERROR_PX,
    focal_and_scale_errors,
    measured_depth,
    measured_mesh,
)
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.surface_measures import SurfacePoint, area_inside, meet_surface, path_length
from scopemap.result.result import Result, opened

WIDE = 1.5
"""An interval is wide where its ends differ by more than this factor (by hand: about a quarter to either side)."""
_OF_POINTS = "the depth and the place of the single points"
_LEAST_REFERENCE_PX = 10
"""A shorter reference errs by more than a pixel at each end allows (by hand)."""
_REFERENCE_SHARE = 0.3
_MOST_SIGMA = 0.05
"""Share of the depth's standard deviation at a reference that does not cancel in lengths beside it, and its most.

As a share of the depth, by phantoms (docs/measure.md): the surface is the mean of many views.
"""


@dataclass(frozen=True)
class Measure:
    """What was measured, its value, and the ends of its 95 % interval, NaN: unknown. unit : mm, mm2, or the reference.

    The value is infinite where the surface has a gap between the points. why : what makes a wide interval wide; "":
    it is narrow, or not known.
    """

    what: str
    value: float
    low: float
    high: float
    unit: str
    why: str = ""

    @classmethod
    def of(cls, what: str, value: float, changes: LogChanges, unit: str, of_own: str = _OF_POINTS) -> Measure:
        """Return a measure by its value and by what moves it; of_own : its own sources of error, in words."""
        low, high = changes.factors
        why = changes.main_source(of_own) if high > WIDE * low else ""
        return cls(what, float(value), float(value * low), float(value * high), unit, why)

    @property
    def is_measurable(self) -> bool:
        """Whether it is told from nothing: its interval does not begin at 0."""
        return self.low != 0

    @property
    def unit_in_words(self) -> str:
        """The unit as a person reads it: "mm²" for "mm2"."""
        return self.unit.replace("mm2", "mm²")

    def __str__(self) -> str:
        if not np.isfinite(self.value):
            return f"{self.what}: none, the surface has a gap between the points"
        value, low, high = (
            np.format_float_positional(float(f"{one:.3g}"), trim="-") for one in (self.value, self.low, self.high)
        )
        why = f"; wide mainly because of {self.why}" if self.why else ""
        if not self.is_measurable:
            return f"{self.what}: not measurable ({low} to {high} {self.unit_in_words}{why})"
        return f"{self.what}: {value} {self.unit_in_words}" + (
            f" ({low} to {high}{why})" if np.isfinite(self.low) else ""
        )


@dataclass(frozen=True)
class _Picked:
    """Pixels (N, 2) of a frame, the surface's points there, their depth, and its relative standard deviation."""

    pixels: np.ndarray
    points: list[SurfacePoint]
    depth_mm: np.ndarray
    depth_error: np.ndarray


def measure(
    result: Result | Path | str,
    frame: int,
    pixels: ArrayLike,
    reference: ArrayLike | None = None,
    reference_mm: float | None = None,
) -> list[Measure]:
    """Return distances between two pixels (2, 2) of a frame, straight and along the surface, or the area inside more.

    Each has `what`, `value`, `unit`, and `low` and `high`, the ends of its 95 % interval (docs/measure.md).
    result : opened, or its folder. pixels : x, y of the frame's rectified picture, as large as its depth map; (0, 0) is
    the middle of its first pixel. reference : two pixels (2, 2) of the same frame whose straight distance is the unit
    of what is returned, or is `reference_mm`; needed where the run's scale is unknown. Raises `InputError` where the
    frame, or a surface at a pixel, is not there, and where neither the run nor a reference gives a scale.
    """
    if reference is None and reference_mm is not None:
        raise SettingsError("a length of the reference without its two points: give both")
    run, pixels = opened(result).checked(with_poses=True), np.asarray(pixels, float)
    scale = known_scale(run, None if reference is None else Known(frame, np.asarray(reference, float), reference_mm))
    pose, mesh = _pose(run, frame), measured_mesh(run, frame)
    picked = _picked(run, mesh, frame, pose, pixels)
    if len(pixels) > 2:
        area = area_inside(mesh, pixels, run.camera, pose)
        if area <= 0:
            raise InputError(f"no surface is seen inside the polygon of frame {frame}")
        changes = _changes(run, picked, _flat_area).times(scale.changes.to_power(2))
        return [Measure.of("area", area / scale.divisor**2, changes, scale.square)]
    changes = _changes(run, picked, _straight).times(scale.changes)
    straight = _straight(np.stack([point.position for point in picked.points]))
    along = path_length(mesh, *picked.points)
    found = {"straight": straight, "along the surface": along}
    return [Measure.of(what, value / scale.divisor, changes, scale.unit) for what, value in found.items()]


@dataclass(frozen=True)
class Known:
    """A reference: two pixels (2, 2) of a frame, and their straight distance, mm; None: it is the unit."""

    frame: int
    pixels: np.ndarray
    length_mm: float | None = None


@dataclass(frozen=True)
class KnownScale:
    """The scale of a run's millimetres: what lengths are divided by, what moves lengths by it, and the unit.

    from_views : what moves lengths from many frames: they err by the focal length, and not by one frame's depth.
    words : what the scale rests on.
    """

    divisor: float
    changes: LogChanges
    from_views: LogChanges
    unit: str
    words: str

    @property
    def square(self) -> str:
        """The unit of areas."""
        return {"mm": "mm2"}.get(self.unit, "times the reference's square")


def known_scale(run: Result, known: Known | None) -> KnownScale:
    """Return the scale that a run knows, or that of a reference. Raises `InputError` where neither gives one."""
    focal_error, scale_error = focal_and_scale_errors(run)
    by_focal = LogChanges(np.array([[0, 0], _focal_changes(focal_error), [0, 0]]))
    if known is None:
        if not run.scale_known:
            raise InputError(
                f"{run.path}: {run.scale}; give two points as a reference; lengths are then relative to their "
                "distance, or in mm if that is given"
            )
        scale = LogChanges.of_scale(scale_error)
        return KnownScale(1.0, scale, scale.times(by_focal), "mm", run.scale)
    check_reference(known.pixels)
    picked = _picked(run, measured_mesh(run, known.frame), known.frame, _pose(run, known.frame), known.pixels)
    length = _straight(np.stack([point.position for point in picked.points]))
    changes = _changes(run, picked, _straight).to_power(-1)
    if known.length_mm is None:
        unit, words = "times the reference", f"two points of frame {known.frame}, whose distance in mm is not known"
    else:
        unit, words = "mm", f"two points of frame {known.frame}, taken to be {known.length_mm:g} mm apart"
    beside = replace(picked, depth_error=np.sqrt(2) * (_REFERENCE_SHARE * picked.depth_error).clip(max=_MOST_SIGMA))
    of_views = _changes(run, beside, _straight)
    of_views.shared[0] = 0  # the depth of one frame is not that of many
    from_views = of_views.to_power(-1).times(by_focal)
    return KnownScale(length / (known.length_mm or 1.0), changes, from_views, unit, words)


def check_reference(pixels: np.ndarray) -> None:
    """Raise `InputError` where a reference between two pixels (2, 2) of a frame is too short to measure by."""
    if (far_px := float(np.linalg.norm(pixels[1] - pixels[0]))) < _LEAST_REFERENCE_PX:
        raise InputError(f"the reference is {far_px:.1f} px long: {_LEAST_REFERENCE_PX} px are needed")


def _pose(run: Result, frame: int) -> np.ndarray:
    row = np.flatnonzero(run.tracked.trajectory.indices == frame)
    if len(row):
        return np.asarray(run.tracked.trajectory.T_world_camera[row[0]])
    submap = run.frames.submap[run.frames["index"] == frame]
    where = f"it is in maps/{submap[0]}, a folder of its own" if len(submap) and submap[0] > 0 else "it has no pose"
    raise InputError(f"frame {frame} is not in the result {run.path}: {where}")


def _picked(run: Result, mesh: trimesh.Trimesh, frame: int, pose: np.ndarray, pixels: np.ndarray) -> _Picked:
    points, depths = [], []
    for pixel in pixels:
        inside = (pixel >= -0.5).all() and (pixel < [run.camera.width - 0.5, run.camera.height - 0.5]).all()
        ray = run.camera.unproject(pixel)
        found = meet_surface(mesh, pose[:3, 3], pose[:3, :3] @ ray) if inside else None
        if found is None:
            size = f"{run.camera.width}x{run.camera.height} px"
            near = _nearest_surface(run, mesh, pose, pixel)
            there = "" if near is None else f"; the nearest with a surface is {near[0]},{near[1]}"
            where = f"pixel {pixel[0]:g},{pixel[1]:g} of frame {frame} (its rectified picture has {size})"
            raise InputError(f"there is no surface at {where}{there}")
        points.append(found)
        depths.append(float((found.position - pose[:3, 3]) @ pose[:3, 2]))
    depth_mm = np.array(depths)
    return _Picked(pixels, points, depth_mm, _depth_errors(run, frame, pixels, depth_mm))


def _nearest_surface(run: Result, mesh: trimesh.Trimesh, pose: np.ndarray, pixel: np.ndarray) -> tuple[int, int] | None:
    """Return the pixel (x, y) nearest to one at which the frame sees the surface; None where it sees none."""
    rows, columns = np.nonzero(np.isfinite(render_mesh(mesh, run.camera, pose).depth_mm))
    if not len(rows):
        return None
    nearest = np.argmin((columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2)
    return int(columns[nearest]), int(rows[nearest])


def _depth_errors(run: Result, frame: int, pixels: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
    """Return relative standard deviations: the run's own, or what surface and frame differ by where that is more."""
    errors, kept = np.full(len(pixels), np.nan), measured_depth(run, frame)
    if kept is not None:
        height, width = kept[0].shape
        column, row = np.floor((pixels + 0.5) * [width / run.camera.width, height / run.camera.height]).astype(int).T
        own_mm, sigma_mm = (values[row, column] for values in kept)
        errors = np.fmax(np.abs(own_mm - depth_mm), sigma_mm) / depth_mm
    return np.where(np.isfinite(errors), errors, DEPTH_ERROR)


def _focal_changes(sigma: float) -> tuple[float, float]:
    """Return the changes of ln of a length across the view as the focal length stands at its ends."""
    return -float(np.log1p(-SIGMAS * sigma)), -float(np.log1p(SIGMAS * sigma))


def _changes(run: Result, picked: _Picked, figure: Callable[[np.ndarray], np.ndarray]) -> LogChanges:
    """Return the changes of ln of a figure of the points.

    Half of the variance of a depth is that of the whole frame, half its own.
    """
    focal_error, count = focal_and_scale_errors(run)[0], len(picked.pixels)
    ends = SIGMAS * np.array([-1.0, 1.0])
    # Of each source both ends: what it does to ln depth (S, 2, N), pixels (S, 2, N, 2) and ln of the focal length.
    log_depth, pixels = np.zeros((3 * count + 2, 2, count)), np.zeros((3 * count + 2, 2, count, 2))
    log_focal = np.zeros((3 * count + 2, 2))
    half = picked.depth_error / np.sqrt(2)
    log_depth[0] = ends[:, None] * half
    log_focal[1] = np.log1p(ends * focal_error)
    for n in range(count):
        log_depth[2 + 3 * n, :, n] = ends * half[n]
        for axis in range(2):
            pixels[3 + axis + 3 * n, :, n, axis] = ends * PIXEL_ERROR_PX
    rays = run.camera.unproject(picked.pixels + pixels)
    rays[..., :2] /= np.exp(log_focal)[..., None, None]
    moved = figure(rays * (picked.depth_mm * np.exp(log_depth))[..., None])
    exact = figure(run.camera.unproject(picked.pixels) * picked.depth_mm[:, None])
    changes = np.log(np.maximum(moved, 1e-9) / np.maximum(exact, 1e-9))
    return LogChanges(np.concatenate([changes[:2], np.zeros((1, 2))]), changes[2:])


def _straight(points: np.ndarray) -> Any:
    """Return the distance of the first two of points (..., N, 3)."""
    return np.linalg.norm(points[..., 1, :] - points[..., 0, :], axis=-1)


def _flat_area(points: np.ndarray) -> Any:
    """Return the area of polygons (..., N, 3), projected to where it is largest."""
    from_first = points - points[..., :1, :]
    return 0.5 * np.linalg.norm(np.cross(from_first[..., :-1, :], from_first[..., 1:, :]).sum(axis=-2), axis=-1)
