"""Maps of one video, each with a world and millimetres of its own, put into one world by the loops between them.

A loop between keyframe p of one map and n of another says where n was as seen from p, T_n_p, in the millimetres of p's
depth, and how much larger n's depth is, exp(r). So the world of n's map lies in that of p's as the similarity

    scale exp(-r),    rotation R_p R_n_p^T R_n^T,    which takes n's place to the place of T_p T_n_p^-1

One loop is believed only as far as others, of other keyframes, bear it out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scopemap.geometry.align import Similarity
from scopemap.geometry.se3 import inverse
from scopemap.mapping.loop_closure import Loop

_LEAST_AGREEING = 2  # keyframes on either side
# Maps drift, each by itself: rad, share of the scene's depth, ln.
_ALIKE = (0.2, 0.3, 0.3)
_LARGEST_LOG_SCALE = 1.0  # no depth estimate is so much off in one map of a video and right in another


class _Word(NamedTuple):
    """What one loop says of a map: how its world lies, its keyframe's pose (4, 4) in it, numbers of both keyframes."""

    lies: Similarity
    T_map_camera: np.ndarray
    own: int
    other: int


def join_maps(
    T_world_camera: np.ndarray, map_of: Sequence[int], loops: Sequence[Loop], main: int, depth_mm: float
) -> dict[int, Similarity]:
    """Return how the world of each map that loops tie to the main one lies in the common world, the main one's too.

    T_world_camera : (K, 4, 4) of all keyframes, each in the world of its map. map_of : (K,) numbers of these maps.
    depth_mm : typical depth in the main one. The common world has the main map's millimetres, and the first of the
    keyframes that are in it is where it was in its own. Maps are in the order in which they were joined.
    """
    lies = {main: Similarity.identity()}
    words: defaultdict[int, list[_Word]] = defaultdict(list)
    latest: int | None = main
    while latest is not None:
        for loop in loops:
            maps = {map_of[loop.past], map_of[loop.new]}
            if latest in maps and (number := next(iter(maps - set(lies)), None)) is not None:
                words[number].append(_word(T_world_camera, map_of, loop, lies, number))
        latest, most = None, 0
        for number in sorted(set(words) - set(lies)):
            supported, world = _best(words[number], depth_mm)
            if supported > most:
                latest, most, best = number, supported, world
        if latest is not None:
            lies[latest] = best
    return _from_the_first(T_world_camera, map_of, lies)


def _word(
    T_world_camera: np.ndarray, map_of: Sequence[int], loop: Loop, lies: dict[int, Similarity], number: int
) -> _Word:
    """What a loop between map `number` and one whose place is known says of the former."""
    T_new = T_world_camera[loop.past] @ inverse(loop.T_new_past)
    scale = float(np.exp(-loop.log_ratio))
    R = T_new[:3, :3] @ T_world_camera[loop.new, :3, :3].T
    new_in_past = Similarity(scale, R, T_new[:3, 3] - scale * R @ T_world_camera[loop.new, :3, 3])
    past, new = map_of[loop.past], map_of[loop.new]
    if new == number:
        return _Word(lies[past].after(new_in_past), T_world_camera[loop.new], loop.new, loop.past)
    return _Word(lies[new].after(new_in_past.inverse()), T_world_camera[loop.past], loop.past, loop.new)


def _best(words: Sequence[_Word], depth_mm: float) -> tuple[int, Similarity]:
    """Return what most loops agree on, and how many keyframes do, on the side that has fewer; 0: nothing is believed.

    Two loops agree where they put the keyframe that the second one looked at in the same place.
    """
    scale = np.array([word.lies.scale for word in words])
    R, t = np.stack([word.lies.R for word in words]), np.stack([word.lies.t for word in words])
    T = np.stack([word.T_map_camera for word in words])
    own, other = np.array([word.own for word in words]), np.array([word.other for word in words])
    place = scale[:, None] * np.einsum("nij,nj->ni", R, T[:, :3, 3]) + t
    best = (0, Similarity.identity())
    for k, word in enumerate(words):
        if not abs(np.log(word.lies.scale)) < _LARGEST_LOG_SCALE:
            continue
        # The trace of the turn between two rotations is 1 + 2 cos of its angle.
        turn_rad = np.arccos(np.clip((np.einsum("ij,nij->n", R[k], R) - 1) / 2, -1, 1))
        way = np.linalg.norm(word.lies.transform_points(T[:, :3, 3]) - place, axis=1) / depth_mm
        alike = (turn_rad < _ALIKE[0]) & (way < _ALIKE[1]) & (np.abs(np.log(scale / scale[k])) < _ALIKE[2])
        supported = min(len(np.unique(own[alike])), len(np.unique(other[alike])))
        if supported >= _LEAST_AGREEING and supported > best[0]:
            best = (supported, word.lies)
    return best


def _from_the_first(
    T_world_camera: np.ndarray, map_of: Sequence[int], lies: dict[int, Similarity]
) -> dict[int, Similarity]:
    """Return the same with the first keyframe's pose as it was in its own map."""
    first = next(k for k, number in enumerate(map_of) if number in lies)
    moved = T_world_camera[first] @ inverse(lies[map_of[first]].transform_poses(T_world_camera[first]))
    common = Similarity(1.0, moved[:3, :3], moved[:3, 3])
    return {number: common.after(world) for number, world in lies.items()}
