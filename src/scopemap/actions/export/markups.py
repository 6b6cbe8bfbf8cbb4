"""What was found on a surface, and paths, as markups of 3D Slicer: mm, in the LPS axes of `export --to slicer`.

The format is that of markups-schema-v1.0.3.json.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.actions.measure import Measure

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


@dataclass(frozen=True)
class SurfaceFinding:
    """Something on the surface of a run: its outline, or its place.

    points_mm : (N, 3) around it, or (1, 3), world. sizes : NaN for the ends of an interval that is not known.
    """

    name: str
    points_mm: np.ndarray
    sizes: list[Measure]

    def __str__(self) -> str:
        return f"{self.name}: {'; '.join(map(str, self.sizes))}"


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


def markups_of(findings: list[SurfaceFinding], about: str) -> list[dict[str, Any]]:
    """Return a list of the places, and a closed curve of each outline; about : what sizes and points rest on."""
    places = {str(one): one.points_mm[0] for one in findings if len(one.points_mm) == 1}
    found = [markup("Fiducial", "findings", places, about)] if places else []
    for one in findings:
        if len(one.points_mm) > 1:
            points = {f"{one.name} {number}": at for number, at in enumerate(one.points_mm, start=1)}
            found.append(markup("ClosedCurve", one.name, points, f"{one}; {about}"))
    return found
