"""A live session: a source that does not wait is reconstructed as it comes; state, latency, pause, reset, snapshot."""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from scopemap.apps.live.live_status import LiveStatus
from scopemap.engine.config import Config
from scopemap.engine.errors import reporting
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.mesh_files import save_mesh
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Step
from scopemap.input.live_source import LiveSource
from scopemap.input.sequence import Sequence
from scopemap.result.result import Result
from scopemap.result.wording import facts_of_notices
from scopemap.runner.observers import FrameWriter, Progress
from scopemap.runner.provenance import Limits
from scopemap.runner.reconstructor import Reconstructor

LIMITS = Limits(frames=50_000, maps=8, blocks=80_000, stored=9_000)
"""Of a session: about 60 MB of rows, 1 GB of surfaces, and on disk 4 GB of frames: ten minutes at 15 frames/s."""
_REMEMBERED = 300  # latencies
_AHEAD = 1
_WITHOUT_STEP_S = 1.0  # guard: after which a frame that never became a step holds up no other

LiveObserver = Callable[[Step, Reconstructor], None]
"""Called with each step, in the thread that fuses: followers as soon as its pose is known, observers when it is fused.
"""


class LiveSession:
    """Reconstructs a live source until its end or `stop`, observed step by step; any thread may call its methods."""

    def __init__(
        self,
        source: LiveSource,
        sequence: Sequence,
        config: Config,
        *,
        followers: tuple[LiveObserver, ...] = (),
        observers: tuple[LiveObserver, ...] = (),
        snapshots: Path,
        progress: Progress = lambda doing, done, total: None,
    ) -> None:
        self._source, self._sequence, self._config = source, sequence, config
        self._followers, self._observers = followers, observers
        self._snapshots, self._progress = snapshots, progress
        self._frames, self._lock = sequence.frames(), threading.Lock()
        self._wants_reset = self._wants_snapshot = False
        self._forget()
        self._ended = False
        self._last_snapshot = ""

    def run(self) -> Reconstructor:
        """Load kernels and networks, reconstruct until the end, and return the reconstructor with the last result."""
        with Reconstructor(self._config, self._sequence, progress=self._progress) as warm:
            for index in range(2):
                picture = self._sequence.rectifier.image(np.roll(self._source.first, index, axis=1))
                warm.step(Frame(index, float(index), picture, warm.camera, self._sequence.rectifier.valid))
        while True:
            reconstructor = Reconstructor(self._config, self._sequence, progress=self._progress, limits=LIMITS)
            follow = partial(self._follow, reconstructor=reconstructor)
            for step in reconstructor.steps(self._until_reset(), ahead=_AHEAD, posed=follow):
                self._observe(step, reconstructor)
            if not self._wants_reset:
                self._ended = True
                return reconstructor
            reconstructor.close()
            self._wants_reset = False
            self._forget()

    def stop(self) -> None:
        """End the session after the frames that are on their way."""
        self._source.stop()

    def pause(self) -> None:
        """Leave frames out, or go on."""
        self._source.paused = not self._source.paused

    def reset(self) -> None:
        """Forget all that was seen, and begin anew with the next frame."""
        self._wants_reset, self._source.paused = True, False

    def snapshot(self) -> None:
        """Write the next frame's picture (PNG), its pose and the surface so far (PLY) to the folder for snapshots."""
        self._wants_snapshot = True

    def status(self) -> LiveStatus:
        """Return how the session is now."""
        with self._lock:
            latencies, times_s, step = list(self._latencies_ms), list(self._times_s), self._step
        span_s = times_s[-1] - times_s[0] if len(times_s) > 1 else 0.0
        median, slowest = np.percentile(latencies, [50, 95]) if latencies else (0.0, 0.0)
        word = self._state_word()
        return LiveStatus(
            state=word,
            reason=step.track.reason if step is not None and word == "lost" else "",
            frame=-1 if step is None else step.frame.index,
            frames_per_s=round((len(times_s) - 1) / span_s, 1) if span_s > 0 else 0.0,
            latency_ms=round(latencies[-1]) if latencies else 0,
            latency_p50_ms=round(float(median)),
            latency_p95_ms=round(float(slowest)),
            read=self._source.read,
            dropped=self._source.dropped,
            tracked=self._tracked,
            lost=self._lost,
            map=0 if step is None else step.track.map,
            scale_known=self._scale_known,
            snapshot=self._last_snapshot,
            full=self._full,
        )

    def _state_word(self) -> Literal["starting", "tracking", "lost", "paused", "ended"]:
        step = self._step
        if self._ended or step is None:
            return "ended" if self._ended else "starting"
        if self._source.paused:
            return "paused"
        if step.track.status == "lost":
            return "lost" if self._tracked else "starting"
        return "tracking"

    def _forget(self) -> None:
        self._latencies_ms: deque[float] = deque(maxlen=_REMEMBERED)
        self._times_s: deque[float] = deque(maxlen=_REMEMBERED)
        self._step: Step | None = None
        self._place = threading.Semaphore(1)
        self._tracked = self._lost = 0
        self._scale_known = self._full = False

    def _until_reset(self) -> Iterator[Frame]:
        """Yield the newest frame when the pose of the one before is known; the source leaves out those between.

        Two at once come nearly twice as late, for at most a seventh more frames on two cores: one is fused meanwhile.
        """
        while not self._wants_reset:
            self._place.acquire(timeout=_WITHOUT_STEP_S)
            if (frame := next(self._frames, None)) is None:
                return
            yield frame

    def _follow(self, step: Step, reconstructor: Reconstructor) -> None:
        """Take a step whose pose is known: what it took since the picture is the latency."""
        for follower in self._followers:
            follower(step, reconstructor)
        now_s = self._source.now_s()
        self._place.release()
        with self._lock:
            self._step, is_lost = step, step.track.status == "lost"
            self._tracked, self._lost = self._tracked + (not is_lost), self._lost + is_lost
            self._latencies_ms.append(1000 * (now_s - step.frame.time_s))
            self._times_s.append(now_s)
            self._scale_known, self._full = reconstructor.scale_known, reconstructor.surface_is_full

    def _observe(self, step: Step, reconstructor: Reconstructor) -> None:
        if self._wants_snapshot:
            self._wants_snapshot = False
            self._write_snapshot(step, reconstructor)
        for observer in self._observers:
            observer(step, reconstructor)

    def _write_snapshot(self, step: Step, reconstructor: Reconstructor) -> None:
        frame = step.frame
        stem = self._snapshots / f"{frame.index:06d}"
        pose = None if frame.T_world_camera is None else frame.T_world_camera.tolist()
        facts = {"time_s": frame.time_s, "status": step.track.status, "T_world_camera": pose, "unit": "mm"}
        with reporting(f"cannot write to {self._snapshots}"):
            self._snapshots.mkdir(parents=True, exist_ok=True)
            stem.with_suffix(".png").write_bytes(cv2.imencode(".png", frame.rgb[..., ::-1])[1].tobytes())
            stem.with_suffix(".json").write_text(json.dumps(facts | {"scale_known": reconstructor.scale_known}))
            surface = reconstructor.surface()
            if len(surface.faces):
                save_mesh(surface, stem.with_suffix(".ply"))
        self._last_snapshot = str(stem.with_suffix(".png"))


def finished(reconstructor: Reconstructor, source: LiveSource, final: FrameWriter | None = None) -> Result:
    """Return a session's result, its provenance with the frames that were dropped; final : as `result` takes it."""
    result = reconstructor.result(final)
    if source.dropped:
        dropped = Notice("frames-dropped", {"dropped": source.dropped, "read": source.read})
        result.provenance["notices"] += facts_of_notices([dropped])
    return result
