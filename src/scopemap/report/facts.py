"""What a run's page and its summary picture show, gathered once: verdict, surfaces, submaps, frames and their depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from scopemap.report.frame_pictures import thinned
from scopemap.report.shown_maps import MapOnPage, shown_maps
from scopemap.report.shown_mesh import FACES_OF_OTHERS, MOST_FACES, simplified
from scopemap.result.frame_table import NOT_USED
from scopemap.result.result import Result
from scopemap.result.submap_summaries import SubmapSummary, most_doubtful, submaps_in_time
from scopemap.result.verdict import Verdict, verdict

_DEPTH_WIDTH_PX = 160
_EVERY = 7
"""Of the known depths, that the range of all is taken of."""
_NO_DEPTHS_MM = 1.0, 100.0
_LEAST_RANGE = 1.2


@dataclass(frozen=True)
class PicturedFrame:
    """A frame with a picture.

    index, row : its number, and its row in the run's table. jpg, mask : the content of its files. depth_mm : (h, w)
    float32, every n-th pixel, at most 160 in a row, NaN = unknown; None: none was kept.
    """

    index: int
    row: int
    jpg: bytes
    mask: bytes
    depth_mm: np.ndarray | None


@dataclass(frozen=True)
class ReportFacts:
    """What is shown of a run.

    maps : its surfaces. meshes : theirs, of few faces, world mm. frames : those used that have a picture.
    """

    run: Result
    maps: list[MapOnPage]
    meshes: list[trimesh.Trimesh]
    frames: list[PicturedFrame]

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the run can be used."""
        return verdict(self.run)

    @cached_property
    def submaps(self) -> list[SubmapSummary]:
        """The run's submaps in the order of time."""
        return submaps_in_time(self.run.frames)

    @cached_property
    def inliers(self) -> dict[int, str]:
        """What is said of the inliers of each submap, by its number."""
        worst = most_doubtful(self.submaps)
        return {one.number: one.inliers + ", most doubtful" * (one is worst) for one in self.submaps}

    @cached_property
    def submap_meshes(self) -> dict[int, trimesh.Trimesh]:
        """The mesh of the main segment of each submap that is shown, by its number."""
        shown = zip(self.maps, self.meshes, strict=True)
        return {n: mesh for n, (one, mesh) in enumerate(shown) if n == 0 or one.result is not self.run}

    @cached_property
    def depth_range_mm(self) -> tuple[float, float]:
        """The 1st and 99th percentile of all depths, mm: one range for all pictures of the run."""
        depths_mm = [frame.depth_mm for frame in self.frames if frame.depth_mm is not None]
        some = np.concatenate([np.empty(0, np.float32), *(d[np.isfinite(d)][::_EVERY] for d in depths_mm)])
        if not some.size:
            return _NO_DEPTHS_MM
        near_mm, far_mm = (float(value) for value in np.percentile(some, [1, 99]))
        return round(near_mm, 3), round(max(far_mm, _LEAST_RANGE * near_mm), 3)


def report_facts(run: Result, most_faces: int = MOST_FACES) -> ReportFacts:
    """Return what is shown of a run; most_faces : of its main surface, of others fewer. Raises as `Result` does."""
    maps = shown_maps(run)
    most = [most_faces] + [min(most_faces, FACES_OF_OTHERS)] * (len(maps) - 1)
    meshes = [simplified(one.mesh, faces) for one, faces in zip(maps, most, strict=True)]
    return ReportFacts(run, maps, meshes, _pictured_frames(run))


def _pictured_frames(run: Result) -> list[PicturedFrame]:
    rows = np.flatnonzero(run.frames.submap != NOT_USED)
    used, found = dict(zip(run.frames["index"][rows].tolist(), rows.tolist(), strict=True)), []
    for index in run.pictured:
        picture, mask = run.picture_file(index), run.mask_file(index)
        if index in used and mask.is_file():
            depth_mm = run.depth.read(index)
            few_mm = None if depth_mm is None else thinned(depth_mm, _DEPTH_WIDTH_PX)
            found.append(PicturedFrame(index, used[index], picture.read_bytes(), mask.read_bytes(), few_mm))
    return found
