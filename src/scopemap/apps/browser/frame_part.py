"""The time line: which frame is shown, what it shows, why it is lost, and which frames saw a place."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from scopemap.apps.browser.frame_images import FrameImages
from scopemap.apps.browser.marks import CLICKED, draw_marks
from scopemap.apps.browser.scene import quaternion
from scopemap.apps.browser.seen_by import frames_that_saw
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.shown_surface import SurfacePick
from scopemap.apps.browser.time_strip import TimeStrip
from scopemap.apps.browser.window import escaped
from scopemap.engine.tracking.causes import LossCause
from scopemap.result.frame_table import ELSEWHERE, LOST, ROTATED
from scopemap.result.losses import ADVICE
from scopemap.result.result import Result
from scopemap.result.run_input import places_of_input
from scopemap.result.surface_segments import SurfaceSegment
from scopemap.result.wording import LEVEL_WORDS

_FRUSTUM = "/page/frame"
_CLICK = "Click on the surface to see which frames saw that place."
_CLICKED = "/page/clicked"
_FRUSTUM_SHARE = 0.045
_COLOUR = (30, 160, 70)
_STEP_S = 0.2
_MOST_STEPS = 150
"""Of a film of the time line: of longer videos frames are left out."""
_MOST_LISTED = 30


class FramePart:
    """Controls of the time line; `list_that_saw` lists frames for a place on the surface."""

    def __init__(self, shown: ShownResult, images: FrameImages) -> None:
        self._shown, window, gui = shown, shown.window, shown.window.gui
        self._images, self._player = images, threading.Event()
        self._panel = gui.add_panel()
        self._panel.dock_left()
        with self._panel.add_tab("Time line"):
            self._add_time_line()
        moves = gui.add_button_group("Go", ["Previous", "Next", "Play"])
        moves.on_click(lambda event: window.do(self._move, moves.value))
        window.on(gui.add_button("Look from here", color="gray"), shown.look_from_frame)
        self._add_list()
        self._with_camera = window.on(gui.add_checkbox("Fly along", initial_value=False), self._go_with)
        self._with_camera.hint = "Look from each frame that is chosen or played"
        self._reread = window.on(gui.add_button("Read its own picture from the video", visible=False), self._read_again)
        self._marked: dict[int, np.ndarray] = {}
        self._has_input = bool(places_of_input(shown.whole.folder))
        self._commands = [
            self._command("Next frame", "N", "Next"),
            self._command("Previous frame", "P", "Previous"),
        ]
        shown.follow(frame=self._follow, note=self._hide_list)

    def _add_time_line(self) -> None:
        """Make what is below the scene: the slider, what became of the frames, and the pictures of one."""
        shown, gui = self._shown, self._shown.window.gui
        last = max(len(shown.rows) - 1, 0)
        self._slider = shown.window.on(gui.add_slider("Frame", 0, last, 1, 0), self._slide)
        self._slider.hint = "Arrow keys when it is chosen; N and P: next and previous frame"
        self._strip = TimeStrip(shown)
        self._strip_image = gui.add_image(self._strip.picture(), format="png")
        gui.add_html(self._strip.legend)
        self._segments = [segment_words(shown.whole, one) for one in shown.whole.segments]
        # A picture takes no clicks: the list goes where a click on the strip would.
        several = len(self._segments) > 1
        self._segment = gui.add_dropdown("Go to part", self._segments or [""], visible=several)
        shown.window.on(self._segment, self._choose_segment)
        self._words = gui.add_markdown("")
        self._image = gui.add_image(np.zeros((8, 640, 3), np.uint8))

    def _add_list(self) -> None:
        """Make the list of the frames that saw a place."""
        gui = self._shown.window.gui
        self._no_list = gui.add_markdown(_CLICK)
        self._list = self._shown.window.on(gui.add_dropdown("Frames that saw it", [""], visible=False), self._choose)

    def _hide_list(self) -> None:
        """Show no list, and no place: there is another message."""
        self._list.visible, self._no_list.visible = False, True
        self._shown.window.scene.remove_by_name(_CLICKED)
        if self._marked:
            self._marked = {}
            self._shown.window.do(self._show_images, self._shown.index)

    def list_that_saw(self, pick: SurfacePick) -> None:
        """List the frames that saw a place on the surface, the best first, mark the place, and show the best frame."""
        shown, seen = self._shown, frames_that_saw(self._shown.surface, [pick])
        if not seen:
            shown.note("No frame saw this place clearly.")
            self._mark(pick)
            return
        times = dict(zip(self._shown.whole.frames["index"].tolist(), self._shown.whole.frames["time_s"], strict=True))
        listed = seen[:_MOST_LISTED]
        best = seen[0].frame
        self._listed = {
            f"frame {sight.frame}, {times[sight.frame]:.2f} s{' (best)' if sight.frame == best else ''}": sight.frame
            for sight in listed
        }
        self._list.options = list(self._listed)
        self._list.value = self._list.options[0]
        count = "1 frame" if len(seen) == 1 else f"{len(seen)} frames"
        shown.note(f"{count} saw it, frame {best} best: see Frames.")
        self._list.visible, self._no_list.visible = True, False
        self._mark(pick)
        self._marked = {sight.frame: sight.pixels[0] for sight in seen}
        shown.show_frame(best)

    def _mark(self, pick: SurfacePick) -> None:
        shown = self._shown
        place = shown.surface.position(pick)[None]
        draw_marks(shown.window.scene, _CLICKED, place, shown.surface.size_mm, colour=CLICKED)

    def close(self) -> None:
        """End what plays, the keys, and the time line, which is beside the page's panel."""
        self._player.set()
        self._panel.remove()
        for command in self._commands:
            command.remove()

    def _command(self, label: str, key: Any, move: str) -> Any:
        command = self._shown.window.gui.add_command(label, hotkey=key)
        command.on_trigger(lambda event: self._shown.window.do(self._move, move))
        return command

    def _slide(self, value: float) -> None:
        # Of a drag only the last place counts.
        if value == self._slider.value:
            self._shown.show_row(self._shown.rows[int(value)])

    def _choose_segment(self, name: str) -> None:
        self._shown.show_segment(self._segments.index(name))

    def _choose(self, name: str) -> None:
        if name in self._listed:
            self._shown.show_frame(self._listed[name])

    def _move(self, move: str) -> None:
        if move == "Play":
            self._play()
            return
        self._player.set()
        self._go(1 if move == "Next" else -1)

    def _go(self, step: int) -> None:
        place = int(np.clip(int(self._slider.value) + step, 0, len(self._shown.rows) - 1))
        self._shown.show_row(self._shown.rows[place])

    def _play(self) -> None:
        """Begin to play from this frame, or from the first at the end; or stop."""
        if getattr(self, "_playing", None) and not self._player.is_set():
            self._player.set()
            return
        self._player, ended = threading.Event(), threading.Event()
        last = len(self._shown.rows) - 1
        if self._slider.value >= last:
            self._shown.show_row(self._shown.rows[0])
        step, stop = max(1, last // _MOST_STEPS), self._player

        def advance() -> None:
            if not stop.is_set():
                self._go(step)
            if self._slider.value >= last:
                stop.set()
            ended.set()

        def play() -> None:
            # The next step waits for the one before: a slow page is not flooded.
            while not stop.wait(_STEP_S):
                ended.clear()
                self._shown.window.do(advance)
                while not (ended.wait(_STEP_S) or stop.is_set()):
                    pass

        self._playing = threading.Thread(target=play, name="player", daemon=True)
        self._playing.start()

    def _go_with(self, on: bool) -> None:
        if on:
            self._shown.look_from_frame()
        else:
            self._shown.look_at_all()

    def _follow(self) -> None:
        shown = self._shown
        if shown.row in shown.rows:
            self._slider.value = shown.rows.index(shown.row)
        if self._segment.visible and shown.number == 0:
            self._segment.value = self._segments[shown.surface.segment]
        self._words.content, self._strip_image.image = frame_words(shown), self._strip.picture()
        if self._with_camera.value and shown.pose is not None:
            shown.look_from_frame()
        self._draw()
        # After what is quick; of many frames only for the last.
        shown.window.do(self._show_images, shown.index)

    def _show_images(self, index: int) -> None:
        if index != self._shown.index:
            return
        self._image.image = self._images.all_of(index, self._marked.get(index))
        found = self._images.picture(index)
        self._reread.visible = self._has_input and (found is None or found[0] != index)

    def _draw(self) -> None:
        """Draw the camera of the frame in the scene."""
        shown = self._shown
        if (pose := shown.pose) is None:
            shown.window.scene.remove_by_name(_FRUSTUM)
            return
        camera = shown.whole.camera
        shown.window.scene.add_camera_frustum(
            _FRUSTUM,
            shown.vertical_fov,
            camera.width / camera.height,
            scale=_FRUSTUM_SHARE * shown.surface.size_mm,
            color=_COLOUR,
            thickness=2.5,
            thickness_units="screen",
            cast_shadow=False,
            receive_shadow=False,
            wxyz=quaternion(pose),
            position=pose[:3, 3],
        )

    def _read_again(self) -> None:
        index = self._shown.index

        def show(rgb: np.ndarray | None) -> None:
            if rgb is None:
                self._shown.note(f"The video has no frame {index} any more.")
            self._show_images(index)

        self._shown.window.job("reading the video", lambda: self._images.sharp(index), show)


def segment_words(whole: Result, segment: SurfaceSegment) -> str:
    """Return number, time and grade of a segment of a result: "2. 3.1 to 5.2 s: good, the main part"."""
    main = ", the main part" if segment.segment == whole.main_segment else ""
    return f"{segment.segment + 1}. {segment.words}: {LEVEL_WORDS[segment.level]}{main}"


def frame_words(shown: ShownResult) -> str:
    """Return number, time and status of the frame that is shown, and why it is lost, as Markdown."""
    frames, row = shown.whole.frames, shown.row
    submap, time_s = int(frames.submap[row]), float(frames["time_s"][row])
    words = f"Frame {shown.index}, {time_s:.2f} s: "
    if submap >= 0:
        if submap != shown.number:
            return f"{words}tracked in submap {submap + 1}, not the one that is shown"
        segments = shown.run.segments
        if len(segments) < 2:
            return f"{words}tracked"
        segment = segments[shown.surface.segment]
        return (
            f"{words}tracked. **The surface is that of {segment.start_s:.1f} to {segment.end_s:.1f} s**: "
            f"the scene changes, and each of {len(segments)} parts of the video has its own."
        )
    status = {
        LOST: "**lost**",
        ROTATED: "**lost**, only its rotation is known",
        ELSEWHERE: "in a submap that is too small",
    }
    words += status.get(submap, "not used")
    reason, cause = str(frames["reason"][row]), LossCause(str(frames["cause"][row]))
    advice = ADVICE.get(cause, "")
    return words + (f": {escaped(reason)}." if reason else ".") + (f" {advice}" if advice else "")
