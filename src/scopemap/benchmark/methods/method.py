"""What every method of a benchmark has in common, and the methods that are a run of our pipeline."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from scopemap.config import Config, Preset
from scopemap.io.sequence import Sequence
from scopemap.pipeline import Step
from scopemap.runner import reconstruct
from scopemap.tracking import FrameTracker


@dataclass(frozen=True)
class Task:
    """The input of a method: all methods get the same frames, camera, masks and depth.

    Attributes
    ----------
    sequence : rectified frames; a method reads `frames()`, never the truth.
    settings : dotted names to values, shared by all methods: depth and its anchor, masks, fusion.
    seed : for methods that are random. name : of the sequence.
    """

    sequence: Sequence
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    name: str = ""


@dataclass(frozen=True)
class Timing:
    """How long a method took; NaN where it was not measured (an imported trajectory).

    Attributes
    ----------
    ms_per_frame : wall time from the first finished frame to the last, per frame, without start-up.
    track_ms_per_frame : time of the tracking thread alone, see `PipelineMethod`.
    seconds : by stage; stages in different threads overlap.
    """

    ms_per_frame: float = math.nan
    track_ms_per_frame: float = math.nan
    seconds: Mapping[str, float] = field(default_factory=dict)


class Method(Protocol):
    """Turns a task into a run's folder, which the same code then scores for all methods."""

    def run(self, task: Task, out: Path) -> Timing:
        """Write at least trajectory.tum, frames.csv and provenance.json to `out`; raises any error of the method."""


@dataclass(frozen=True)
class PipelineMethod:
    """A run of the pipeline. A baseline replaces the tracker; frames, masks and raw depth are the same for all.

    Attributes
    ----------
    preset, settings : what the method changes of the defaults. The task's settings stand between the two, so that a
        preset cannot replace the depth that all methods share.
    create_tracker : makes the tracker of a baseline; None: the program's own, exactly as `scopemap run` runs it.
    """

    preset: Preset | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    create_tracker: Callable[[], FrameTracker] | None = None

    def run(self, task: Task, out: Path) -> Timing:
        """Reconstruct into `out`; raises what the pipeline raises.

        Times are those of the run's own clock: "tracking" is tracking, depth refinement and the choice of keyframes.
        """
        config = Config.load(self.preset, settings=dict(task.settings) | dict(self.settings))
        tracker = self.create_tracker() if self.create_tracker is not None else None
        finished: list[float] = []

        def note(step: Step) -> None:
            finished.append(time.perf_counter())

        result = reconstruct(task.sequence, config, out=out, overwrite=True, observers=(note,), tracker=tracker)
        frames, seconds = len(result.records), result.provenance["seconds"]
        # Work after the last frame counts for all frames.
        afterwards = sum(seconds.get(part, 0.0) for part in ("back end", "depth corrected", "fuse"))
        return Timing(
            ms_per_frame=1e3 * ((finished[-1] - finished[0]) / max(frames - 1, 1) + afterwards / frames),
            track_ms_per_frame=1e3 * seconds["track and fuse"] / frames,
            seconds=seconds,
        )
