"""Compares two examinations of a place: the second one's surface in the map of the first, and where they differ.

Keyframes of either are located in the map of the other (`registration`). Matched features, with the depth of both, pair
points of the two surfaces. In the view of each keyframe of either, the similarity of the pairs in sight brings the
other surface to its own one: drift, and a wall that is wider as a whole, are no change. Both are rendered there.
Features alone leave the two pictures some pixels apart, so smooth optical flow warps the other one onto the own. A
change is where shape or colour, beside what is around the place, differ by far more than they do in most places, in
more than one view. Colours are those of the surfaces, without lamp and exposure: of them the ratio of red to green.
Changes are judged only where the two surfaces fit (`fit`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scopemap.apps.exams.change import Change, changes_of_both
from scopemap.apps.exams.examination import HIDDEN, Examination, to_mm
from scopemap.apps.exams.fit import ExamFit, fit_of
from scopemap.apps.exams.registration import LEAST_PAIRS, Correspondences3D, Registration, register, robust_similarity
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import AlignmentError
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.flow.estimator import FlowEstimator, pair_flow
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.local_contrast import local_mean
from scopemap.engine.geometry.rendering import Rendering, render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.geometry.warp import pull

_AROUND_SHARE = 0.1  # of the picture's width: standard deviation of what is around a place
_CONSISTENCY_PX = 1.0  # of flow there and back
_FLOW_SHARE = 0.05  # of the picture's width: standard deviation of the Gaussian that smooths flow
_BLOB_SHARE = 0.012  # of the median depth: standard deviation of the mean of a place
_FARTHEST = 1.5  # of the median depth: farther away depth and colours tell little
_ON_SURFACE = 0.02  # of depth: a vertex is not hidden
_LEAST_VIEWS = 4
_LEAST_SPREADS = 0.002, 0.005  # of ln depth and redness, in most places: rounding
_LEAST_SIGMAS = 8.0  # of a change
_LEAST_AREA_SHARE = 0.01  # its area, of the squared median depth
_SHOWN_VIEWS = 8  # how far apart they are: distance over depth, and angle between the views
_SAME_VIEW = 0.8
_APART = 0.08  # of depth, from the other surface: only one of them saw it


@dataclass(frozen=True)
class ExamComparison:
    """Two examinations in the world of the first, in mm where a reference gives its scale (`as_compared`).

    registration : of all pairs, and how well they agree. second : its surface in the world of the first. changes : what
    the views of both show, then the surest; none where the two do not fit. views : numbers of frames of both that show
    the same places. only_first, only_second : shares of the surfaces' vertices that are far from the other one.
    compared : of the vertices of each surface in its own views, (V,) uint8: 0 where they were not compared, 1 where
    nothing changed, 2 where something did.
    """

    registration: Registration
    second: trimesh.Trimesh
    changes: list[Change]
    views: list[tuple[int, int]]
    only_first: float
    only_second: float
    compared: tuple[np.ndarray, np.ndarray]

    @property
    def fit(self) -> ExamFit:
        """Whether the two fit; changes are judged only where they do."""
        return fit_of(self.registration.residual, self.only_first, self.only_second)


def compare_exams(
    first: Path, second: Path, first_source: Path | None = None, second_source: Path | None = None
) -> ExamComparison:
    """Compare the results of two examinations; their main maps alone.

    first_source, second_source : where their inputs are now; else they are looked for. Raises `InputError` where a
    folder holds no finished run with depth and surface, an input is gone, or neither is found in the other.
    """
    one, other = Examination(first, first_source), Examination(second, second_source)
    found = register(one, other)
    S, moved = found.S_first_second, other.run.mesh.copy()
    moved.vertices = S.transform_points(np.asarray(moved.vertices))
    tree = [cKDTree(np.asarray(mesh.vertices)) for mesh in (one.run.mesh, moved)]
    only = [float((tree[1 - n].query(tree[n].data)[0] > _APART * one.depth_mm).mean()) for n in (0, 1)]
    changes, compared = list[Change](), [np.zeros(len(exam.run.mesh.vertices), np.uint8) for exam in (one, other)]
    if fit_of(found.residual, *only) is not ExamFit.NONE:
        back = Correspondences3D(found.pairs.second, found.pairs.first)
        of_first, compared[0] = _changes(one, other, S, _differences(one, other.run.mesh, found.pairs))
        of_second, compared[1] = _changes(other, one, S.inverse(), _differences(other, one.run.mesh, back))
        in_first = [change.of_second(S) for change in of_second]
        changes = changes_of_both(of_first, in_first, found.residual * one.depth_mm)
    views = _views(one, other, S)
    every = ExamComparison(found, moved, changes, views, only[0], only[1], (compared[0], compared[1]))
    return _enlarged(every, to_mm(one.run))


def _enlarged(found: ExamComparison, factor: float) -> ExamComparison:
    """Return a comparison in a world of the first whose lengths are times a factor."""
    by = found.registration
    S = replace(by.S_first_second, scale=by.S_first_second.scale * factor, t=by.S_first_second.t * factor)
    pairs = by.pairs._replace(first=by.pairs.first * factor)
    second = found.second.copy()
    second.vertices = np.asarray(second.vertices) * factor
    return replace(
        found,
        registration=by._replace(S_first_second=S, pairs=pairs),
        second=second,
        changes=[change.enlarged(factor) for change in found.changes],
    )


def _views(one: Examination, other: Examination, S: Similarity) -> list[tuple[int, int]]:
    """Return some shown frames of the first, each with that of the second whose pose is nearest, if it is near."""
    number, poses = [*other.shown], S.transform_poses(np.array([*other.shown.values()]))
    nearest: dict[int, tuple[float, int]] = {}
    for index in [*one.shown][:: -(-len(one.shown) // _SHOWN_VIEWS)]:
        T = inverse(one.shown[index]) @ poses
        apart = np.linalg.norm(T[:, :3, 3], axis=1) / one.depth_mm + np.arccos(np.clip(T[:, 2, 2], -1, 1))
        there = int(apart.argmin())
        if apart[there] < nearest.get(there, (_SAME_VIEW, 0))[0]:
            nearest[there] = float(apart[there]), index
    return sorted((index, number[there]) for there, (_, index) in nearest.items())


class _Difference(NamedTuple):
    """Over the vertices (V,) of the first surface: in how many views they were compared, and mean differences.

    nearer : of ln depth, the first less the second. redness : of ln red over green. depth_mm : of the first.
    """

    views: np.ndarray
    nearer: np.ndarray
    redness: np.ndarray
    depth_mm: np.ndarray


def _differences(one: Examination, second: trimesh.Trimesh, pairs: Correspondences3D) -> _Difference:
    """Return how the second surface differs from the first one in the views of the first one's keyframes."""
    mesh = one.run.mesh
    views, total, flow = np.zeros(len(mesh.vertices), int), np.zeros((3, len(mesh.vertices))), DisFlow()
    for pose in one.poses.values():
        in_sight, _, _ = _pixels(one.run.camera, pose, pairs.first)
        if len(in_sight) < LEAST_PAIRS:
            continue
        try:
            S, _ = robust_similarity(Correspondences3D(pairs.first[in_sight], pairs.second[in_sight]))
        except AlignmentError:
            continue
        aligned = second.copy()
        aligned.vertices = S.transform_points(np.asarray(second.vertices))
        own, there = (render_mesh(surface, one.run.camera, pose) for surface in (mesh, aligned))
        there = _matched(own, there, flow)
        nearer, same = _compared(own, there)
        same &= own.depth_mm < _FARTHEST * one.depth_mm
        if not same.any():
            continue
        width_px = _BLOB_SHARE * one.depth_mm * one.run.camera.fx / float(np.median(own.depth_mm[same]))
        both = nearer, _redness(there.rgb) - _redness(own.rgb)
        shown = [_local_difference(values, same, width_px) for values in both]
        seen, (column, row), z_mm = _pixels(one.run.camera, pose, np.asarray(mesh.vertices))
        fine = same[row, column] & (np.abs(own.depth_mm[row, column] / z_mm - 1) < _ON_SURFACE)
        views[seen[fine]] += 1
        total[:, seen[fine]] += [*(values[row[fine], column[fine]] for values in shown), z_mm[fine]]
    return _Difference(views, *(total / np.maximum(views, 1)))


