"""The page of a run that goes on: its pictures, how far it is, and the path and the surface so far."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from PIL import Image

from scopemap.apps.browser.scene import PATH_COLOUR, draw_path, look_at, quaternion
from scopemap.apps.browser.window import escaped, fenced
from scopemap.result.run_view import RunProgressState, SeenMap, read_coverage, read_map, read_pictures, read_state

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_MOST_FRUSTA = 60
_FRUSTUM_SHARE = 0.05
_POINT_SHARE = 0.006
_LOST = (200, 40, 40)
_MOST_LOG = 4000


class WatchedRun(Protocol):
    """What the page needs to know of the process that it shows."""

    @property
    def status(self) -> str:
        """Where it is: waiting, running, done, failed or stopped."""

    @property
    def printed(self) -> str:
        """What it has printed."""

    @property
    def sentence(self) -> str:
        """Why it failed."""

    def poll(self) -> None:
        """Look whether it has ended."""

    def stop(self) -> None:
        """Ask it to end and write what it has."""


class RunPage:
    """A run that writes what is seen of it to `folder`.

    finished : called once with the run where it has a result. back : called where the page is left. buttons : of a live
    stream, what they call by what is written on them.
    """

    def __init__(
        self,
        run: WatchedRun,
        folder: Path,
        title: str,
        finished: Callable[[], None],
        back: Callable[[], None] | None = None,
        waiting: Callable[[], int] = lambda: 0,
        buttons: Mapping[str, Callable[[], None]] | None = None,
    ) -> None:
        self._run, self._folder, self._title = run, folder, title
        self._finished, self._back, self._waiting, self._buttons = finished, back, waiting, buttons or {}
        self._frusta = set[str]()
        self._ended = False
        self._written = self._first = -1

    def open(self, window: BrowserWindow) -> None:
        """Make the elements."""
        gui = window.gui
        self._window = window
        gui.add_markdown(f"### {escaped(window.names.hidden(self._title))}")
        self._words, self._size = gui.add_markdown("starting"), ""
        self._bar = gui.add_progress_bar(0, animated=True)
        self._facts = gui.add_markdown("", visible=False)
        self._live = [window.on(gui.add_button(name), call) for name, call in self._buttons.items()]
        stop = gui.add_button("Stop" if self._live else "Stop and keep what there is", icon=_icon("PLAYER_STOP"))
        self._stop = window.on(stop, self._stop_run)
        self._picture = gui.add_image(np.zeros((8, 10, 3), np.uint8), label="Frame: unused parts dark, corners green")
        self._depth = gui.add_image(np.zeros((8, 10, 3), np.uint8), label="Depth: red near, blue far")
        self._coverage = gui.add_image(np.zeros((8, 10, 3), np.uint8), label="What was not seen so far")
        self._picture.visible = self._depth.visible = self._coverage.visible = False
        with gui.add_folder("Log", expand_by_default=False):
            self._log = gui.add_markdown("")
        if self._back is not None:
            window.on(gui.add_button("Back to the start", hint="The run goes on.", color="gray"), self._back)
        self.tick()

    def close(self) -> None:
        """Nothing was begun."""

    def tick(self) -> None:
        """Show what has changed."""
        if self._ended:
            return
        self._run.poll()
        self._log.content = fenced(self._window.names.hidden(self._run.printed[-_MOST_LOG:]))
        status = self._run.status
        if status == "waiting":
            self._words.content = f"It waits in the queue: runs before it: {self._waiting()}"
        elif status == "running":
            self._show_state()
        else:
            self._end(status)

    def _stop_run(self) -> None:
        self._run.stop()
        self._stop.label, self._stop.disabled = "stopping after this frame", True
        for button in self._live:
            button.disabled = True

    def _end(self, status: str) -> None:
        self._ended, self._bar.visible, self._stop.visible = True, False, False
        for button in self._live:
            button.visible = False
        if status == "done":
            self._words.content = "**It has ended.**"
            self._finished()
            return
        if status == "failed":
            self._window.fail(self._run.sentence, self._run.printed[-_MOST_LOG:])
            self._words.content = "**The run has failed.**"
        else:
            self._words.content = "**Stopped.** Nothing was written."

    def _show_state(self) -> None:
        state = read_state(self._folder)
        if state is None:
            lines = [line for line in self._run.printed.splitlines() if line.strip()]
            last = self._window.names.hidden(lines[-1]) if lines and self._first < 0 else "preparing"
            self._words.content = escaped(last)
            return
        self._words.content = words_of(state) + self._size
        self._bar.value, self._bar.visible = share_of(state), not self._live
        if state.written == self._written:
            return
        self._written = state.written
        self._facts.visible = bool(state.facts)
        self._facts.content = "\n".join(f"- {name}: {escaped(value)}" for name, value in state.facts.items())
        if (pictures := read_pictures(self._folder)) is not None:
            for handle, content in zip((self._picture, self._depth), pictures, strict=True):
                handle.image, handle.visible = _pixels(content), True
        if (drawn := read_coverage(self._folder)) is not None:
            self._coverage.image, self._coverage.visible = _pixels(drawn), True
        if (seen := read_map(self._folder)) is not None:
            self._draw(seen, is_lost=state.status == "lost")

    def _draw(self, seen: SeenMap, *, is_lost: bool) -> None:
        scene = self._window.scene
        if not len(seen.index):
            return
        self._size = f"\n\nThe surface so far: {len(seen.points):,} points from {len(seen.index):,} frames."
        positions = seen.T_world_camera[:, :3, 3]
        everything = np.concatenate([positions, seen.points]) if len(seen.points) else positions
        size = float(np.linalg.norm(np.ptp(np.percentile(everything, [5, 95], axis=0), axis=0))) or 1.0
        is_new = self._first != seen.index[0]  # another submap, or all was forgotten
        self._first = int(seen.index[0])
        with self._window.server.atomic():
            if is_new:
                scene.remove_by_name("/page/points")
                scene.remove_by_name("/page/path")
            if len(seen.points):
                scene.add_point_cloud(
                    "/page/points",
                    seen.points,
                    seen.colours,
                    point_size=_POINT_SHARE * size,
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                )
            draw_path(scene, "/page/path", positions)
            chosen = np.flatnonzero(seen.keyframe)[-_MOST_FRUSTA:]
            poses = {f"/page/keyframes/{place}": seen.T_world_camera[row] for place, row in enumerate(chosen)}
            poses["/page/now"] = seen.T_world_camera[-1]
            for name in self._frusta - poses.keys():
                scene.remove_by_name(name)
            self._frusta = set(poses)
            for name, pose in poses.items():
                now = name == "/page/now"
                scene.add_camera_frustum(
                    name,
                    seen.fov_rad,
                    seen.aspect,
                    scale=_FRUSTUM_SHARE * size * (1.6 if now else 1.0),
                    color=(_LOST if is_lost else (30, 160, 70)) if now else PATH_COLOUR,
                    thickness=1.5,
                    thickness_units="screen",
                    cast_shadow=False,
                    receive_shadow=False,
                    wxyz=quaternion(pose),
                    position=pose[:3, 3],
                )
        if is_new:
            look_at(self._window, seen.T_world_camera[0], everything)


def words_of(state: RunProgressState) -> str:
    """Return how far a run is, in one or two lines of Markdown."""
    count = f" {state.done} of {state.total}" if state.total else f" {state.done}" if state.done else ""
    frames = " frames" if count else ""
    lines = [f"**{escaped(state.doing)}**{count}{frames}{f', {state.time_left}' if state.time_left else ''}"]
    if state.doing == "tracking" and state.status:
        lost = f", {state.lost} lost so far" if state.lost else ""
        submap = f", submap {state.submap + 1}" if state.submap else ""
        is_lost = state.status == "lost"
        how = f"**lost**: {escaped(state.reason)}" if is_lost else f"tracked at {state.time_s:.1f} s"
        lines.append(f"{how}{submap}{lost}")
    elif state.adjusted:
        lines.append("Poses and points are those after the adjustment.")
    return "\n\n".join(lines)


def share_of(state: RunProgressState) -> float:
    """Return how much of its present stage a run has done, percent; of stages that are not counted all."""
    return min(100.0, 100 * state.done / state.total) if state.total else 100.0


def _pixels(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def _icon(name: str) -> str:
    import viser

    return str(getattr(viser.Icon, name))
