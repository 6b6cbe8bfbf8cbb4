"""Brings the second of two examinations to the first: keyframes of either are located in the map of the other.

Either way gives pairs of points. The way whose pairs agree better is kept: on a laparoscopy they were 32 % of the depth
apart one way, 11 % the other way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scopemap.apps.exams.examination import Examination
from scopemap.apps.locate.locate import NOT_FOUND, PlaceMap
from scopemap.engine.errors import AlignmentError, InputError
from scopemap.engine.geometry.align import Similarity, umeyama
from scopemap.engine.geometry.se3 import transform
from scopemap.runner.reread_frames import reread_frames

LEAST_PAIRS = 30
"""In the view of a keyframe, and of all."""
_OUTLIERS = 2.5  # pairs farther apart than so many medians are left out, so many times
_FITS = 8
_LEAST_SHARE = 0.5  # of the pairs of the other way: fewer may agree because they are few


class Correspondences3D(NamedTuple):
    """Points of two surfaces that show the same place, (N, 3) mm, each in its own world."""

    first: np.ndarray
    second: np.ndarray


class Registration(NamedTuple):
    """How the second of two examinations lies in the world of the first.

    S_first_second : of all pairs. residual : median distance of pairs after it, over the median depth, of both worlds
    the larger: it does not depend on which is the first. pairs : by which it was found. located_first, located_second :
    shares of the keyframes of each that were found in the map of the other. by_second : whether the pairs are those of
    the keyframes of the second, else of the first.
    """

    S_first_second: Similarity
    residual: float
    pairs: Correspondences3D
    located_first: float
    located_second: float
    by_second: bool


def register(one: Examination, other: Examination) -> Registration:
    """Return the registration whose pairs agree better, by keyframes of the second or of the first; main maps alone.

    Raises `InputError` where neither is found in the other, or an input is gone.
    """
    forth, second = _correspondences(one, other)
    back, first = _correspondences(other, one)
    shares = first / len(one.poses), second / len(other.poses)
    found, refusal = [], ""
    for pairs, by_second in ((forth, True), (Correspondences3D(back.second, back.first), False)):
        if len(pairs.first) < LEAST_PAIRS:
            continue
        try:
            S, residual = _agreement(pairs, one.depth_mm, other.depth_mm)
        except AlignmentError as error:
            refusal = f"; {error}"
        else:
            found.append(Registration(S, residual, pairs, *shares, by_second))
    if not found:
        located = f"{second} of {len(other.poses)} keyframes of {other.folder} were found in the map of {one.folder}"
        located += f", {first} of {len(one.poses)} the other way"
        raise InputError(f"the examinations cannot be compared: {located}{refusal}")
    most = max(len(way.pairs.first) for way in found)
    enough = [way for way in found if len(way.pairs.first) >= _LEAST_SHARE * most]
    return min(enough, key=lambda way: way.residual)


def robust_similarity(pairs: Correspondences3D) -> tuple[Similarity, np.ndarray]:
    """Return the similarity of most pairs, and the distance (N,) of all after it, mm of the first."""
    kept = np.ones(len(pairs.first), bool)
    for _ in range(_FITS):
        S = umeyama(pairs.second[kept], pairs.first[kept], True)
        distance = np.linalg.norm(S.transform_points(pairs.second) - pairs.first, axis=1)
        kept = distance <= _OUTLIERS * np.median(distance[kept])
    return S, distance


def _agreement(pairs: Correspondences3D, first_mm: float, second_mm: float) -> tuple[Similarity, float]:
    """Return the similarity of pairs, and their residual; first_mm, second_mm : median depths."""
    S, in_first_mm = robust_similarity(pairs)
    _, in_second_mm = robust_similarity(Correspondences3D(pairs.second, pairs.first))
    return S, max(float(np.median(in_first_mm)) / first_mm, float(np.median(in_second_mm)) / second_mm)


def _correspondences(one: Examination, other: Examination) -> tuple[Correspondences3D, int]:
    """Return the pairs by the keyframes of the other that are located in the main map of one; how many these are."""
    places = PlaceMap(one.run)
    first, second, located = [np.zeros((0, 3))], [np.zeros((0, 3))], 0
    for frame in reread_frames(other.folder, set(other.poses), other.source):
        found, depth_mm = places.locate(frame), other.run.depth.read(frame.index)
        if found.status == NOT_FOUND or found.map or depth_mm is None:
            continue
        located += 1
        column, row = np.rint(found.pixels).astype(int).T
        z = np.where(frame.valid, depth_mm, np.nan)[row, column]
        points = transform(other.poses[frame.index], frame.camera.unproject(found.pixels) * z[:, None])
        first.append(found.points_mm[np.isfinite(z)])
        second.append(points[np.isfinite(z)])
    return Correspondences3D(np.concatenate(first), np.concatenate(second)), located
