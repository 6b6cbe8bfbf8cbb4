"""Map merging and splitting: which keyframes share a world, and Sim(3) from each map's world to a common one.

Each map has a world and a unit of length of its own. A loop closure between keyframe p of one map and n of another
gives T_n_p, in the millimetres of p's depth, and the ratio exp(r) of n's depth to p's. So Sim(3) from the world of n's
map to the world of p's has

    scale exp(-r),    rotation R_p R_n_p^T R_n^T,    and takes the position of n to the position of T_p T_n_p^-1

A loop closure is accepted only if loop closures of other keyframes agree with it, and maps are merged only if they fit
after an adjustment (`adjusted_maps.py`).

Where the camera was lost and aligned again to a keyframe from before, the alignment may be wrong. If keyframes from
before and after the loss observe no points in common, nothing supports it, and the map is split there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.frame_correction import TrackedPose
from scopemap.engine.mapping.loop_closure import Loop

_MIN_SUPPORT = 2  # by hand: agreeing keyframes in either map
# Maps drift independently: two loops agree within these, rad, share of the scene's depth, ln.
_MAX_DIFFERENCE = (0.2, 0.3, 0.3)  # by hand
_MAX_LOG_SCALE = 1.0  # by hand: between maps of one video
# Observations of points in common that support a motion tracked across a loss: as many as relocalisation needs inliers.
_MIN_COMMON = 20

Part = tuple[int, int]
"""A part of a map between two losses: number of the map, and segment as in `TrackedPose`."""


class _Hypothesis(NamedTuple):
    """Sim(3) of a map by one loop: to the common world, its keyframe's pose (4, 4) in the map, both keyframes."""

    S_common_map: Similarity
    T_map_camera: np.ndarray
    own: int
    other: int


def split_maps(
    tracked: Sequence[TrackedPose], pairs: np.ndarray, relocalised: Collection[tuple[Part, Part]]
) -> dict[Part, int]:
    """Return the map of each part of the maps that has a keyframe: parts stay together where something supports it.

    tracked : poses of the K keyframes. pairs : (N, 2) int, keyframes that observe the same point. relocalised : pairs
    of parts between which features found the camera again. The first part of a map keeps its number.
    """
    parts = list(dict.fromkeys((pose.map, pose.segment) for pose in tracked))
    part_of = np.array([parts.index((pose.map, pose.segment)) for pose in tracked], dtype=int)
    common = np.zeros((len(parts), len(parts)), int)
    np.add.at(common, tuple(part_of[pairs].T), 1)
    common += common.T
    for one, other in relocalised:
        if one in parts and other in parts:
            common[parts.index(one), parts.index(other)] = common[parts.index(other), parts.index(one)] = _MIN_COMMON
    groups: list[list[int]] = []
    for k, (number, _) in enumerate(parts):
        near = [group for group in groups if parts[group[0]][0] == number and common[k, group].sum() >= _MIN_COMMON]
        groups = [group for group in groups if group not in near] + [[*chain(*near), k]]
    found: dict[Part, int] = {}
    unused = max(number for number, _ in parts) + 1 if parts else 0
    for group in sorted(groups, key=min):
        number = parts[min(group)][0]
        if number in found.values():
            number, unused = unused, unused + 1
        found |= dict.fromkeys((parts[k] for k in group), number)
    return found


def merge_maps(
    T_world_camera: np.ndarray, map_of: Sequence[int], loops: Sequence[Loop], main: int, depth_mm: float
) -> dict[int, Similarity]:
    """Return Sim(3) from the world of each map to the common world, for the main map and all that loops connect to it.

    T_world_camera : (K, 4, 4) of all keyframes, each in the world of its map. map_of : (K,) numbers of these maps.
    depth_mm : typical depth in the main map. The common world has the main map's millimetres, and its first keyframe
    has the pose that it had in its own map. Maps are in the order in which they were merged.
    """
    S_common_map = {main: Similarity.identity()}
    hypotheses: defaultdict[int, list[_Hypothesis]] = defaultdict(list)
    latest: int | None = main
    while latest is not None:
        for loop in loops:
            maps = {map_of[loop.past], map_of[loop.new]}
            if latest in maps and (number := next(iter(maps - set(S_common_map)), None)) is not None:
                hypotheses[number].append(_hypothesis(T_world_camera, map_of, loop, S_common_map, number))
        latest, most = None, 0
        for number in sorted(set(hypotheses) - set(S_common_map)):
            support, found = _best(hypotheses[number], depth_mm)
            if support > most:
                latest, most, best = number, support, found
        if latest is not None:
            S_common_map[latest] = best
    first = next(k for k, number in enumerate(map_of) if number in S_common_map)
    motion = T_world_camera[first] @ inverse(S_common_map[map_of[first]].transform_poses(T_world_camera[first]))
    moved = Similarity(1.0, motion[:3, :3], motion[:3, 3])
    return {number: moved.after(S) for number, S in S_common_map.items()}


def _hypothesis(
    T_world_camera: np.ndarray, map_of: Sequence[int], loop: Loop, S_common_map: dict[int, Similarity], number: int
) -> _Hypothesis:
    """Return Sim(3) of map `number` by a loop to a map whose Sim(3) is known."""
    T_new = T_world_camera[loop.past] @ inverse(loop.T_new_past)
    scale = float(np.exp(-loop.log_ratio))
    R = T_new[:3, :3] @ T_world_camera[loop.new, :3, :3].T
    S_past_new = Similarity(scale, R, T_new[:3, 3] - scale * R @ T_world_camera[loop.new, :3, 3])
    past, new = map_of[loop.past], map_of[loop.new]
    if new == number:
        return _Hypothesis(S_common_map[past].after(S_past_new), T_world_camera[loop.new], loop.new, loop.past)
    return _Hypothesis(S_common_map[new].after(S_past_new.inverse()), T_world_camera[loop.past], loop.past, loop.new)


def _best(hypotheses: Sequence[_Hypothesis], depth_mm: float) -> tuple[int, Similarity]:
    """Return the largest number of agreeing keyframes, on the side with fewer, and Sim(3); 0: none is accepted."""
    S, T_map_camera, own, other = zip(*hypotheses, strict=True)
    scale, R, t = (np.array([getattr(each, name) for each in S]) for name in ("scale", "R", "t"))
    own, other, centre = np.array(own), np.array(other), np.stack(T_map_camera)[:, :3, 3]
    position = scale[:, None] * np.einsum("nij,nj->ni", R, centre) + t
    best = (0, Similarity.identity())
    for k, (S_common_map, *_) in enumerate(hypotheses):
        if not abs(np.log(S_common_map.scale)) < _MAX_LOG_SCALE:
            continue
        # The trace of a relative rotation is 1 + 2 cos of its angle.
        angle_rad = np.arccos(np.clip((np.einsum("ij,nij->n", R[k], R) - 1) / 2, -1, 1))
        distance = np.linalg.norm(S_common_map.transform_points(centre) - position, axis=1) / depth_mm
        log_ratio = np.abs(np.log(scale / scale[k]))
        agree = (np.column_stack([angle_rad, distance, log_ratio]) < _MAX_DIFFERENCE).all(1)
        support = min(len(np.unique(own[agree])), len(np.unique(other[agree])))
        if support >= _MIN_SUPPORT and support > best[0]:
            best = (support, S_common_map)
    return best
