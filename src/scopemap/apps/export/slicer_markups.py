"""What was found on a surface, and paths, as markups of 3D Slicer: mm, in the LPS axes of `export --to slicer`.

The format is that of markups-schema-v1.0.3.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


def write_markups(markups: list[dict[str, Any]], file: Path) -> None:
    """Write markups, each from `markup`, as .mrk.json."""
    file.write_text(json.dumps({"@schema": _SCHEMA, "markups": markups}, indent=1) + "\n", encoding="utf-8")


def markup(kind: str, name: str, points_mm: dict[str, np.ndarray], about: str) -> dict[str, Any]:
    """Return a markup, "Fiducial", "Curve" or "ClosedCurve", of points (3,) of the world by their labels."""
    points = [
        {"id": str(number), "label": label, "position": at.tolist(), "positionStatus": "defined"}
        for number, (label, at) in enumerate(points_mm.items(), start=1)
    ]
    return {
        "type": kind,
        "name": name,
        "description": about,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "controlPoints": points,
        "display": {"visibility": True, "pointLabelsVisibility": kind == "Fiducial"},
    }
