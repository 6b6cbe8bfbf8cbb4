"""The tracker after Endo-Depth-and-Motion, and standing still."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import TrackingSettings
from scopemap.engine.errors import AlignmentError
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import rotation_angle_rad
from scopemap.engine.tracking.pyramid import build_pyramid
from scopemap.engine.tracking.track import FrameTracker
from scopemap.evaluation.doubts import evaluate_poses
from scopemap.input.opening import open_sequence
from scopemap.result.result import Result
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reconstruct import reconstruct
from scopemap_bench.methods.baselines import SETTINGS, StandingStill, create_endo_depth_and_motion
from tests.support.tiny_phantom import FRAMES, true_poses, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

PLAIN = {
    **{"mapis__frame_scale": "none", "mapis__blend": "none", "networks__flow": "none"},
    **{"mapping__method": "none", "fusion__enabled": False},
}
CAMERA = PinholeCamera(40.0, 40.0, 31.5, 23.5, 64, 48)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom"))


def _run(folder: Path, tracker: FrameTracker) -> Result:
    return reconstruct(open_sequence(folder), with_true_depth(folder, **PLAIN), tracker=tracker)


def _frame(index: int = 0, *, usable: bool = True) -> Frame:
    shape = (CAMERA.height, CAMERA.width)
    grey = np.random.default_rng(index).integers(40, 200, (*shape, 1), dtype=np.uint8)
    depth_mm = np.full(shape, 30, np.float32)
    return Frame(index, index / 30, np.repeat(grey, 3, -1), CAMERA, np.full(shape, usable), depth_mm)


# ---- Endo-Depth-and-Motion


def test_with_true_depth_it_beats_standing_still_by_far(folder: Path) -> None:
    truth = true_poses(folder)
    errors_mm = {}
    for name, tracker in {"edam": create_endo_depth_and_motion(), "still": StandingStill()}.items():
        result = _run(folder, tracker)
        assert not len(result.lost)
        difference = result.trajectory.T_world_camera[:, :3, 3] - truth[:, :3, 3]
        errors_mm[name] = float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
        if name == "edam":
            keyframes = result.frames["keyframe"].tolist()
            assert keyframes == [0, *(2 * ((i - 1) // 2) for i in range(1, FRAMES))]
            turned = np.swapaxes(truth[:, :3, :3], 1, 2) @ result.trajectory.T_world_camera[:, :3, :3]
            assert np.degrees(rotation_angle_rad(turned)).max() < 0.7
    assert errors_mm["still"] > 1.5
    assert errors_mm["edam"] < 0.15 * errors_mm["still"]


def test_two_scales_and_grey_values_alone() -> None:
    frame = _frame()
    assert [view.weight.shape for view in build_pyramid(frame, SETTINGS)] == [(48, 64), (24, 32)]
    # Of the settings that make our tracker what it is, none is left.
    ours = TrackingSettings()
    for name in ("photometric", "solver"):
        assert getattr(SETTINGS, name) != getattr(ours, name)
    assert SETTINGS.photometry.depth_weight == SETTINGS.min_keyframe_agreement == SETTINGS.corner_depth_sigma == 0
    assert SETTINGS.picture_checks is SETTINGS.pose_checks is False
    assert SETTINGS.relocalisation_keyframes == SETTINGS.new_map_after == 0


def test_a_black_frame_in_a_run_is_lost_and_tracking_goes_on(tmp_path: Path) -> None:
    folder = write_tiny(tmp_path / "interrupted", events="black:3-3", frames=6)
    for tracker in (create_endo_depth_and_motion(), StandingStill()):
        result = _run(folder, tracker)
        assert result.lost["index"].tolist() == [3]
        assert result.frames["status"][-1] == "ok"


# ---- standing still


def test_standing_still_scores_the_motion_itself(folder: Path) -> None:
    estimate, reference = _run(folder, StandingStill()).trajectory, read_trajectory(folder)
    report = evaluate_poses(estimate, reference, "origin")
    way_mm = np.linalg.norm(true_poses(folder)[:, :3, 3], axis=1)
    assert report["ate_rmse_mm"] == pytest.approx(float(np.sqrt(np.mean(way_mm**2))), rel=1e-6)
    assert report["tlr"] == 0
    with pytest.raises(AlignmentError, match="in one place"):
        evaluate_poses(estimate, reference, "sim3")


# ---- real frames
