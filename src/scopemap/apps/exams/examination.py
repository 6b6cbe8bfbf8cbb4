"""One of two examinations that are compared: what a result's folder has of its keyframes and its surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.report.reference_scale import holds_for, in_mm, reference_scale
from scopemap.result.result import Result

HIDDEN = 0.15
"""Of depth: farther apart the surfaces are not the same wall."""


def to_mm(run: Result) -> float:
    """Return what lengths of a result are multiplied by, by the reference of its main segment; 1 where none is kept."""
    known = reference_scale(run)
    return known.factor if known is not None and holds_for(known, run, run.main_segment) else 1.0


def as_compared(folder: Path) -> Result:
    """Return the first of two examinations as their comparison has it: in mm where `to_mm` gives its scale."""
    run = Result(folder)
    return in_mm(run, run.main_segment)


class Examination:
    """A result: poses of its keyframes, of the frames that it kept a picture of, and its surface.

    source : where its input is now; else it is looked for. depth_mm : the median. Raises `InputError` where the folder
    holds no finished run with depth and surface.
    """

    def __init__(self, folder: Path, source: Path | None = None) -> None:
        self.folder, self.source = folder, source
        self.run = Result(folder, source).checked()
        if not self.run.depth.present:
            raise InputError(f"the run {folder} kept no depth maps")
        if not len(self.run.mesh.faces):
            raise InputError(f"the run {folder} has no surface")
        tracked = self.run.frames.only(self.run.frames.tracked)
        poses = dict(zip(tracked["index"].tolist(), tracked["T_world_camera"], strict=True))
        known = sorted(poses.keys() & (set(tracked["keyframe"].tolist()) or poses.keys()))
        self.poses = {index: poses[index] for index in known}
        self.shown = {index: poses[index] for index in self.run.pictured if index in poses} or self.poses
        medians = [np.nanmedian(depth) for index in known if (depth := self.run.depth.read(index)) is not None]
        self.depth_mm = float(np.median(medians))

    def best_view(self, place_mm: np.ndarray) -> int:
        """Return the number of the shown frame in whose middle a place (3,) is, near and not hidden; -1: none."""
        camera, best = self.run.camera, (-1, 0.0)
        for index, pose in self.shown.items():
            point, depth_mm = transform(inverse(pose), place_mm[None])[0], self.run.depth.read(index)
            if depth_mm is None or point[2] <= 0:
                continue
            x, y = camera.project(point[None])[0]
            if 0 <= x <= camera.width - 1 and 0 <= y <= camera.height - 1:
                off = np.hypot(x / camera.width - 0.5, y / camera.height - 0.5)
                score = (1 - off) / point[2]
                is_seen = abs(depth_mm[round(y), round(x)] / point[2] - 1) < 2 * HIDDEN
                best = max(best, (index, score), key=lambda pair: pair[1]) if is_seen else best
        return best[0]
