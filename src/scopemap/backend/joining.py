"""Maps of one video, each with a world and millimetres of its own, put into one world by the loops between them.

A loop between keyframe p of one map and n of another says where n was as seen from p, T_n_p, in the millimetres of p's
depth, and how much larger n's depth is, exp(r). So the world of n's map lies in that of p's as the similarity

    scale exp(-r),    rotation R_p R_n_p^T R_n^T,    which takes n's place to the place of T_p T_n_p^-1

Landmarks that look alike by chance say anything; so one loop is believed only as far as others bear it out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scopemap.backend.loops import Loop
from scopemap.geometry.align import Similarity
from scopemap.geometry.se3 import inverse, rotation_angle_rad

_LEAST_AGREEING = 2
# Maps drift, each by itself: rad, share of the scene's depth, ln.
_ALIKE = (0.2, 0.3, 0.3)


class _Word(NamedTuple):
    """What one loop says of a map: how its world lies, and the pose (4, 4) in it of the keyframe that was looked at."""

    lies: Similarity
    T_map_camera: np.ndarray


def join_maps(
    T_world_camera: np.ndarray, map_of: Sequence[int], loops: Sequence[Loop], main: int, depth_mm: float
) -> dict[int, Similarity]:
    """Return how the world of each map that loops tie to the main one lies in the common world, the main one's too.

    T_world_camera : (K, 4, 4) of all keyframes, each in the world of its map. map_of : (K,) numbers of these maps.
    depth_mm : typical depth in the main one. The common world has the main map's millimetres, and the first of the
    keyframes that are in it is where it was in its own.
    """
    lies = {main: Similarity.identity()}
    while True:
        best: tuple[int, int, Similarity] | None = None
        for number in sorted(set(map_of) - set(lies)):
            words = [
                _word(T_world_camera, map_of, loop, lies, number)
                for loop in loops
                if {map_of[loop.past], map_of[loop.new]} & set(lies) and number in (map_of[loop.past], map_of[loop.new])
            ]
            for one in words:
                agreeing = sum(_alike(one, other, depth_mm) for other in words)
                if agreeing >= _LEAST_AGREEING and (best is None or agreeing > best[0]):
                    best = (agreeing, number, one.lies)
        if best is None:
            return _from_the_first(T_world_camera, map_of, lies)
        lies[best[1]] = best[2]


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
        return _Word(lies[past].after(new_in_past), T_world_camera[loop.new])
    return _Word(lies[new].after(new_in_past.inverse()), T_world_camera[loop.past])


def _alike(one: _Word, other: _Word, depth_mm: float) -> bool:
    """Whether two loops put the keyframe that the second one looked at in the same place."""
    pose, its = one.lies.transform_poses(other.T_map_camera), other.lies.transform_poses(other.T_map_camera)
    turn_rad = float(rotation_angle_rad(pose[:3, :3].T @ its[:3, :3]))
    way = float(np.linalg.norm(pose[:3, 3] - its[:3, 3])) / depth_mm
    ratio = abs(float(np.log(one.lies.scale / other.lies.scale)))
    return turn_rad < _ALIKE[0] and way < _ALIKE[1] and ratio < _ALIKE[2]


def _from_the_first(
    T_world_camera: np.ndarray, map_of: Sequence[int], lies: dict[int, Similarity]
) -> dict[int, Similarity]:
    """Return the same with the first keyframe's pose as it was in its own map."""
    first = next(k for k, number in enumerate(map_of) if number in lies)
    moved = T_world_camera[first] @ inverse(lies[map_of[first]].transform_poses(T_world_camera[first]))
    common = Similarity(1.0, moved[:3, :3], moved[:3, 3])
    return {number: common.after(world) for number, world in lies.items()}