def _compared(own: Rendering, there: Rendering) -> tuple[np.ndarray, np.ndarray]:
    """Return ln of own depth over the other one (H, W), and where both show the same wall, (H, W) bool."""
    with np.errstate(invalid="ignore"):
        nearer = np.log(own.depth_mm / there.depth_mm)
    return nearer, np.abs(nearer) < HIDDEN


def _matched(own: Rendering, there: Rendering, flow: FlowEstimator) -> Rendering:
    """Return the other rendering, warped onto the own one by smooth flow, so that what is new keeps its shape.

    Where the pictures have nothing in common flow is not consistent: there it counts as 0.
    """
    _, same = _compared(own, there)
    weight, sigma_px = same.astype(np.float32), _FLOW_SHARE * same.shape[1]
    found = pair_flow(flow, np.where(same[..., None], there.rgb, own.rgb), own.rgb, _CONSISTENCY_PX)
    parts = np.moveaxis(np.where(found.consistent[..., None], found.to_previous, np.float32(0)), -1, 0)
    smooth = np.stack([local_mean(part, sigma_px, weight) for part in parts], -1)
    return Rendering(pull(there.depth_mm, smooth), pull(there.rgb, smooth))


def _pixels(
    camera: PinholeCamera, pose: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return which points (N, 3) are in a picture, their columns and rows, and their depth, mm."""
    seen = transform(inverse(pose), points)
    ahead = np.flatnonzero(seen[:, 2] > 0)
    column, row = np.rint(camera.project(seen[ahead])).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return ahead[inside], (column[inside], row[inside]), seen[ahead[inside], 2]


def _redness(rgb: np.ndarray) -> np.ndarray:
    """Return ln of red over green (H, W) float32."""
    levels = np.log(np.maximum(rgb[..., :2].astype(np.float32), 4.0))
    return np.asarray(levels[..., 0] - levels[..., 1])


def _local_difference(values: np.ndarray, known: np.ndarray, width_px: float) -> np.ndarray:
    """Return a band-pass of values (H, W): the mean over a place less that around it; 0 where nothing is known."""
    weight, kept = known.astype(np.float32), np.where(known, values, 0).astype(np.float32)
    beside = kept - local_mean(kept, _AROUND_SHARE * values.shape[1], weight)
    return np.where(known, local_mean(beside, width_px, weight), np.float32(0))


def _changes(
    one: Examination, other: Examination, S: Similarity, found: _Difference
) -> tuple[list[Change], np.ndarray]:
    """Return the changes in the views of one, in its world, and which of its vertices were compared."""
    compared = found.views >= _LEAST_VIEWS
    state = compared.astype(np.uint8)
    sigmas = np.full((2, len(compared)), np.nan, np.float32)
    if not compared.any():
        return [], state
    for row, (values, least) in enumerate(zip((found.nearer, found.redness), _LEAST_SPREADS, strict=True)):
        spread = 1.4826 * np.median(np.abs(values[compared] - np.median(values[compared])))
        sigmas[row, compared] = (values[compared] - np.median(values[compared])) / max(spread, least)
    sure = np.nan_to_num(np.abs(sigmas).max(0))
    mesh = one.run.mesh
    changed = sure > _LEAST_SIGMAS
    edges = mesh.edges_unique[changed[mesh.edges_unique].all(1)]
    links = coo_matrix((np.ones(len(edges)), edges.T), (len(sure), len(sure)))
    label = np.where(changed, connected_components(links, directed=False)[1], -1)
    area = np.zeros(len(sure))
    np.add.at(area, mesh.faces.ravel(), np.repeat(mesh.area_faces / 3, 3))
    back, changes = S.inverse(), []
    for number in np.unique(label[changed]):
        own = np.flatnonzero(label == number)
        if area[own].sum() < _LEAST_AREA_SHARE * one.depth_mm**2:
            continue
        state[own] = 2
        place = np.average(np.asarray(mesh.vertices)[own], axis=0, weights=area[own])
        rows = np.abs(sigmas[:, own]).max(1) > _LEAST_SIGMAS
        what = " and ".join(name for name, is_one in zip(("shape", "colour"), rows, strict=True) if is_one)
        frames = one.best_view(place), other.best_view(back.transform_points(place))
        peak = own[np.argmax(sure[own])]
        means = float((found.nearer * found.depth_mm)[peak]), float(found.redness[peak])
        facts = float(area[own].sum()), *means, float(sure[peak]), int(found.views[own].max())
        changes.append(Change(what, place, *facts, frames))
    return changes, state
