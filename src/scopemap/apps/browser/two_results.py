"""Two results of one video in the world of the first: how far they are apart, and what is in one alone."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from scopemap.engine.errors import AlignmentError, InputError
from scopemap.engine.geometry.align import AlignMode, Similarity
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.evaluation.poses import ErrorSummary, match, translation_errors_mm
from scopemap.result.result import Result

_ALONE_SHARE = 0.15
"""Of the distance to the camera: walls that are farther apart are not the same one, as in `compare_exams`."""

_APART = "apart"
_ALONE = "alone"
"""Attributes of a vertex: its distance to the other surface, and 1 where it is in its own alone."""

_LOOKED_AT = 25  # frames, for the median depth
_EDGE_SHARE = 1.52  # of the square root of a triangle's mean area: the edge of an equilateral one
_OF_THE_INPUT = ("files", "bytes", "sha256")


@dataclass(frozen=True)
class TwoResults:
    """Two results of one video, in the world of the first.

    S_first_second : takes points of the second there. align : how it was fitted to the paths. path_rmse : distance of
    the paths at the frames that both track. both, only_first, only_second : tracked frames. poses : of the tracked
    frames of each, (N, 4, 4). surfaces : of both, for `apart_of` and `is_alone`; None where one has none. median :
    distance of a point to the other surface, where both have one. alone : share of the area of each that is in it
    alone. depth : median depth of the first. in_mm : whether lengths are mm.
    """

    S_first_second: Similarity
    align: AlignMode
    path_rmse: float
    both: int
    only_first: int
    only_second: int
    poses: tuple[np.ndarray, np.ndarray]
    surfaces: tuple[trimesh.Trimesh, trimesh.Trimesh] | None
    median: float
    alone: tuple[float, float]
    depth: float
    in_mm: bool

    def length(self, value: float) -> str:
        """Return a length in words: in mm where the scale is known, else as a share of the median depth."""
        return f"{self.number(value)} {self.unit}"

    def number(self, value: float) -> str:
        """Return a length as a number of `unit`."""
        return f"{value:.2f}" if self.in_mm else f"{100 * value / self.depth:.1f}"

    @property
    def unit(self) -> str:
        """The unit of `number`."""
        return "mm" if self.in_mm else "% of the median depth"

    @property
    def most_apart(self) -> float:
        """Distance that has the last colour: beyond it two walls at the median depth are not the same one."""
        return _ALONE_SHARE * self.depth

    def sentences(self, first: str, second: str) -> list[str]:
        """Return what was found, a sentence each; first, second : names of the results."""
        S, counts = self.S_first_second, f"{self.only_first} by {first} alone, {self.only_second} by {second} alone"
        fit = "rotation and translation" if self.align == "se3" else f"rotation, translation and scale ({S.scale:.3f})"
        found = [
            f"{self.both} frames are tracked by both, {counts}.",
            f"After alignment by {fit} the paths are {self.length(self.path_rmse)} apart (RMSE).",
        ]
        if self.surfaces is None:
            return [*found, "One of them has no surface: the paths alone are compared."]
        percent = [f"{100 * share:.0f} %" for share in self.alone]
        return [
            *found,
            f"The surfaces are {self.length(self.median)} apart (median, where both have one).",
            f"In one alone: {percent[0]} of the surface of {first}, {percent[1]} of that of {second}. There the other "
            f"one is farther away than {100 * _ALONE_SHARE:.0f} % of the distance to the camera.",
            "Where they differ, neither is confirmed.",
        ]

    def command(self, first: str, second: str) -> str:
        """Return the command that gives the distance of the paths (`ate_rmse_mm`, in the unit of the first)."""
        return shlex.join(["scopemap", "evaluate", second, "--truth", first, "--align", self.align])


def is_same_input(first: Result, second: Result) -> bool:
    """Return whether two results are of one input: by its content where both know it, else by its name."""
    contents = [dict(run.provenance.get("input_content") or {}) for run in (first, second)]
    if all("sha256" in content for content in contents):
        return all(contents[0].get(name) == contents[1].get(name) for name in _OF_THE_INPUT)
    one, other = (run.provenance.get("input_absolute") or run.provenance.get("input") for run in (first, second))
    return one is not None and one == other


def compare_results(first: Result, second: Result) -> TwoResults:
    """Compare two results of one video, the largest submap of each.

    The path of the second is brought onto that of the first at the frames that both track: by SE(3) where both scales
    are known, else by Sim(3). Raises `InputError` where the frames do not determine that.
    """
    align: AlignMode = "se3" if first.scale_known and second.scale_known else "sim3"
    try:
        matched = match(second.trajectory, first.trajectory, align)
    except AlignmentError as error:
        raise InputError(f"the results cannot be compared: {error}") from None
    S = matched.similarity
    off = translation_errors_mm(matched.aligned, matched.reference)[matched.tracked]
    tables = [run.frames.only(run.frames.tracked) for run in (first, second)]
    poses = tables[0]["T_world_camera"], S.transform_poses(tables[1]["T_world_camera"])
    one, other = (set(table["index"].tolist()) for table in tables)
    depth = _median_depth(first, poses[0])
    surfaces = _surfaces(first.mesh, second.mesh, S)
    shared = [np.zeros(0)]
    for surface, path in zip(surfaces or (), poses, strict=False):
        apart = apart_of(surface)
        away = cKDTree(path[:, :3, 3]).query(np.asarray(surface.vertices), workers=-1)[0]
        surface.vertex_attributes[_ALONE] = (apart > _ALONE_SHARE * np.maximum(away, depth)).astype(float)
        shared.append(apart[~is_alone(surface)])
    return TwoResults(
        S_first_second=S,
        align=align,
        path_rmse=ErrorSummary.of(off).rmse,
        both=len(off),
        only_first=len(one - other),
        only_second=len(other - one),
        poses=poses,
        surfaces=surfaces,
        median=float(np.median(np.concatenate(shared))) if sum(map(len, shared)) else float("nan"),
        alone=(_alone(surfaces[0]), _alone(surfaces[1])) if surfaces else (0.0, 0.0),
        depth=depth,
        in_mm=first.scale_known,
    )


def _median_depth(run: Result, poses: np.ndarray) -> float:
    """Return the median depth of a run; without depth maps that from the path to the surface; 1 where there is none."""
    if run.depth.present:
        indices = run.frames["index"][run.frames.tracked]
        looked = indices[:: -(-len(indices) // _LOOKED_AT)].tolist()
        medians = [np.nanmedian(depth) for index in looked if (depth := run.depth.read(index)) is not None]
        if medians:
            return float(np.median(medians))
    if not len(run.mesh.vertices):
        return 1.0
    return float(np.median(cKDTree(poses[:, :3, 3]).query(np.asarray(run.mesh.vertices))[0]))


def _surfaces(
    first: trimesh.Trimesh, second: trimesh.Trimesh, S: Similarity
) -> tuple[trimesh.Trimesh, trimesh.Trimesh] | None:
    if not len(first.faces) or not len(second.faces):
        return None
    one, other = _coloured(first), _coloured(second)
    other.vertices = S.transform_points(np.asarray(second.vertices))
    for surface, beside in ((one, other), (other, one)):
        surface.vertex_attributes[_APART] = _distances(np.asarray(surface.vertices), beside)
    return one, other


def _coloured(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    colours: Any = vertex_colours(mesh)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)


def _distances(points: np.ndarray, surface: trimesh.Trimesh) -> np.ndarray:
    """Return the distances of points (N, 3) to a surface: to the plane of its nearest vertex, where that is near."""
    vertices, normals = np.asarray(surface.vertices), np.asarray(surface.vertex_normals)
    distance, nearest = cKDTree(vertices).query(points, workers=-1)
    height = np.abs(np.einsum("ij,ij->i", normals[nearest], points - vertices[nearest]))
    aside = np.sqrt(np.maximum(distance**2 - height**2, 0))
    area = trimesh.triangles.area(vertices[surface.faces])
    has_normal = np.linalg.norm(normals[nearest], axis=1) > 0.5
    return np.where(has_normal & (aside <= _EDGE_SHARE * np.sqrt(area.mean())), height, distance)


def apart_of(surface: trimesh.Trimesh) -> np.ndarray:
    """Return the distances (V,) of the vertices of one of the surfaces, or of what is shown of it, to the other one."""
    apart: Any = surface.vertex_attributes[_APART]
    return np.asarray(apart)


def is_alone(surface: trimesh.Trimesh) -> np.ndarray:
    """Return which vertices (V,) of one of the surfaces, or of what is shown of it, are in it alone."""
    alone: Any = surface.vertex_attributes[_ALONE]
    return np.asarray(np.asarray(alone) > 0.5)


def _alone(surface: trimesh.Trimesh) -> float:
    """Return the share of a surface's area that is in it alone."""
    faces = np.asarray(surface.faces)
    area = trimesh.triangles.area(np.asarray(surface.vertices)[faces])
    return float(area @ is_alone(surface)[faces].mean(axis=1) / max(area.sum(), 1e-12))
