"""What was not seen so far of a live session: its map, made again and again in a process of its own."""

from __future__ import annotations

import os
import queue
import shutil
import threading
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from scopemap.apps.coverage.coverage import coverage
from scopemap.apps.coverage.unseen import MOST_FRAMES
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.finish import finished
from scopemap.engine.fusion.surface_fusion import TsdfVolume
from scopemap.engine.odometry import Step
from scopemap.result.depth_maps import DepthWriter
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from scopemap.result.verdict import LEAST_FRAMES
from scopemap.runner.processes import ProcessLimits, run_in_processes
from scopemap.runner.reconstructor import Reconstructor

_MOST_MAPS = 8  # whose depth is kept, as many as the session keeps surfaces of
_APART_S = 0.25  # frames that are kept, at first: writing the depth of one takes 9 ms
_EVERY_S = 5.0  # between maps
_LONGEST_S = 120.0  # for one map, and its priority: idle time on a busy machine, but not none
_NICE = 10


class KeptDepth:
    """Keeps depth and pose of tracked frames a quarter of a second apart, at most 200 of a map; observes a session.

    Where there would be more, every second one is dropped, and the time between them doubles. Beside the present map
    the longest are kept. `folder` : below it is depth/, as in a result; it is another one, below `parent`, after a
    reset.
    """

    def __init__(self, parent: Path) -> None:
        self.folder, self._parent = parent, parent
        self._of: Reconstructor | None = None
        self._resets = 0

    def observe(self, step: Step, reconstructor: Reconstructor) -> None:
        """Keep a frame, or not; one whose depth cannot be written is not kept."""
        if reconstructor is not self._of:
            self._of, self._resets = reconstructor, self._resets + 1
            self.folder = self._parent / str(self._resets)
            self._write: DepthWriter = reconstructor.depth_writer(self.folder)
            self._maps: dict[int, list[dict[str, Any]]] = {}
            self._apart_s = dict[int, float]()
        if step.frame.T_world_camera is not None and step.frame.depth_mm is not None:
            self._put(step.frame, step.track.map)

    def frames(self, number: int) -> FrameTable:
        """Return the table of the frames that are kept of a map, as that of a result."""
        return FrameTable.of(self._maps.get(number, []))

    def final(self, frame: Frame) -> None:
        """Replace the depth of a frame that is kept by its corrected one."""
        if (self.folder / "depth" / f"{frame.index:06d}.png").is_file():
            self._write(frame)

    def move_to(self, folder: Path) -> None:
        """Move the depth to a result's folder."""
        if self._of is not None:
            self._write.finish(scale_known=self._of.scale_known)
            for part in self.folder.glob("depth*"):
                shutil.move(part, folder)

    def _put(self, frame: Frame, number: int) -> None:
        rows = self._maps.setdefault(number, [])
        apart_s = self._apart_s.setdefault(number, _APART_S)
        if rows and frame.time_s < rows[-1]["time_s"] + apart_s:
            return
        pose = {"status": "ok" if rows else "initial", "T_world_camera": frame.T_world_camera}
        with suppress(InputError):
            self._write(frame)
            rows.append({"index": frame.index, "time_s": frame.time_s, "map": 0} | pose)
        if len(rows) > MOST_FRAMES:
            self._remove(rows[1::2])
            self._maps[number], self._apart_s[number] = rows[::2], 2 * apart_s
        if len(self._maps) > _MOST_MAPS:
            shortest = min(self._maps.keys() - {number}, key=lambda n: len(self._maps[n]) * self._apart_s[n])
            self._remove(self._maps.pop(shortest))

    def _remove(self, rows: list[dict[str, Any]]) -> None:
        for row in rows:
            for part in ("depth", "depth_sigma"):
                (self.folder / part / f"{row['index']:06d}.png").unlink(missing_ok=True)


class ShownMap(NamedTuple):
    """A map as PNG, b"" where there is none, and what it says, or why there is none, in a sentence."""

    png: bytes
    words: str


class LiveCoverage:
    """Makes the map of the surface so far every five seconds or less often; context, and observer of a live session.

    The session's thread copies the voxels and no more: another process, of lower priority, makes surface and map. Where
    it fails, `shown` says so, and the session goes on. `count` : of the maps until now.
    """

    def __init__(self, kept: KeptDepth) -> None:
        self._kept, self._tasks = kept, queue.SimpleQueue[_MapTask | None]()
        self.shown, self.count = ShownMap(b"", f"What was not seen: a map comes after {LEAST_FRAMES} frames."), 0
        self._idle, self._next_s = threading.Event(), time.monotonic() + _EVERY_S
        self._idle.set()
        self._thread = threading.Thread(target=self._make, name="coverage", daemon=True)

    def __enter__(self) -> LiveCoverage:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._tasks.put(None)
        self._thread.join()

    def observe(self, step: Step, reconstructor: Reconstructor) -> None:
        """Ask for another map where one is due, after `KeptDepth.observe`."""
        if step.frame.T_world_camera is None or time.monotonic() < self._next_s or not self._idle.is_set():
            return
        frames = self._kept.frames(step.track.map)
        if len(frames) < LEAST_FRAMES:
            return
        self._next_s, so_far = time.monotonic() + _EVERY_S, reconstructor.so_far(frames)
        self._task = _MapTask(self._kept.folder, f"map {step.track.map + 1} until {step.frame.time_s:.0f} s", so_far)
        self._idle.clear()
        self._tasks.put(self._task)

    def settle(self) -> None:
        """Wait for the map that is being made."""
        while self._thread.is_alive() and not self._idle.wait(1):
            pass

    def _make(self) -> None:
        """Have the maps made that are asked for, in the order of asking: the thread's work."""
        try:
            for _, outcome in run_in_processes(_made, iter(self._tasks.get, None), ProcessLimits(1, _LONGEST_S)):
                # Errors name the folder, which is none of the user's.
                fault = outcome.fault.replace(str(self._task.folder), "so far")
                self.shown = outcome.value or ShownMap(b"", f"No map of what was not seen in {self._task.of}: {fault}.")
                self.count += 1
                self._idle.set()
        except OSError as error:  # no process can be started: no more maps
            self.shown = ShownMap(b"", f"No map of what was not seen: {error}.")


class _MapTask(NamedTuple):
    """A map to be made in a folder of depth, to which `so_far` is written before. `of` : what that is, in words."""

    folder: Path
    of: str
    so_far: tuple[Result, TsdfVolume | None]


def _made(task: _MapTask) -> ShownMap:
    """Return the map of a task."""
    with suppress(AttributeError, OSError):  # Windows knows no priorities of this kind
        os.nice(max(0, _NICE - os.nice(0)))
    result, volume = task.so_far
    if volume is not None:
        result.mesh = finished(volume.extract_mesh(), result.config.fusion)
    result.save(task.folder)
    found = coverage(task.folder)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "map.png"
        found.draw(file)
        return ShownMap(file.read_bytes(), f"Of {task.of}, {found.sentence}")
