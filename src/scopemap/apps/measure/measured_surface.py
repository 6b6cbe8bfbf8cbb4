"""What is measured on: the surface of a frame, of few triangles, its depth, and what errs in a run."""

from __future__ import annotations

import numpy as np
import trimesh

from scopemap.engine.errors import reporting
from scopemap.report.frame_pictures import thinned
from scopemap.report.shown_mesh import FACES_OF_OTHERS, MOST_FACES, simplified
from scopemap.result.result import Result

_DEPTH_WIDTH_PX = 160
"""Depths are read at most this finely: so the intervals were tested (docs/measure.md)."""
_ASSUMED_FOCAL_ERROR = 0.15
"""Of a focal length by an assumed field of view: 70 degrees stand for 60 to 83."""
_SCALE_ERROR = {True: 0.02, False: 0.1}
"""Of a scale by measured depth; by a stated range of depth or by a network that was trained on metric depth."""
PIXEL_ERROR_PX = 1.0
"""Standard deviation of where a person clicks (by hand)."""
DEPTH_ERROR = 0.05
"""Standard deviation of a depth over the depth, where the run estimated none: the limit of a good surface."""


def measured_mesh(run: Result, frame: int) -> trimesh.Trimesh:
    """Return the surface of a run, or of a submap in `maps/N`, at a frame, of few triangles: paths on it take no time.

    A vertex is off by a part of the triangles' size, which is far below the errors of depth.
    """
    segment = run.segment_at(frame)
    is_main = segment == run.main_segment and not run.is_submap
    return simplified(run.surface(segment), MOST_FACES if is_main else FACES_OF_OTHERS)


def measured_depth(run: Result, frame: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return a frame's depth and its standard deviation, mm, every n-th pixel, at most 160 in a row; None: not kept.

    (h, w) float32, NaN = unknown.
    """
    depth_mm, sigma_mm = run.depth.read(frame), run.depth.read_sigma(frame)
    if depth_mm is None:
        return None
    sigma_mm = np.full_like(depth_mm, np.nan) if sigma_mm is None else sigma_mm
    return thinned(depth_mm, _DEPTH_WIDTH_PX), thinned(sigma_mm, _DEPTH_WIDTH_PX)


def focal_and_scale_errors(run: Result) -> tuple[float, float]:
    """Return standard deviations of a run's focal length and scale, as shares of them.

    Raises `InputError` where provenance.json does not say what it should of camera and scale.
    """
    with reporting(f"cannot read what {run.path}/provenance.json says of camera and scale"):
        camera, scale = run.provenance["camera"], run.provenance.get("scale") or {}
        focal = float(camera.get("focal_sigma_px") or 0.0) / run.camera.fx
        if camera.get("origin") == "assumed":
            focal = max(focal, _ASSUMED_FOCAL_ERROR)
        return focal, _SCALE_ERROR[bool(scale.get("measured"))]
