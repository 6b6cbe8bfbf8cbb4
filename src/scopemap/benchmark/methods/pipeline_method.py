"""A method that is our pipeline with some settings, and perhaps another odometry in the tracker's place."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scopemap.benchmark.methods.method import Task, Timing
from scopemap.benchmark.methods.timed import TimedTracker
from scopemap.config import Config, Preset
from scopemap.pipeline import Step
from scopemap.runner import reconstruct
from scopemap.tracking import FrameTracker

TrackerFactory = Callable[[Config], FrameTracker]


@dataclass(frozen=True)
class PipelineMethod:
    """Frames, masks and raw depth come from the same stages for all; what differs is named by its parts.

    Attributes
    ----------
    create_tracker : makes the odometry. preset, settings : what the method changes of the defaults; the task's settings
    stand between both, so that a preset cannot take away the depth that all share.
    """

    create_tracker: TrackerFactory
    preset: Preset | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    def run(self, task: Task, out: Path) -> Timing:
        """Reconstruct into `out`; raises what the pipeline raises."""
        config = Config.load(self.preset, settings=dict(task.settings) | dict(self.settings))
        tracker = TimedTracker(self.create_tracker(config))
        finished: list[float] = []

        def note(step: Step) -> None:
            finished.append(time.perf_counter())

        result = reconstruct(task.sequence, config, out=out, overwrite=True, observers=(note,), tracker=tracker)
        frames, seconds = len(result.records), result.provenance["seconds"]
        # What comes after the last frame belongs to all of them.
        afterwards = sum(seconds.get(part, 0.0) for part in ("back end", "depth corrected", "fuse"))
        return Timing(
            ms_per_frame=1e3 * ((finished[-1] - finished[0]) / max(frames - 1, 1) + afterwards / frames),
            track_ms_per_frame=1e3 * tracker.seconds / frames,
            seconds=seconds,
        )
