"""The page of a run that goes on: its pictures, how far it is, and the path and the surface so far."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from PIL import Image

from scopemap.apps.browser.runs import BrowserRun
from scopemap.apps.browser.scene import PATH_COLOUR, draw_path, look_at, quaternion
from scopemap.apps.browser.serving import RUN_GOES_ON
from scopemap.apps.browser.window import escaped, fenced
from scopemap.result.run_view import RunProgress, SeenMap, look, read_coverage, read_map, read_pictures, read_progress

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_MOST_KEYFRAMES = 200
_FRUSTUM_SHARE = 0.08
_POINT_SHARE = 0.008
_LOST = (200, 40, 40)
_TRACKED = (30, 160, 70)
_EARLIER = (150, 150, 150)
_GREY = " Grey: what was seen before tracking started again. Its place beside the rest is a guess until the run ends."
_NOT_FINAL = " Grey: as tracked, before the adjustment."
_MOST_LOG = 4000
_STOP = "Stop"
_STOPPING = "stopping, ten seconds at most"


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
        """Ask it to end and keep what it has."""


class RunPage:
    """A run that writes what is seen of it to `folder`.

    finished : called once with the run where it has a result. back : leads to the result that it was started from.
    buttons : of a live stream, what they call by what is written on them.
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
        self._ended = self._is_lost = self._has_grey = False
        self._written = self._first = -1
        self._size = ""
        self._ways: list[Any] = []

    def open(self, window: BrowserWindow) -> None:
        """Make the elements."""
        gui = window.gui
        self._window = window
        gui.add_markdown(f"### {escaped(window.names.hidden(self._title))}")
        self._rarely = gui.add_html(f'<span id="{RUN_GOES_ON}"></span>')
        self._bar = gui.add_progress_bar(0)
        # Above the words, whose lines become more and fewer: a button that moves is missed.
        makes = "Makes a result of the frames so far." if self._makes_result else "Keeps what was tracked, to continue."
        stop = gui.add_button(_STOP, icon=_icon("PLAYER_STOP"), hint=makes)
        self._stop = window.on(stop, self._stop_run)
        self._add_ways_on()
        self._live = [window.on(gui.add_button(name), call) for name, call in self._buttons.items()]
        self._words = gui.add_markdown("starting")
        self._facts = gui.add_markdown("", visible=False)
        self._picture = gui.add_image(np.zeros((8, 10, 3), np.uint8), label="Frame: unused parts dark, corners green")
        self._depth = gui.add_image(np.zeros((8, 10, 3), np.uint8), label="Depth: red near, blue far")
        self._coverage = gui.add_image(np.zeros((8, 10, 3), np.uint8), label="What was not seen so far")
        self._picture.visible = self._depth.visible = self._coverage.visible = False
        with gui.add_folder("Log", expand_by_default=False):
            self._log = gui.add_markdown("")
        if self._back is not None:
            window.on(gui.add_button("Back to the earlier result", hint="The run goes on.", color="gray"), self._back)
        if window.first_page is not None:
            hint = "The stream ends with its result." if self._live else "The run goes on."
            window.on(gui.add_button("Back to the start", hint=hint, color="gray"), self._to_start)
        self.tick()

    @property
    def _makes_result(self) -> bool:
        """Whether stopping makes a result: of a live stream, and of a run in a terminal."""
        return not isinstance(self._run, BrowserRun)

    def close(self) -> None:
        """Nothing was begun."""

    def _to_start(self) -> None:
        if self._live:  # nothing else would end it
            self._run.stop()
        self._window.start()

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
            self._show_progress()
        else:
            self._end(status)

    def _add_ways_on(self) -> None:
        """Make what a run that was stopped offers."""
        gui, window, run = self._window.gui, self._window, self._run
        if not isinstance(run, BrowserRun):
            return
        go_on = gui.add_button("Continue", color="green", hint="The run goes on after the frames that it has tracked.")
        finish = gui.add_button(
            "Make a result of these frames", hint="In a folder beside it. The run can still be continued afterwards."
        )
        self._ways = [window.on(go_on, self._go_on), window.on(finish, self._finish)]
        for way in self._ways:
            way.visible = False

    def _go_on(self) -> None:
        assert isinstance(self._run, BrowserRun)
        self._run.go_on()
        self._ended, self._stop.visible, self._rarely.visible = False, True, True
        self._stop.disabled, self._stop.label = False, _STOP
        for way in self._ways:
            way.visible = False
        self.tick()

    def _finish(self) -> None:
        run = self._run
        assert isinstance(run, BrowserRun)
        # What is copied is as large as the frames so far.
        self._window.job("copying what was tracked", run.copy, self._finish_in)

    def _finish_in(self, folder: Path) -> None:
        assert isinstance(self._run, BrowserRun)
        self._run.finish(folder)
        self._window.start()  # which shows it beside the one that can still go on

    def _stop_run(self) -> None:
        self._run.stop()
        self._stop.label = "stopping: the result of the frames so far is made" if self._makes_result else _STOPPING
        self._stop.disabled = True
        for button in self._live:
            button.disabled = True

    def _end(self, status: str) -> None:
        self._ended, self._bar.visible, self._stop.visible, self._rarely.visible = True, False, False, False
        for button in self._live:
            button.visible = False
        if status == "done":
            self._words.content = "**It has ended.**"
            self._finished()
            return
        if status == "failed":
            self._window.fail(self._run.sentence, self._run.printed[-_MOST_LOG:])
            self._words.content = "**The run has failed.**"
            return
        is_kept = isinstance(self._run, BrowserRun) and self._run.is_kept
        progress = read_progress(self._folder) if is_kept else None
        self._draw_all()
        if progress is not None:
            self._note_size(progress)
        self._words.content = stopped_words(progress) + self._size
        for way, is_offered in zip(self._ways, (True, is_kept), strict=False):
            way.visible = is_offered

    def _show_progress(self) -> None:
        progress = read_progress(self._folder)
        if progress is None:
            # Before the first frame, and while the report is written: the result is in its place then.
            lines = [line for line in self._run.printed.splitlines() if line.strip()]
            doing = lines[-1] if lines else "preparing" if self._first < 0 else "writing the report"
            self._words.content = escaped(self._window.names.hidden(doing))
            return
        self._note_size(progress)
        self._words.content = words_of(progress) + self._size
        self._bar.value, self._bar.visible = share_of(progress), not self._live
        self._facts.visible = bool(progress.facts)
        self._facts.content = "\n".join(f"- {name}: {escaped(value)}" for name, value in progress.facts.items())
        if not self._window.server.get_clients():  # no one looks
            return
        look(self._folder)
        if progress.written != self._written:
            self._written, self._is_lost = progress.written, progress.status == "lost"
            self._draw_all()

    def _note_size(self, progress: RunProgress) -> None:
        if progress.points:
            grey = "" if not self._has_grey else _NOT_FINAL if progress.adjusted else _GREY
            self._size = f"\n\nThe surface so far: {progress.points:,} points from {progress.frames:,} frames.{grey}"

    def _draw_all(self) -> None:
        if (pictures := read_pictures(self._folder)) is not None:
            for handle, content in zip((self._picture, self._depth), pictures, strict=True):
                handle.image, handle.visible = _pixels(content), True
        if (drawn := read_coverage(self._folder)) is not None:
            self._coverage.image, self._coverage.visible = _pixels(drawn), True
        if (seen := read_map(self._folder)) is not None and len(seen.index):
            self._draw(seen)

    def _draw(self, seen: SeenMap) -> None:
        """Draw path, points and the camera: few nodes, as a browser may have to draw with the processor."""
        scene = self._window.scene
        self._has_grey = len(seen.earlier) > 0
        positions = seen.T_world_camera[:, :3, 3]
        everything = np.concatenate([positions, seen.points, seen.earlier])
        size = float(np.linalg.norm(np.ptp(np.percentile(everything, [5, 95], axis=0), axis=0))) or 1.0
        is_first, self._first = self._first < 0, int(seen.index[0])
        grey = np.full(seen.earlier.shape, _EARLIER, np.uint8)
        keyframes = positions[seen.keyframe][-_MOST_KEYFRAMES:]
        blue = np.full(keyframes.shape, PATH_COLOUR, np.uint8)
        with self._window.server.atomic():
            for name, points, colours, share in (
                ("points", seen.points, seen.colours, _POINT_SHARE),
                ("earlier", seen.earlier, grey, _POINT_SHARE),
                ("keyframes", keyframes.astype(np.float32), blue, _POINT_SHARE),
            ):
                scene.remove_by_name(f"/page/{name}")
                if len(points):
                    scene.add_point_cloud(
                        f"/page/{name}",
                        points,
                        colours,
                        point_size=share * size,
                        point_shape="circle",
                        point_shading="flat",
                        precision="float32",
                    )
            draw_path(scene, "/page/path", positions)
            pose = seen.T_world_camera[-1]
            scene.add_camera_frustum(
                "/page/now",
                seen.fov_rad,
                seen.aspect,
                scale=_FRUSTUM_SHARE * size,
                color=_LOST if self._is_lost else _TRACKED,
                thickness=1.5,
                thickness_units="screen",
                cast_shadow=False,
                receive_shadow=False,
                wxyz=quaternion(pose),
                position=pose[:3, 3],
            )
        if is_first:
            look_at(self._window, seen.T_world_camera[0], everything)


