"""The first page: choose an input, see the runs, look at results."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scopemap.apps.browser.input_page import InputPage
from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.run_page import RunPage, words_of
from scopemap.apps.browser.runs import BrowserRun
from scopemap.apps.browser.window import escaped
from scopemap.apps.browser.workspace import DEMONSTRATION, VIDEO_KINDS, Workspace, in_time, made_and_word, thumbnail
from scopemap.engine.errors import InputError
from scopemap.result.run_view import read_progress, view_folder

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_HELLO = """### A surface from an endoscope video

scopemap finds how the camera moved and reconstructs the tissue surface. Everything stays on this machine.

*Research software, not a medical device.*"""
_CHOOSE = "choose ..."
_LOOK = "Look at it"
_STOP = "Stop"
_GO_ON = "Continue"
_CLIP = ("colon.mp4", "camera.yaml")
_MOST_RUNS = 6


class StartPage:
    """Videos of the workspace, one that is sent, a camera, the demonstration; the runs; and results that are there."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._shown: tuple[Any, ...] = ()
        self._states: list[tuple[BrowserRun, Any]] = []

    def open(self, window: BrowserWindow) -> None:
        """Make the elements."""
        self._window, gui = window, window.gui
        window.first_page = partial(StartPage, self._workspace)
        window.names.hide_folder(self._workspace.folder)
        if not self._workspace.keeps_uploads:
            window.names.leave_out(self._workspace.uploads)
            window.names.leave_out(self._workspace.calibrations)
        self._receiver = self._workspace.receiver(window.server, "video")
        # What came before this page was opened is in the list.
        while self._receiver.take() is not None:
            pass
        gui.add_markdown(_HELLO)
        window.on(gui.add_button("Try the demonstration", color="green"), self._demonstrate)
        self._top = gui.add_folder(None, visible=False)
        with self._top:
            self._changing = gui.add_folder(None)
        self._show_runs()
        self._add_videos()
        self._add_upload()
        with gui.add_folder("A camera or a stream", expand_by_default=False):
            hint = "Number of a camera, /dev/video0, or an address such as rtsp://..."
            source = gui.add_text("Source", "", hint=hint)
            window.on_button(gui.add_button("Watch it live"), lambda: self._open_live(str(source.value).strip()))

    def tick(self) -> None:
        """Show what has changed: of the runs, and of what is being sent."""
        share = self._receiver.progress
        self._bar.visible, self._bar.value = share is not None, min(100.0, share or 0.0)
        if (refused := self._receiver.take_refusal()) is not None:
            name, reason = refused
            self._window.fail(
                f"{self._window.names.of(self._workspace.uploads / name, 'video')} was not taken: {reason}"
            )
        if (sent := self._receiver.take()) is not None:
            self._choose(sent, is_new=True)
        runs = self._workspace.runs.runs[-_MOST_RUNS:]
        if tuple((run, run.status, run.stopping) for run in runs) != self._shown:
            self._show_runs()
        for run, words in self._states:
            words.content = self._words(run)

    def close(self) -> None:
        """What goes on goes on."""

    def _add_videos(self) -> None:
        gui, workspace = self._window.gui, self._workspace
        videos = self._window.names.labelled([*workspace.videos, *workspace.sent], "video")
        with gui.add_folder("A video of this folder"):
            if videos:
                listed = gui.add_dropdown("Video", (_CHOOSE, *videos))
                self._window.on(listed, lambda label: self._choose(videos[label]) if label in videos else None)
            else:
                gui.add_markdown("There is none. Send one, or start `scopemap app` in the folder of your videos.")
            hint = "Of a video, of a folder of images or of a data set, below this folder."
            typed = gui.add_text("Other path", "", hint=hint)
            self._window.on_button(
                gui.add_button("Choose this path"), lambda: self._choose_typed(str(typed.value).strip())
            )

    def _add_upload(self) -> None:
        gui, workspace = self._window.gui, self._workspace
        with gui.add_folder("A video from elsewhere"):
            self._receiver.button(gui, "Send a video", VIDEO_KINDS)
            stays = "is kept in scopemap/uploads" if workspace.keeps_uploads else "is deleted when the window ends"
            gui.add_markdown(f"At most {workspace.most_bytes / 1e9:.3g} GB. It {stays}.")
            self._bar = gui.add_progress_bar(0, visible=False, animated=True)

    def _show_runs(self) -> None:
        """Make what changes with the runs anew: their list, and the results."""
        self._changing.remove()
        self._states = []
        gui, runs = self._window.gui, self._workspace.runs.runs[-_MOST_RUNS:]
        self._shown = tuple((run, run.status, run.stopping) for run in runs)
        finished, left = self._workspace.finished, self._workspace.interrupted
        # A finished run is a result.
        going = [run for run in runs if run.status != "done" or run.out not in finished]
        self._top.visible = bool(finished or going or left)
        with self._top:
            self._changing = gui.add_folder(None)
        with self._changing:
            self._add_results(finished)
            if going or left:
                with gui.add_folder("Runs"):
                    for run in reversed(going):
                        self._add_run(run)
                    for folder in left:
                        name = escaped(self._window.names.of(folder, "result"))
                        gui.add_markdown(f"**{name}** was interrupted. Choose its video again: the run goes on.")

    def _add_run(self, run: BrowserRun) -> None:
        gui = self._window.gui
        self._states.append((run, gui.add_markdown(self._words(run))))
        can_stop = run.status in ("waiting", "running") and not run.stopping
        second = (_STOP,) if can_stop else (_GO_ON,) if run.status == "stopped" else ()
        buttons = gui.add_button_group("", (_LOOK, *second))

        def pressed() -> None:
            if buttons.value == _STOP:
                run.stop()
            else:
                if buttons.value == _GO_ON:
                    run.go_on()
                self.show_run(run)

        self._window.on(buttons, pressed)

    def _words(self, run: BrowserRun) -> str:
        name = escaped(self._window.names.of(run.out, "result"))
        if run.status == "waiting":
            return f"**{name}** waits: {self._workspace.runs.place(run)} before it"
        if run.status != "running":
            kept = ", and what was tracked is kept" if run.is_kept else ""
            ends = {"done": "done", "failed": "has failed", "stopped": f"was stopped{kept}"}
            return f"**{name}** {ends[run.status]}"
        progress = read_progress(view_folder(run.out))
        is_at = "starting" if progress is None else words_of(progress).partition("\n")[0]
        return f"**{name}** {'is stopping' if run.stopping else 'runs'}: {is_at}"

    def _add_results(self, finished: list[Path]) -> None:
        gui, names = self._window.gui, self._window.names
        results = {
            f"{label}, {made_and_word(path)}": path for label, path in names.labelled(finished, "result").items()
        }
        if not results:
            return
        with gui.add_folder("Your results"):
            first = gui.add_dropdown("Result", tuple(results))
            picture = gui.add_image(thumbnail(results[first.value]))

            def show(label: str) -> None:
                if label in results:
                    picture.image = thumbnail(results[label])

            self._window.on(first, show)
            look = gui.add_button("Look at this result")
            self._window.on_button(look, lambda: self._show_result(results, first.value))
            if len(results) > 1:
                second = gui.add_dropdown("Compare with", _without(results, first.value))
                self._window.on(first, lambda label: _offer(second, _without(results, label)))
                compare = gui.add_button("Compare the two", color="gray")
                self._window.on_button(compare, lambda: self._compare(results, first.value, second.value))

    def _demonstrate(self) -> None:
        clip = self._workspace.results / DEMONSTRATION
        asked = [run for run in self._workspace.runs.runs if run.source.parent == clip and run.status != "failed"]
        if asked and asked[-1].status in ("waiting", "running"):
            self.show_run(asked[-1])
            return
        clip.mkdir(parents=True, exist_ok=True)
        for name in _CLIP:
            with as_file(files("scopemap.apps.demo") / "clip" / name) as packaged:
                shutil.copyfile(packaged, clip / name)
        self.show_run(self._workspace.reconstruct(clip / _CLIP[0], [f"--camera={clip / _CLIP[1]}"]))

    def _choose_typed(self, name: str) -> None:
        if not name:
            raise InputError("type the path of a video below this folder")
        self._choose(self._workspace.inside(name))

    def _choose(self, source: Path, *, is_new: bool = False) -> None:
        self._window.show(InputPage(self._workspace, source, self.show_run, self._window.start, is_new=is_new))

    def _open_live(self, source: str) -> None:
        if not source:
            raise InputError("type the number of a camera, /dev/video0, or an address such as rtsp://...")
        from scopemap.apps.browser.live_page import open_live

        open_live(self._window, self._workspace, source)

    def _show_result(self, results: dict[str, Path], label: str) -> None:
        if label in results:
            self._window.show(ResultPage(results[label], self._workspace))

    def _compare(self, results: dict[str, Path], first: str, second: str) -> None:
        if first == second:
            raise InputError("choose two results to compare")
        if first in results and second in results:
            from scopemap.apps.browser.compare_page import ComparePage

            self._window.show(ComparePage(*in_time(results[first], results[second])))

    def show_run(self, run: BrowserRun) -> None:
        """Show a run while it goes on, or its result."""
        window, workspace = self._window, self._workspace

        def finished() -> None:
            window.show(ResultPage(run.out, workspace))

        if run.status == "done":
            finished()
            return
        title = window.names.of(run.source, "video")
        waiting = lambda: workspace.runs.place(run)  # noqa: E731
        window.show(RunPage(run, view_folder(run.out), title, finished, waiting=waiting))


def _without(labels: Iterable[str], chosen: str) -> tuple[str, ...]:
    return tuple(label for label in labels if label != chosen)


def _offer(dropdown: Any, options: tuple[str, ...]) -> None:
    """Let a dropdown offer other options; what is chosen stays where it is one of them, else it is the first."""
    if dropdown.options != options:
        dropdown.options = options
