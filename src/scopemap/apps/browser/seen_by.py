"""Which frames saw places of the surface, and at which pixels: by their poses, and by their depth there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scopemap.apps.browser.shown_surface import ShownSurface, SurfacePick
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.result.result import Result

_SAME_SURFACE = 0.05
"""Relative difference of a frame's depth and the distance of what it sees."""
_MARGIN_PX = 2
_MOST_TRIED = 150
_LEAST_COSINE = 0.05


@dataclass(frozen=True)
class Sight:
    """A frame that saw places: its number, their pixels (N, 2), and how well it saw them, px/mm."""

    frame: int
    pixels: np.ndarray
    px_per_mm: float


def frames_that_saw(surface: ShownSurface, picks: Sequence[SurfacePick], always: int | None = None) -> list[Sight]:
    """Return the frames of a surface's segment that saw all of some places, the one that saw them best first.

    Of many frames 150 are tried, evenly spread over those whose picture holds the places, and the frame `always`.
    """
    run, found = surface.run, []
    tracked, camera = surface.frames, run.camera  # others have another surface
    normals = np.array([surface.normal(pick) for pick in picks])
    places = np.array([surface.position(pick) for pick in picks])
    for index, pose in zip(tracked["index"].tolist(), tracked["T_world_camera"], strict=True):
        points = transform(inverse(pose), places)
        if (points[:, 2] <= 0).any():
            continue
        pixels = camera.project(points)
        inside = (pixels >= _MARGIN_PX) & (pixels <= [camera.width - 1 - _MARGIN_PX, camera.height - 1 - _MARGIN_PX])
        if inside.all():
            rays = places - pose[:3, 3]
            far_mm = np.linalg.norm(rays, axis=1)
            facing = np.abs((normals * rays).sum(1)) / far_mm
            clear = float((np.maximum(facing, _LEAST_COSINE) * camera.fx / far_mm).min())
            found.append((Sight(index, pixels, clear), points[:, 2]))
    every = -(-len(found) // _MOST_TRIED) or 1
    tried = [one for number, one in enumerate(found) if number % every == 0 or one[0].frame == always]
    seen = [sight for sight, depth_mm in tried if _is_seen(surface, sight, depth_mm, places)]
    return sorted(seen, key=lambda sight: -sight.px_per_mm)


def corners_in(surface: ShownSurface, frame: int, picks: Sequence[SurfacePick]) -> np.ndarray:
    """Return the pixels (N, 2) of places in a frame, NaN behind it. Raises `InputError` where it has no pose."""
    if frame not in surface.run.tracked["index"]:
        raise InputError(f"frame {frame} has no pose in this submap: choose a tracked frame")
    places = np.array([surface.position(pick) for pick in picks])
    return surface.run.camera.project(transform(inverse(pose_of(surface.run, frame)), places))


def _is_seen(surface: ShownSurface, sight: Sight, far_mm: np.ndarray, places: np.ndarray) -> bool:
    """Return whether nothing is in front of places (N, 3) at a depth (N,)."""
    depth_mm = surface.run.depth.read(sight.frame)
    return all(
        _is_clear(surface, sight.frame, np.nan if depth_mm is None else float(depth_mm[row, column]), far, place)
        for (column, row), far, place in zip(np.round(sight.pixels).astype(int), far_mm, places, strict=True)
    )


def _is_clear(surface: ShownSurface, index: int, depth_mm: float, far_mm: float, place: np.ndarray) -> bool:
    """Return whether a frame sees a place: by its depth there, where that is NaN by the surface."""
    if np.isfinite(depth_mm):
        return abs(depth_mm / far_mm - 1) < _SAME_SURFACE
    eye = pose_of(surface.run, index)[:3, 3]
    met = surface.pick(eye, place - eye)
    return met is not None and bool(
        np.linalg.norm(surface.position(met) - place) < _SAME_SURFACE * np.linalg.norm(place - eye)
    )


def pose_of(run: Result, index: int) -> np.ndarray:
    """Return the pose (4, 4) of a tracked frame of a submap."""
    tracked = run.tracked
    return np.asarray(tracked["T_world_camera"][tracked["index"] == index][0])
