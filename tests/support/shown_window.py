"""A window without a browser: pages are shown in it, its buttons pressed, its words read."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from scopemap.apps.browser.serving import NEXT_CLICK
from scopemap.apps.browser.window import BrowserWindow, Page

_PATIENCE_S = 120.0


class ShownWindow:
    """A window that does what is to be done in the test's own thread."""

    def __init__(self, *, anonymous: bool = False) -> None:
        self.window = BrowserWindow(0, anonymous=anonymous)
        self.sent: dict[str, bytes] = {}
        """What the browser got, by the names of files."""

    def show(self, page: Page) -> None:
        """Show a page and do what it asks for at once."""
        self.window.show(page)
        self.settle()

    def settle(self) -> None:
        """Do what is to be done now, and what follows from it."""
        self.until(self.window._calls.empty)

    def until(self, found: Callable[[], bool]) -> None:
        """Do what is to be done until something is so; fail after two minutes."""
        end = time.monotonic() + _PATIENCE_S
        self.window.run(lambda: found() or time.monotonic() > end)
        assert found()

    def handles(self, kind: str) -> list[Any]:
        """The elements of a kind that are there, in the order in which they were made."""

        def inside(container: Any) -> Iterator[Any]:
            for child in (*getattr(container, "_children", {}).values(), *getattr(container, "_tab_handles", ())):
                yield child
                yield from inside(child)

        gui = self.window.gui
        roots = gui._container_handle_from_uuid["root"], *gui._panel_handle_from_uuid.values()
        return [one for root in roots for one in inside(root) if type(one).__name__ == f"Gui{kind}Handle"]

    def labels(self, kind: str = "Button") -> list[str]:
        """The labels of what is seen of a kind."""
        return [one.label for one in self.handles(kind) if one.visible]

    def element(self, kind: str, label: str) -> Any:
        """The element of a kind with a label; one that begins with it will do."""
        return next(one for one in self.handles(kind) if str(one.label).startswith(label) and one.visible)

    def press(self, label: str) -> None:
        """Press a button, as a browser does."""
        self._tell(self.element("Button", label))

    def choose(self, kind: str, label: str, value: Any) -> None:
        """Set an input, or press a button of a group, as a browser does."""
        handle = self.element(kind, label)
        handle._impl.value = value
        self._tell(handle)

    def _tell(self, handle: Any) -> None:
        def send(name: str, content: bytes, *, save_immediately: bool) -> None:
            assert save_immediately  # else one has to click once more
            self.sent[name] = content

        for call in handle._impl.update_cb:
            call(SimpleNamespace(client=SimpleNamespace(send_file_download=send), target=handle))
        self.settle()

    @property
    def ways(self) -> tuple[str, ...]:
        """The buttons above the tabs of a result."""
        return tuple(self.element("ButtonGroup", "").options)

    @property
    def nodes(self) -> dict[str, Any]:
        """What is in the scene, by name."""
        return dict(self.window.scene._handle_from_node_name)

    @property
    def next_click(self) -> str:
        """What stands over the scene: what the next click does."""
        (over,) = (one.content for one in self.handles("Html") if NEXT_CLICK in one.content)
        return re.sub("<[^>]*>", "", over)

    @property
    def words(self) -> str:
        """All sentences that are seen, without the signs of Markdown."""
        texts = [one.content for one in self.handles("Markdown") if one.visible]
        return "\n".join(texts).replace("\\", "").replace("**", "")


@contextmanager
def shown_window(*, anonymous: bool = False) -> Iterator[ShownWindow]:
    """Context in which there is a window."""
    shown = ShownWindow(anonymous=anonymous)
    try:
        yield shown
    finally:
        shown.window.close()
