"""Writes what can be seen of a run while it goes on, for whoever looks (`result/run_view.py`), without slowing it down.

What is observed is put down in the run's threads; a thread of its own writes it. Pictures and points are drawn only
while someone looks.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from scopemap.engine.flow.corners import detect_corners
from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step
from scopemap.report.depth_figures import colour_depth
from scopemap.report.frame_pictures import shrunk
from scopemap.report.progress_meter import ProgressMeter
from scopemap.result.run_view import (
    RunProgress,
    last_look,
    view_folder,
    write_coverage,
    write_map,
    write_pictures,
    write_progress,
)
from scopemap.runner.seen_pieces import SeenPieces

_EVERY_S = 0.5
_DRAWN_EVERY_S = 3.0
"""Corners, depth in colours and points take .05 s: less often than what is only counted."""
_LOOKED_S = 5.0
"""Who looked so long ago still looks: a window that is busy looks late."""
_POINTS_EVERY_S = 0.5
_PICTURE_PX = 480
_CORNER_CELL_PX = 12  # that of the tracker's corners
_DEPTH_PERCENTILES = (2, 98)
_MASKED_SHARE = 0.4
"""Brightness that is left of a pixel which is not used."""


class RunWatch:
    """Observes a run that writes to `out`, and shows it; a context that ends with the run.

    out : the folder of the result; or, with `folder`, nothing: what is seen is written there. total : frames of the
    input, None: not known. adjusts : as of `ProgressMeter`. Of a live stream, asked when it is written: live : what it
    does, and what else is shown, by name; drawn : the map of what was not seen so far, PNG, b"": none.
    """

    def __init__(
        self,
        out: Path | None,
        total: int | None = None,
        *,
        adjusts: bool = True,
        folder: Path | None = None,
        live: Callable[[], tuple[str, dict[str, str]]] | None = None,
        drawn: Callable[[], bytes] = bytes,
    ) -> None:
        if out is None and folder is None:
            raise ValueError("a folder is needed to show a run in")
        self._out, self._folder, self._live, self._drawn = out, folder, live, drawn
        self._total, self._adjusts = total, adjusts
        self._meter = ProgressMeter(total, adjusts=adjusts)
        self._words, self._done, self._frames = "preparing", 0, 0
        self._step: Step | None = None
        self._pieces = SeenPieces()
        self._map_of = dict[int, int]()
        self._final_map: int | None = None
        self._pointed_s, self._drawn_s, self._written = 0.0, 0.0, 0
        self._look, self._looked_s = 0, -_LOOKED_S
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._write_until_ended, name="watch", daemon=True)

    def __enter__(self) -> RunWatch:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def __call__(self, step: Step) -> None:
        """Take a step: an observer for `reconstruct`."""
        now = time.monotonic()
        with self._lock:
            self._meter.add(step)
            self._words, self._done, self._frames = "tracking", self._meter.done, self._total or 0
            is_due = now - self._pointed_s > _POINTS_EVERY_S
            if self._take(step, with_points=is_due) and is_due:
                self._pointed_s = now

    def again(self, step: Step) -> None:
        """Take a step that was made before the run was resumed."""
        with self._lock:
            self._take(step, with_points=True)

    def _take(self, step: Step, *, with_points: bool) -> bool:
        """Take a step; return whether its frame has a pose."""
        frame, track = step.frame, step.track
        if next(reversed(self._map_of.values()), track.map) != track.map:
            self._pieces.begin()
        self._step = step
        if frame.T_world_camera is None:
            return False
        self._map_of[frame.index] = track.map
        self._pieces.keyframes.add(track.keyframe)
        self._pieces.put(frame, with_points=with_points)
        return True

    def forget(self) -> None:
        """Begin anew: what a run has shown stays until its frames come again, what a live stream has shown goes."""
        with self._lock:
            self._meter = ProgressMeter(self._total, adjusts=self._adjusts)
            self._step, self._map_of, self._final_map = None, {}, None
            if self._live is None:
                self._pieces.begin()
            else:
                self._pieces = SeenPieces()

    def save(self, run: Path) -> None:
        """Write nothing: what is shown goes on with a run that is resumed, and is no part of its result."""

    def final(self, frame: Frame) -> None:
        """Take a frame whose depth and pose are final."""
        if frame.T_world_camera is None:
            return
        with self._lock:
            number = self._map_of.get(frame.index, 0)
            if number != self._final_map:  # of a submap with a world of its own
                self._pieces.begin()
                self._final_map = number
            self._pieces.put(frame, with_points=self._pieces.has_points(frame.index) or self._pieces.is_sparse)

    def progress(self, doing: str, done: int, frames: int) -> None:
        """Take what is done outside of tracking, as `Progress` is called."""
        with self._lock:
            self._meter.words(doing, done, frames)
            self._words, self._done, self._frames = doing, done, frames

    def so_far(self) -> RunProgress:
        """Return how far the run is now."""
        doing, facts = (self._words, {}) if self._live is None else self._live()
        with self._lock:
            step = self._step
            return RunProgress(
                doing=doing,
                done=self._done,
                total=self._frames,
                time_left=self._meter.time_left.rstrip(", ") if self._live is None else "",
                status="" if step is None else step.track.status,
                reason="" if step is None or step.track.status != "lost" else step.track.reason,
                lost=self._meter.lost,
                frame=-1 if step is None else step.frame.index,
                time_s=0.0 if step is None else step.frame.time_s,
                submap=0 if step is None else step.track.map,
                adjusted=self._final_map is not None,
                points=self._pieces.count,
                frames=len(self._map_of),
                written=self._written,
                facts=facts,
            )

    def _write_until_ended(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self._write()
        self._write()

    def _write(self) -> None:
        """Write what is seen now. Where that fails the run goes on: looking at it is not what it is for."""
        folder = self._folder
        if self._out is not None:
            folder = view_folder(self._out)
            if not folder.parent.is_dir():  # not yet, or the result is in its place
                return
        assert folder is not None
        try:
            folder.mkdir(exist_ok=True)
            now = time.monotonic()
            if (found := last_look(folder)) != self._look:
                self._look, self._looked_s = found, now
            if now - self._looked_s < _LOOKED_S and now - self._drawn_s > _DRAWN_EVERY_S:
                self._draw(folder)
                self._drawn_s = now
                self._written += 1
            write_progress(folder, self.so_far())
        except OSError:
            return

    def _draw(self, folder: Path) -> None:
        with self._lock:
            step = self._step
            seen = None if step is None else self._pieces.map(step.frame)
        if step is not None:
            write_pictures(folder, *_pictures(step.frame))
        if seen is not None:
            write_map(folder, seen)
        if drawn := self._drawn():
            write_coverage(folder, drawn)


def _pictures(frame: Frame) -> tuple[bytes, bytes]:
    """Return a frame's picture, dark where it is not used, with its corners; and its depth in colours, near red."""
    shown = np.where(frame.valid[..., None], frame.rgb, (frame.rgb * _MASKED_SHARE).astype(np.uint8))
    depth_mm = np.full(frame.valid.shape, np.nan, np.float32) if frame.depth_mm is None else frame.depth_mm
    known = frame.valid & np.isfinite(depth_mm)
    if known.any():
        for x, y in detect_corners(frame, _CORNER_CELL_PX).tolist():
            cv2.circle(shown, (x, y), 1, (60, 255, 90), -1)
        near, far = np.percentile(depth_mm[known], _DEPTH_PERCENTILES)
        coloured = colour_depth(np.where(known, depth_mm, np.nan), float(near), float(max(far, near * 1.001)))
    else:
        coloured = np.zeros_like(frame.rgb)
    return _jpeg(shown), _jpeg(coloured)


def _jpeg(rgb: np.ndarray) -> bytes:
    small = shrunk(rgb, _PICTURE_PX)
    return cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
