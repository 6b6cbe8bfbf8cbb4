"""The window: one page at a time, shown to every browser that looks; everything happens in one thread, in order."""

from __future__ import annotations

import queue
import re
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scopemap.apps.browser.names import Names
from scopemap.apps.browser.serving import LOOPBACK, start_server, stop_server, url_of
from scopemap.engine.errors import ScopemapError

_TICK_S = 0.5
_LIGHT = 222
_DARK = 44
"""Grey levels behind the scene: white is seen before both."""
_PANEL_PX = 400
_LAST = 1e9
"""Order of what stands below all pages."""


class Page(Protocol):
    """What a window shows. Its elements are made in `open`, and go with it."""

    def open(self, window: BrowserWindow) -> None:
        """Make the elements of the panel and the scene."""

    def tick(self) -> None:
        """Called every half second."""

    def close(self) -> None:
        """End what was begun; elements are removed by the window."""


class BrowserWindow:
    """The panel and the scene of viser's server, shared by all browsers that look.

    gui, scene : viser's. Elements that a page makes in `open`, or in a call of `do`, are removed with it; nodes of the
    scene are below "/page". anonymous : names of files are not shown; `names` says what is shown instead.
    """

    def __init__(self, port: int = 0, host: str = LOOPBACK, *, anonymous: bool = False) -> None:
        self.files: dict[str, Path] = {}
        """Files that are served beside the page, by their paths there."""
        self.server, self.anonymous = start_server(port, host, self.files), anonymous
        self.names = Names(anonymous=anonymous)
        self.gui, self.scene = self.server.gui, self.server.scene
        self.url = url_of(host, self.server.get_port())
        """Where it is."""
        self._calls: queue.Queue[Callable[[], None]] = queue.Queue()
        self._worker = ThreadPoolExecutor(1, "job")
        self._page: Page | None = None
        self.first_page: Callable[[], Page] | None = None
        """Makes the page that `start` leads to; None: there is none."""
        self._ticking: list[Callable[[], None]] = []
        self._ended = False
        self.gui.set_panel_label("scopemap")
        self.theme(dark=False)
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(_PANEL_PX)
        # OpenCV's axes: y points down.
        self.scene.set_up_direction((0.0, -1.0, 0.0))
        self._error = self.gui.add_markdown("", visible=False)
        self._log = self.gui.add_markdown("", visible=False)
        self._place = self.gui.add_folder(None)
        self.dark = self.gui.add_checkbox("Dark", False, order=_LAST)
        """The switch between light and dark, below every page."""
        self.on(self.dark, lambda dark: self.theme(dark=dark))

    # What pages call, in the window's thread.

    def show(self, page: Page) -> None:
        """Show a page in place of the one before, next."""
        # Not now: the elements that go may be those whose call this is.
        self._calls.put(lambda: self._show(page))

    def start(self) -> None:
        """Show the first page, where there is one."""
        if self.first_page is not None:
            self.show(self.first_page())

    def on(self, handle: Any, call: Callable[..., None], *arguments: Any) -> Any:
        """Call in the window's thread where a button is pressed or an input changed; return the handle.

        An input's `call` gets its value before the other arguments.
        """
        if hasattr(handle, "on_click"):
            handle.on_click(lambda event: self.do(call, *arguments))
        else:
            handle.on_update(lambda event: self.do(call, handle.value, *arguments) if event.client else None)
        return handle

    def on_button(self, button: Any, call: Callable[..., None], *arguments: Any) -> Any:
        """Call as `on` does; what goes wrong is said below the button, where the person looks; return the button.

        Call it where the button was just made: its sentence has the next place in the panel.
        """
        said = self.gui.add_markdown("", visible=False)

        def called() -> None:
            said.visible = False
            try:
                call(*arguments)
            except ScopemapError as error:
                said.content, said.visible = self._strong(_sentence(error)), True

        return self.on(button, called)

    def do(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call in the window's thread, after what is already to be done; may be called from any thread."""
        page = self._page

        def called() -> None:
            if page is self._page:
                with self._place:
                    call(*arguments)

        self._calls.put(called)

    def job(self, words: str, call: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Call in a thread of its own, one job after the other, with `words` shown; then `then` of what it returns."""
        self.say(f"{words} ...")
        page = self._page

        def ended(future: Future[Any]) -> None:
            def finish() -> None:
                self.clear_error()
                then(future.result())

            def finish_on_page() -> None:
                if page is self._page:
                    with self._place:
                        finish()

            self._calls.put(finish_on_page)

        self._worker.submit(call).add_done_callback(ended)

    def always(self, call: Callable[[], None]) -> None:
        """Call every half second, whatever page is shown."""
        self._ticking.append(call)

    def say(self, words: str) -> None:
        """Show a sentence above the page."""
        self._error.content, self._error.visible = escaped(self.names.hidden(words)), True
        self._log.visible = False

    def fail(self, words: str, log: str = "") -> None:
        """Show what went wrong above the page, with a log to copy."""
        self._error.content, self._error.visible = self._strong(words), True
        self._log.content, self._log.visible = fenced(self.names.hidden(log)), bool(log)

    def theme(self, *, dark: bool) -> None:
        """Show everything dark, or light."""
        self.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
        self.scene.set_background_image(np.full((1, 1, 3), _DARK if dark else _LIGHT, np.uint8), format="png")

    def clear_error(self) -> None:
        """Show nothing above the page."""
        self._error.visible = self._log.visible = False

    # What runs it.

    def run(self, ends: Callable[[], bool] = lambda: False) -> None:
        """Do what is to be done until `stop`, or until `ends`."""
        ticked_s = 0.0
        while not (self._ended or ends()):
            with suppress(queue.Empty):
                self._guarded(self._calls.get(timeout=_TICK_S / 5))
            if time.monotonic() - ticked_s > _TICK_S:
                ticked_s = time.monotonic()
                for call in (*self._ticking, *([self._page.tick] if self._page is not None else [])):
                    with self._place:
                        self._guarded(call)

    def stop(self) -> None:
        """End `run`; may be called from any thread."""
        self._ended = True

    def close(self) -> None:
        """End the page and the server."""
        if self._page is not None:
            self._page.close()
        self._worker.shutdown(wait=False, cancel_futures=True)
        stop_server(self.server)

    def _strong(self, words: str) -> str:
        return f"**{escaped(self.names.hidden(words))}**"

    def _show(self, page: Page) -> None:
        if self._page is not None:
            self._page.close()
            self._page = None
        self._place.remove()
        self.scene.remove_by_name("/page")
        self.clear_error()
        self._place = self.gui.add_folder(None)
        self._page = page
        with self._place:
            page.open(self)

    def _guarded(self, call: Callable[[], None]) -> None:
        try:
            call()
        except ScopemapError as error:
            self.fail(_sentence(error))
        except Exception as error:
            self.fail(f"something unexpected went wrong: {error}", traceback.format_exc())


def _sentence(error: ScopemapError) -> str:
    return "; ".join([str(error), *getattr(error, "__notes__", [])])


def typed_number(text: str) -> float:
    """Return the number that was typed, with a point or a comma; NaN for anything else."""
    try:
        found = float(text.strip().replace(",", "."))
    except ValueError:
        return float("nan")
    return found if np.isfinite(found) else float("nan")


def escaped(text: str) -> str:
    """Return a text as it is, in one line, for Markdown: names of files hold what has a meaning there."""
    line = " ".join(text.split())
    return "".join(f"\\{letter}" if letter in r"\`*_{}[]()<>#+-!|~&$" else letter for letter in line)


def fenced(text: str) -> str:
    """Return a text of several lines as it is, for Markdown: a box from which it can be copied."""
    longest = max((len(run) for run in re.findall("`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}\n{text}\n{fence}"
