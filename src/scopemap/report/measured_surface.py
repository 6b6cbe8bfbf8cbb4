"""What `scopemap measure` and the report's page measure on, the same for both: triangles, depths, errors."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import trimesh

from scopemap.engine.errors import reporting
from scopemap.report.shown_mesh import LARGEST_LEVEL, levels_of, simplified
from scopemap.result.result import Result

MOST_FACES = 100_000
FACES_OF_OTHERS = 20_000
DEPTH_WIDTH_PX = 160
_ASSUMED_FOCAL_ERROR = 0.15
"""Of a focal length by an assumed field of view: 70 degrees stand for 60 to 83."""
_SCALE_ERROR = {True: 0.02, False: 0.1}
"""Of a scale by measured depth; by a stated range of depth or by a network that was trained on metric depth."""
_OTHERS = {
    "pixel_px": 1.0,
    # Standard deviation of a depth over the depth, where the run estimated none: the limit of a good surface.
    "depth": 0.05,
    # A shorter reference errs by more than a pixel at each end allows.
    "reference_px": 10,
}


def measured_mesh(run: Result, frame: int) -> trimesh.Trimesh:
    """Return the surface of a run, or of a submap in `maps/N`, as `report.html` shows it at a frame, of few triangles.

    A vertex is off by a part of the shown triangles' size, which is far below the errors of depth.
    """
    segment = run.segment_at(frame)
    is_main = segment == run.main_segment and not run.is_submap
    mesh = simplified(run.surface(segment), MOST_FACES if is_main else FACES_OF_OTHERS)
    low, spread, levels = levels_of(mesh)
    return trimesh.Trimesh(low + levels / LARGEST_LEVEL * spread, mesh.faces, process=False)


def measured_depth(run: Result, frame: int) -> np.ndarray | None:
    """Return a frame's depth as the page holds it: every n-th pixel, at most 160 in a row.

    (h, w, 3) uint8: the upper and lower byte of the depth in the run's unit, 0 = unknown, and the level of its standard
    deviation, whose share of the depth is in `DepthReader.sigma_shares`.
    """
    coded = run.depth.read_coded(frame)
    if coded is None:
        return None
    width = min(coded.shape[1], DEPTH_WIDTH_PX)
    size = (width, max(1, round(coded.shape[0] * width / coded.shape[1])))
    return np.asarray(cv2.resize(coded, size, interpolation=cv2.INTER_NEAREST))


def measure_errors(run: Result) -> dict[str, Any]:
    """Return standard deviations, shares of focal length, scale and depth, and of a pixel; and what else is needed.

    Raises `InputError` where provenance.json does not say what it should of camera and scale.
    """
    with reporting(f"cannot read what {run.path}/provenance.json says of camera and scale"):
        camera, scale = run.provenance["camera"], run.provenance.get("scale") or {}
        focal = float(camera.get("focal_sigma_px") or 0.0) / run.camera.fx
        if camera.get("origin") == "assumed":
            focal = max(focal, _ASSUMED_FOCAL_ERROR)
        return {"focal": focal, "scale": _SCALE_ERROR[bool(scale.get("measured"))], **_OTHERS}
