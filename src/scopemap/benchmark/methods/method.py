"""What every method of a benchmark has in common, and the methods that are a run of our pipeline."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from scopemap.config import Config, Preset
from scopemap.io.sequence import Sequence
from scopemap.pipeline import Step
from scopemap.runner import reconstruct
from scopemap.tracking.track import FrameTracker


class Method(Protocol):
    """Turns a sequence into a run's folder, which the same code then scores for all methods."""

    def run(self, sequence: Sequence, settings: Mapping[str, Any], out: Path) -> dict[str, float]:
        """Write at least trajectory.tum, frames.csv and provenance.json to `out` and return the times.

        All methods get the same `sequence` of frames, whose truth they must not read, and the same `settings` (dotted
        names): depth and its anchor, masks, fusion. Times are "ms_per_frame", from the first finished frame to the last
        without start-up, "track_ms_per_frame" and "seconds_STAGE"; none where they are unknown. Raises any error of the
        method.
        """


@dataclass(frozen=True)
class PipelineMethod:
    """A run of the pipeline. A baseline replaces the tracker; frames, masks and raw depth are the same for all.

    Attributes
    ----------
    preset, settings : what the method changes of the defaults. The shared settings stand between the two, so that a
        preset cannot replace the depth that all methods share.
    create_tracker : makes the tracker of a baseline; None: the program's own, exactly as `scopemap run` runs it.
    """

    preset: Preset | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    create_tracker: Callable[[], FrameTracker] | None = None

    def run(self, sequence: Sequence, settings: Mapping[str, Any], out: Path) -> dict[str, float]:
        """Reconstruct into `out`; raises what the pipeline raises.

        Times are those of the run's own clock: "tracking" is tracking, depth refinement and the choice of keyframes.
        """
        config = Config.load(self.preset, settings=dict(settings) | dict(self.settings))
        tracker = self.create_tracker() if self.create_tracker is not None else None
        finished: list[float] = []

        def note(step: Step) -> None:
            finished.append(time.perf_counter())

        result = reconstruct(sequence, config, out=out, overwrite=True, observers=(note,), tracker=tracker)
        frames, seconds = len(result.records), result.provenance["seconds"]
        # Work after the last frame counts for all frames.
        afterwards = sum(seconds.get(part, 0.0) for part in ("back end", "depth corrected", "fuse"))
        return {
            "ms_per_frame": 1e3 * ((finished[-1] - finished[0]) / max(frames - 1, 1) + afterwards / frames),
            "track_ms_per_frame": 1e3 * seconds["track and fuse"] / frames,
            **{f"seconds_{stage.replace(' ', '_')}": value for stage, value in seconds.items()},
        }
