"""The methods by the name that a plan's `use` gives."""

from __future__ import annotations

from pathlib import Path

from scopemap.benchmark.methods.endo_depth_and_motion import create_endo_depth_and_motion
from scopemap.benchmark.methods.imported import ImportedTrajectory
from scopemap.benchmark.methods.method import Method
from scopemap.benchmark.methods.open3d_odometry import OPEN3D_METHODS
from scopemap.benchmark.methods.pipeline_method import PipelineMethod, TrackerFactory
from scopemap.benchmark.methods.standing_still import StandingStill
from scopemap.benchmark.plan import MethodPlan
from scopemap.config import Config
from scopemap.errors import SettingsError
from scopemap.tracking import FrameTracker, Tracker

# Depth as it is and poses as tracked: consistency over time is a part of our method, not of the input that all share.
PLAIN = {
    "mapis.advanced.frame_scale": "none",
    "mapis.paper.blend": "none",
    "smoothing.method": "none",
    "mapping.method": "none",
}


def create_method(plan: MethodPlan, data: Path | None) -> Method:
    """Return the method that a plan names; raises `SettingsError` for an unknown one.

    `data` is the folder below which imported trajectories lie.
    """
    if plan.use == "import":
        return ImportedTrajectory(plan, data)
    if plan.use == "scopemap":
        return PipelineMethod(_ours, preset=plan.preset, settings=plan.settings)
    if plan.use not in BASELINES:
        raise SettingsError(f"unknown method '{plan.use}': choose one of scopemap, import, {', '.join(BASELINES)}")
    return PipelineMethod(BASELINES[plan.use], preset=plan.preset, settings=PLAIN | plan.settings)


def _ours(config: Config) -> FrameTracker:
    return Tracker(config.tracking)


def _open3d(title: str) -> TrackerFactory:
    return lambda config: OPEN3D_METHODS[title]()


BASELINES: dict[str, TrackerFactory] = {
    "endo-depth-and-motion": lambda config: create_endo_depth_and_motion(),
    "steinbruecker": _open3d("Steinbruecker (Open3D)"),
    "park": _open3d("Park (Open3D)"),
    "point-to-point": _open3d("Point-to-point ICP (Open3D)"),
    "point-to-plane": _open3d("Point-to-plane ICP (Open3D)"),
    "standing-still": lambda config: StandingStill(),
}
"""Odometries of others, each on plain depth."""