def words_of(progress: RunProgress) -> str:
    """Return how far a run is, in one or two lines of Markdown."""
    count = f" {progress.done} of {progress.total}" if progress.total else f" {progress.done}" if progress.done else ""
    frames = " frames" if count else ""
    lines = [f"**{escaped(progress.doing)}**{count}{frames}{f', {progress.time_left}' if progress.time_left else ''}"]
    if progress.doing == "tracking" and progress.status:
        lost = f", {progress.lost} lost so far" if progress.lost else ""
        submap = f", submap {progress.submap + 1}" if progress.submap else ""
        is_lost = progress.status == "lost"
        how = f"**lost**: {escaped(progress.reason)}" if is_lost else f"tracked at {progress.time_s:.1f} s"
        lines.append(f"{how}{submap}{lost}")
    elif progress.adjusted:
        lines.append("Poses and points are those after the adjustment.")
    return "\n\n".join(lines)


def stopped_words(progress: RunProgress | None) -> str:
    """Return where a run was stopped that has kept its progress; None: it has kept nothing."""
    if progress is None:
        return "**Stopped** before anything was kept. *Continue* begins at the first frame."
    if progress.doing == "tracking":
        of = f" of {progress.total}" if progress.total else ""
        return f"**Stopped after {progress.done}{of} frames.** What was tracked is kept."
    return f"**Stopped while {escaped(progress.doing)}.** All frames that were tracked are kept."


def share_of(progress: RunProgress) -> float:
    """Return how much of its present stage a run has done, percent; of stages that are not counted all."""
    return min(100.0, 100 * progress.done / progress.total) if progress.total else 100.0


def _pixels(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def _icon(name: str) -> str:
    import viser

    return str(getattr(viser.Icon, name))
