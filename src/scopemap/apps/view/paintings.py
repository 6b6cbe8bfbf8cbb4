"""Surfaces in colours that mean something, for films: how sure they are, what was not seen of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import trimesh

from scopemap.apps.coverage.coverage import coverage
from scopemap.apps.view.fly_through import Painting
from scopemap.engine.errors import InputError
from scopemap.report.coverage_picture import OUTSIDE, legend_of
from scopemap.result.result import Result

_LEVELS = 0.0, 0.25, 0.5, 0.75, 1.0


def coverage_painting(folder: Path) -> Painting:
    """Return the closed surface of a run by whether a frame saw it; raises as `coverage`."""
    found = coverage(folder)
    return Painting(found.painted, legend_of(found.classes) | {"not examined": OUTSIDE})


def confidence_painting(folder: Path) -> Painting:
    """Return the surface of a run by the confidence of its vertices; `InputError` where the run does not know it."""
    mesh = Result(folder).checked().mesh
    if "confidence" not in mesh.vertex_attributes:
        raise InputError(f"{folder}: the confidence of its surface is not known")
    colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    of = np.round(255 * np.clip(mesh.vertex_attributes["confidence"], 0, 1)).astype(int)
    legend = {f"confidence {level:g}": "#" + bytes(colours[round(255 * level)]).hex() for level in _LEVELS}
    return Painting(painted(mesh, colours[of]), legend)


def painted(mesh: trimesh.Trimesh, colours: np.ndarray) -> trimesh.Trimesh:
    """Return a surface in colours (V, 3) uint8 of its vertices."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
