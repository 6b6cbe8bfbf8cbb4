"""The methods by the name that a plan's `use` gives."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from scopemap.benchmark.methods.endo_depth_and_motion import create_endo_depth_and_motion
from scopemap.benchmark.methods.imported import ImportedTrajectory
from scopemap.benchmark.methods.method import Method, PipelineMethod
from scopemap.benchmark.methods.open3d_odometry import Open3dTracker
from scopemap.benchmark.methods.standing_still import StandingStill
from scopemap.benchmark.plan import MethodPlan
from scopemap.errors import SettingsError
from scopemap.tracking.track import FrameTracker

# Baselines get depth as it is and keep poses as tracked: consistency over time is a part of our method alone.
PLAIN = {
    "mapis.advanced.frame_scale": "none",
    "mapis.paper.blend": "none",
    "smoothing.method": "none",
    "mapping.method": "none",
}

BASELINES: dict[str, Callable[[], FrameTracker]] = {
    "endo-depth-and-motion": create_endo_depth_and_motion,
    "steinbruecker": partial(Open3dTracker, "steinbruecker"),
    "park": partial(Open3dTracker, "park"),
    "point-to-point": partial(Open3dTracker, "point-to-point"),
    "point-to-plane": partial(Open3dTracker, "point-to-plane"),
    "standing-still": StandingStill,
}
"""Makers of the baselines' trackers; those of Open3D raise `SettingsError` where it cannot be imported."""


def create_method(plan: MethodPlan, data: Path | None, sequence: str = "", seed: int = 0) -> Method:
    """Return the method of a plan; raises `SettingsError` for an unknown one.

    data : folder of imported trajectories. sequence, seed : which of them, by the name of the sequence.
    """
    if plan.use == "import":
        return ImportedTrajectory(plan, data, sequence, seed)
    if plan.use == "scopemap":
        return PipelineMethod(plan.preset, plan.settings)
    if plan.use not in BASELINES:
        raise SettingsError(f"unknown method '{plan.use}': choose one of scopemap, import, {', '.join(BASELINES)}")
    return PipelineMethod(plan.preset, PLAIN | plan.settings, BASELINES[plan.use])
