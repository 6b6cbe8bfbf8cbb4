"""Alignment: identities, optimality, degenerate cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scopemap.engine.errors import AlignmentError
from scopemap.engine.geometry.align import Similarity, align_trajectories, umeyama
from scopemap.engine.geometry.se3 import rotation_angle_rad, se3_exp, so3_exp

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25, deadline=None)


def random_similarity(rng: np.random.Generator) -> Similarity:
    return Similarity(rng.uniform(0.1, 10), so3_exp(rng.normal(size=3)), rng.normal(scale=50, size=3))


def random_poses(rng: np.random.Generator, count: int = 12) -> np.ndarray:
    return np.stack([se3_exp(np.concatenate([rng.normal(size=3), rng.normal(scale=20, size=3)])) for _ in range(count)])


@few
@given(seeds)
def test_umeyama_finds_the_similarity_that_was_applied(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, true = rng.normal(scale=20, size=(8, 3)), random_similarity(rng)
    found = umeyama(points, true.transform_points(points), with_scale=True)
    assert found.scale == pytest.approx(true.scale, rel=1e-9)
    np.testing.assert_allclose(found.R, true.R, atol=1e-9)
    np.testing.assert_allclose(found.t, true.t, atol=1e-6)


@few
@given(seeds)
def test_umeyama_is_a_rotation_and_no_nearby_similarity_fits_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Unrelated clouds: the reflection branch (det U det V < 0) comes up in half of them.
    a, b = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    found = umeyama(a, b, with_scale=True)
    assert np.linalg.det(found.R) == pytest.approx(1.0)

    def cost(similarity: Similarity) -> float:
        return float(np.sum((similarity.transform_points(a) - b) ** 2))

    for step in (1e-3, 0.3):
        moved = so3_exp(rng.normal(scale=step, size=3)) @ found.R
        near = Similarity(found.scale * np.exp(rng.normal(scale=step)), moved, found.t + rng.normal(scale=step, size=3))
        assert cost(found) <= cost(near) + 1e-12


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_line_and_single_place_are_refused_with_the_singular_values(offset: float) -> None:
    rng = np.random.default_rng(1)
    direction = np.array([0.3, -0.5, 0.8])
    line = offset + np.linspace(0, 50, 40)[:, None] * direction
    with pytest.raises(AlignmentError, match=r"on one line.*singular values"):
        umeyama(line, line, with_scale=True)
    with pytest.raises(AlignmentError, match="in one place"):
        umeyama(np.full((40, 3), offset + 0.1), rng.normal(size=(40, 3)), with_scale=True)


def test_a_plane_is_accepted() -> None:
    rng = np.random.default_rng(2)
    plane = rng.normal(size=(20, 3)) * [1, 1, 0]
    R = so3_exp(np.array([0.2, -0.4, 0.9]))
    np.testing.assert_allclose(umeyama(plane, plane @ R.T, with_scale=True).R, R, atol=1e-10)


@few
@given(seeds, st.sampled_from([0.0, 0.2]))
def test_about_a_straight_path_orientations_decide(seed: int, width_mm: float) -> None:
    rng = np.random.default_rng(seed)
    truth, true = random_poses(rng, 60), random_similarity(rng)
    line = rng.normal(size=(60, 3)) * [20, width_mm, width_mm]
    truth[:, :3, 3] = line @ so3_exp(rng.normal(size=3)).T + [3, 1, 90]
    noisy = truth.copy()
    noisy[:, :3, 3] += rng.normal(scale=0.1, size=(60, 3)) * (width_mm > 0)
    moved = true.inverse().transform_poses(noisy)
    aligned, found = align_trajectories(moved, truth, "sim3", by_orientations=True)
    assert found.straight
    assert rotation_angle_rad(np.swapaxes(aligned[:, :3, :3], 1, 2) @ truth[:, :3, :3]).max() < 0.01
    assert np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.6
    # Neither does a straight estimate of a bent path tell it.
    bent = truth.copy()
    bent[:, :3, 3] += 3 * np.sin(truth[:, :1, 3]) * [[0.0, 1.0, 0.3]]
    aligned, found = align_trajectories(moved, bent, "sim3", by_orientations=True)
    assert found.straight
    assert rotation_angle_rad(np.swapaxes(aligned[:, :3, :3], 1, 2) @ truth[:, :3, :3]).mean() < 0.5
    curved, other = random_poses(rng), random_poses(rng)
    as_evo, found = (align_trajectories(curved, other, "se3", by_orientations=by) for by in (False, True))
    assert not found[1].straight
    np.testing.assert_array_equal(found[0], as_evo[0])


@few
@given(seeds)
def test_sim3_of_the_truth_comes_back_and_rotations_turn_with_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng)
    moved = random_similarity(rng).transform_poses(truth)
    aligned, _ = align_trajectories(moved, truth, "sim3")
    np.testing.assert_allclose(aligned, truth, atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(moved[:, :3, :3]), 1.0)


def test_origin_puts_the_first_pose_onto_the_first_and_none_moves_nothing() -> None:
    rng = np.random.default_rng(3)
    estimated, reference = random_poses(rng), random_poses(rng)
    aligned, similarity = align_trajectories(estimated, reference, "origin")
    np.testing.assert_allclose(aligned[0], reference[0], atol=1e-10)
    np.testing.assert_allclose(np.linalg.inv(aligned[0]) @ aligned[5], np.linalg.inv(estimated[0]) @ estimated[5])
    assert similarity.scale == 1.0
    np.testing.assert_array_equal(align_trajectories(estimated, reference, "none")[0], estimated)


def test_unknown_mode_and_unequal_lengths_are_refused() -> None:
    poses = random_poses(np.random.default_rng(4))
    with pytest.raises(AlignmentError, match="choose none, origin, se3, sim3 or scale"):
        align_trajectories(poses, poses, "sim4")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="reference"):
        align_trajectories(poses, poses[1:], "se3")


@few
@given(seeds, st.sampled_from(["se3", "sim3", "scale"]))
def test_the_first_frames_alone_decide_the_fit_and_all_are_moved(seed: int, mode: str) -> None:
    rng = np.random.default_rng(seed)
    estimated, reference = random_poses(rng), random_poses(rng)
    aligned, similarity = align_trajectories(estimated, reference, mode, first=5)  # type: ignore[arg-type]
    _, alone = align_trajectories(estimated[:5], reference[:5], mode)  # type: ignore[arg-type]
    np.testing.assert_array_equal(similarity.t, alone.t)
    np.testing.assert_array_equal(aligned, alone.transform_poses(estimated))
    everywhere = align_trajectories(estimated, reference, mode, first=len(estimated) + 7)[0]  # type: ignore[arg-type]
    np.testing.assert_array_equal(everywhere, align_trajectories(estimated, reference, mode)[0])  # type: ignore[arg - type]


def test_what_cannot_be_fitted_is_refused() -> None:
    rng = np.random.default_rng(5)
    poses = random_poses(rng)
    for mode in ("none", "origin"):
        with pytest.raises(AlignmentError, match=f"'{mode}' fits none"):
            align_trajectories(poses, poses, mode, first=5)  # type: ignore[arg-type]
    with pytest.raises(AlignmentError, match="at least 3"):
        align_trajectories(poses, poses, "se3", first=2)
    poses[:6, :3, 3] = np.arange(6)[:, None] * np.array([1.0, 2.0, 3.0])
    for mode in ("se3", "sim3", "scale"):
        with pytest.raises(AlignmentError, match=r"on one line.*singular values"):
            align_trajectories(poses, poses, mode, first=6)  # type: ignore[arg-type]
        assert align_trajectories(poses, poses, mode)[1].scale == pytest.approx(1)  # type: ignore[arg-type]
