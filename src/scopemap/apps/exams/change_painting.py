"""The surface of the first of two examinations in colours that say what changed in its views, for films."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.apps.exams.compare_exams import ExamComparison
from scopemap.apps.view.fly_through import Painting
from scopemap.apps.view.paintings import painted
from scopemap.report.coverage_picture import OUTSIDE
from scopemap.report.sheet import rgb_of
from scopemap.result.result import Result

COMPARED = {"not compared": OUTSIDE, "as it was": "#2a9d8f", "changed": "#9b2226"}
"""Colours of what `ExamComparison.compared` counts, in its order."""


def change_painting(first: Path, found: ExamComparison) -> Painting:
    """Return the surface of the first of two examinations by where the second differs from it."""
    colours = np.array([rgb_of(colour) for colour in COMPARED.values()], np.uint8)
    return Painting(painted(Result(first).mesh, colours[found.compared[0]]), COMPARED)
