"""Colours of a surface that mean something, and what they mean: how sure it is, how often it was seen, how far off."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.apps.browser.shown_surface import ShownSurface, light_of
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.report.pale_parts import WORDS as PALE_WORDS
from scopemap.report.shown_mesh import SeenFrame, times_seen
from scopemap.result.result import Result

_LOOKED_AT = 25
_SAME_SURFACE = 0.1
"""Relative difference of depth up to which a frame sees a vertex, as for `times_seen`."""
_WORST_PERCENTILE = 95
_PICTURE = "picture"
_PALE = "picture, pale where unsure"
_UNKNOWN = (150, 150, 150)


@dataclass(frozen=True)
class Colouring:
    """Colours (V, 3) uint8 of a surface's vertices, what they mean in a sentence, and their scale.

    ramp : colours from low to high (256, 3); None: they are no scale. ticks : values below it, evenly spaced. picture :
    whether they are those of the tissue, which the surface's texture shows better. pale : whether what is not sure
    loses its colour.
    """

    colours: np.ndarray
    words: str
    ramp: np.ndarray | None = None
    ticks: tuple[str, ...] = ()
    picture: bool = False
    pale: bool = False


def colourings(surface: ShownSurface) -> dict[str, Callable[[], Colouring]]:
    """Return what a surface can be coloured by, by name; none is computed before it is called."""
    words = _picture_words(surface.run)
    as_it_is = {_PICTURE: lambda: Colouring(surface.colours, words, picture=True)}
    if surface.is_empty:
        return as_it_is
    found = {_PALE: lambda: Colouring(surface.colours, f"{words} {PALE_WORDS}", picture=True, pale=True)} | as_it_is
    if "confidence" in surface.mesh.vertex_attributes:
        found["confidence"] = lambda: _confidence(surface)
    has_depth = any(map(surface.run.depth.has, surface.run.tracked["index"].tolist()))
    if has_depth:
        found["times seen"] = lambda: _times_seen(surface)
    if "sigma_mm" in surface.mesh.vertex_attributes:
        found["depth deviation"] = lambda: _sigma(surface)
    elif has_depth:
        found["depth deviation"] = lambda: _disagreement(surface)
    return found


def looking_frames(run: Result, most: int = _LOOKED_AT) -> list[SeenFrame]:
    """Return tracked frames of a run that have a depth map, at most so many, evenly spread."""
    tracked = run.tracked
    rows = [row for row, index in enumerate(tracked["index"].tolist()) if run.depth.has(index)]
    found = []
    for row in rows[:: -(-len(rows) // most) or 1]:
        depth_mm = run.depth.read(int(tracked["index"][row]))
        if depth_mm is not None:
            found.append(SeenFrame(tracked["T_world_camera"][row], depth_mm))
    return found


def in_relief(facing: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Return colours (V, 3) uint8 of vertices, darker where they do not face a camera, by `facing_of`, (V,)."""
    return np.asarray(np.round(colours * light_of(facing)[:, None]), np.uint8)


def stops_of(ramp: np.ndarray, count: int = 9) -> list[str]:
    """Return evenly spaced colours "#rrggbb" of a ramp (256, 3)."""
    return ["#" + bytes(colour).hex() for colour in ramp[np.linspace(0, len(ramp) - 1, count).astype(int)]]


def _picture_words(run: Result) -> str:
    return "As in the video, in even light." if is_albedo(run) else "As in the video."


def is_albedo(run: Result) -> bool:
    """Return whether the colours of a surface are those of the tissue, without the light."""
    return bool(tomllib.loads(run.config_text).get("fusion", {}).get("colours") != "raw")


def _ramp(colour_map: int) -> np.ndarray:
    return np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], colour_map)[:, 0, ::-1])


def _coloured(values: np.ndarray, high: float, words: str, ticks: tuple[str, ...], colour_map: int) -> Colouring:
    """Return the colouring of values (V,), NaN = unknown, by a colour map from 0 to `high`."""
    ramp, known = _ramp(colour_map), np.isfinite(values)
    share = np.where(known, values, 0) / max(high, 1e-9)
    colours = ramp[np.round(255 * np.clip(share, 0, 1)).astype(int)]
    colours[~known] = _UNKNOWN
    return Colouring(colours, words, ramp, ticks)


def _confidence(surface: ShownSurface) -> Colouring:
    values = np.asarray(surface.mesh.vertex_attributes["confidence"], float).ravel()
    words = "How often, how near and how frontally the place was seen. 1 is best."
    return _coloured(values, 1.0, words, ("0", "0.5", "1"), cv2.COLORMAP_VIRIDIS)


def _times_seen(surface: ShownSurface) -> Colouring:
    frames = looking_frames(surface.run)
    count = times_seen(surface.mesh, frames, surface.run.camera)
    words = f"How many of {len(frames)} frames, spread over the video, saw the place."
    return _coloured(count, float(len(frames)), words, ("0", str(len(frames))), cv2.COLORMAP_VIRIDIS)


def _sigma(surface: ShownSurface) -> Colouring:
    values = np.asarray(surface.mesh.vertex_attributes["sigma_mm"], float).ravel()
    high, unit = _high(values), "mm" if surface.run.scale_known else "units (scale unknown)"
    words = "Standard deviation of depth."
    return _coloured(values, high, words, ("0", f"{high:.2g} {unit} and more"), cv2.COLORMAP_INFERNO)


def _disagreement(surface: ShownSurface) -> Colouring:
    values = 100 * depth_differences(surface)
    high = _high(values)
    words = "By how much the depth of frames differs from the surface. Grey: not known."
    return _coloured(values, high, words, ("0 %", f"{high:.2g} % and more"), cv2.COLORMAP_INFERNO)


def _high(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, _WORST_PERCENTILE)) if len(known) else 1.0


def depth_differences(surface: ShownSurface) -> np.ndarray:
    """Return by how much of the depth frames and a surface differ at its vertices on average, (V,), NaN: not seen."""
    vertices, camera = np.asarray(surface.mesh.vertices), surface.run.camera
    total, count = np.zeros(len(vertices)), np.zeros(len(vertices))
    for frame in looking_frames(surface.run):
        points = transform(inverse(frame.T_world_camera), vertices)
        ahead = np.flatnonzero(points[:, 2] > 0)
        height, width = frame.depth_mm.shape
        pixels = np.round(camera.project(points[ahead]) * [width / camera.width, height / camera.height]).astype(int)
        inside = ((pixels >= 0) & (pixels < [width, height])).all(axis=1)
        ahead, (column, row) = ahead[inside], pixels[inside].T
        apart = np.abs(frame.depth_mm[row, column] / points[ahead, 2] - 1)
        seen = apart < _SAME_SURFACE
        total[ahead[seen]] += apart[seen]
        count[ahead[seen]] += 1
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
