"""The methods of a benchmark by the name that a plan's `use` gives, and those that are a run of our pipeline."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from scopemap.engine.config import Config
from scopemap.engine.errors import SettingsError
from scopemap.engine.odometry import Step
from scopemap.engine.tracking.track import FrameTracker
from scopemap.input.sequence import Sequence
from scopemap.runner.estimators import missing_packages, missing_weights
from scopemap.runner.reconstruct import reconstruct
from scopemap_bench.methods.baselines import (
    INSTALL_OPEN3D,
    OPEN3D_METHODS,
    Open3dTracker,
    StandingStill,
    create_endo_depth_and_motion,
)
from scopemap_bench.methods.colmap import Colmap
from scopemap_bench.methods.imported import ImportedTrajectory
from scopemap_bench.plan import MethodPlan

# Baselines get depth as it is and keep poses as tracked: consistency over time is a part of our method alone.
PLAIN = {
    "smoothing.method": "none",
    "mapping.method": "none",
    "mapis.frame_scale": "none",
    "mapis.blend": "none",
}

BASELINES: dict[str, Callable[[], FrameTracker]] = {
    "endo-depth-and-motion": create_endo_depth_and_motion,
    **{name: partial(Open3dTracker, name) for name in OPEN3D_METHODS},
    "standing-still": StandingStill,
}
"""Makers of the baselines' trackers; those of Open3D raise `SettingsError` where it cannot be imported."""


def what_networks_lack(config: Config, *flows: str) -> str:
    """Return the packages and weights of networks that this machine does not have; "" where it has all.

    flows : names of flows that are needed besides those of the settings.
    """
    names = missing_weights(config, *flows, verified=True)
    weights = f"needs weights: {', '.join(names)} (scopemap models pull NAME)" if names else ""
    return "; ".join(filter(None, [missing_packages(config, *flows), weights]))


@dataclass(frozen=True)
class PipelineMethod:
    """A run of the pipeline as `scopemap run` does it; a baseline replaces the tracker and gets plain depth."""

    plan: MethodPlan

    def config(self, settings: Mapping[str, Any]) -> Config:
        """Return the preset, then the shared `settings` (it cannot replace a depth that they name), then its own."""
        plain = {} if self.plan.use == "scopemap" else PLAIN
        return Config.load(self.plan.preset, settings={**settings, **self.plan.settings, **plain})

    def missing(self, settings: Mapping[str, Any]) -> str:
        """Return the packages and weights that are not on this machine, or damaged, and how to get them."""
        lacks_open3d = self.plan.use in OPEN3D_METHODS and find_spec("open3d") is None
        needs = [f"needs Open3D: {INSTALL_OPEN3D}" if lacks_open3d else "", what_networks_lack(self.config(settings))]
        return "; ".join(filter(None, needs))

    def run(self, sequence: Sequence, settings: Mapping[str, Any], out: Path) -> dict[str, float]:
        """Reconstruct into `out` and return the times of the run's own clock; raises what the pipeline raises.

        "ms_per_frame" is from the first finished frame to the last, without start-up; "track_ms_per_frame" is tracking,
        depth refinement and the choice of keyframes.
        """
        tracker = None if self.plan.use == "scopemap" else BASELINES[self.plan.use]()
        finished: list[float] = []

        def note(step: Step) -> None:
            finished.append(time.perf_counter())

        config = self.config(settings)
        result = reconstruct(sequence, config, out=out, overwrite=True, observers=(note,), tracker=tracker)
        frames, seconds = len(result.frames), result.provenance["seconds"]
        # Work after the last frame counts for all frames.
        afterwards = sum(seconds.get(part, 0.0) for part in ("back end", "depth corrected", "fuse"))
        return {
            "ms_per_frame": 1e3 * ((finished[-1] - finished[0]) / max(frames - 1, 1) + afterwards / frames),
            "track_ms_per_frame": 1e3 * seconds["track"] / frames,
            **{f"seconds_{stage.replace(' ', '_')}": value for stage, value in seconds.items()},
        }


Method = PipelineMethod | ImportedTrajectory | Colmap
"""Turns frames, whose truth it must not read, and the settings of all methods into a run's folder."""


def create_method(plan: MethodPlan, data: Path | None, sequence: str = "", seed: int = 0) -> Method:
    """Return the method of a plan, for imports that of a sequence and seed; `SettingsError` for an unknown one."""
    if plan.use == "import":
        return ImportedTrajectory(plan, data, sequence, seed)
    if plan.use == "colmap":
        return Colmap(plan)
    if plan.use != "scopemap" and plan.use not in BASELINES:
        known = ", ".join(("scopemap", "import", "colmap", *BASELINES))
        raise SettingsError(f"unknown method '{plan.use}': choose one of {known}")
    return PipelineMethod(plan)
