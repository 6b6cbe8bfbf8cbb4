"""Map merging: known Sim(3) are recovered, and a single loop closure is not accepted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, se3_exp, so3_exp
from scopemap.engine.mapping.loop_closure import Loop
from scopemap.engine.mapping.pose_graph import merge_maps

DEPTH_MM = 50.0
# Of nine keyframes; the second map is left and entered again.
MAP_OF = [0, 0, 0, 1, 1, 2, 2, 1, 1]
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25, deadline=None)


class _Scene:
    """Keyframes with true poses, and their poses in the world and the millimetres of their map."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        twists = np.column_stack([rng.normal(0, 0.3, (len(MAP_OF), 3)), rng.normal(0, 15, (len(MAP_OF), 3))])
        self.true = np.stack([se3_exp(twist) for twist in twists])
        self.true[0] = np.eye(4)
        # Sim(3) from the true world to each map's.
        self.S_map_true = {
            number: Similarity(
                float(np.exp(rng.uniform(-0.45, 0.45))), so3_exp(rng.normal(size=3)), rng.normal(0, 40, 3)
            )
            for number in (1, 2)
        } | {0: Similarity.identity()}
        self.poses = np.stack(
            [self.S_map_true[m].transform_poses(pose) for m, pose in zip(MAP_OF, self.true, strict=True)]
        )

    def loop(self, past: int, new: int) -> Loop:
        scale_past, scale_new = (self.S_map_true[MAP_OF[k]].scale for k in (past, new))
        T_new_past = inverse(self.true[new]) @ self.true[past]
        T_new_past[:3, 3] *= scale_past
        nothing = np.zeros((0, 2))
        return Loop(past, new, T_new_past, float(np.log(scale_new / scale_past)), *(nothing,) * 4)


@few
@given(seeds, st.sampled_from([0, 1]))
def test_relative_poses_are_recovered_in_the_unit_of_the_main_map_and_the_first_keyframe_is_held(
    seed: int, main: int
) -> None:
    scene = _Scene(seed)
    # No motion at all agrees with a true loop by chance, in one of a thousand scenes; a turn by a radian never does.
    right = scene.loop(1, 4)
    false = replace(right, T_new_past=right.T_new_past @ se3_exp(np.array([0, 0, 1.0, 0, 0, 0])))
    # The third map is connected to the second only, by loops in both directions of time.
    loops = [false, scene.loop(0, 3), scene.loop(2, 7), scene.loop(4, 5), scene.loop(6, 8)]
    worlds = merge_maps(scene.poses, MAP_OF, loops, main, DEPTH_MM)
    assert sorted(worlds) == [0, 1, 2]
    assert worlds[main].scale == 1
    poses = [worlds[number].transform_poses(pose) for number, pose in zip(MAP_OF, scene.poses, strict=True)]
    for pose, true in zip(poses, scene.true, strict=True):
        expected = inverse(scene.true[0]) @ true
        expected[:3, 3] *= scene.S_map_true[main].scale
        np.testing.assert_allclose(pose, scene.poses[0] @ expected, atol=1e-6)


def test_single_or_contradicting_loops_are_not_accepted() -> None:
    scene = _Scene(0)
    true, other = scene.loop(0, 3), scene.loop(2, 7)
    turned = replace(other, T_new_past=se3_exp(np.array([0, 0.3, 0, 0, 0, 0])) @ other.T_new_past)
    moved = replace(other, T_new_past=se3_exp(np.array([0, 0, 0, 0, 40.0, 0])) @ other.T_new_past)
    larger = replace(other, log_ratio=other.log_ratio + 0.4)
    within = scene.loop(0, 2)
    beside = scene.loop(0, 8)  # of the same keyframe as the first
    for loops in ([], [true], [true, within], [true, turned], [true, moved], [true, larger], [true, beside]):
        assert list(merge_maps(scene.poses, MAP_OF, loops, 0, DEPTH_MM)) == [0]
    # Nor is an impossible scale.
    scene.S_map_true[1] = replace(scene.S_map_true[1], scale=3.0)
    assert list(merge_maps(scene.poses, MAP_OF, [scene.loop(0, 3), scene.loop(2, 7)], 0, DEPTH_MM)) == [0]
