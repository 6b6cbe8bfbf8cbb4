"""What tests of the window share: elements by their labels, pressed as a browser does; a client without a browser."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import viser
from viser import _messages as messages
from websockets.sync.client import connect

from scopemap.apps.browser.start_page import StartPage
from scopemap.apps.browser.window import BrowserWindow
from scopemap.apps.browser.workspace import Workspace

PATIENCE_S = 120.0


@contextmanager
def start_page(folder: Path) -> Iterator[tuple[BrowserWindow, Workspace]]:
    """Where a window shows the start page of a folder."""
    with Workspace(folder) as workspace:
        window = BrowserWindow()
        window.always(workspace.runs.tick)
        window.show(StartPage(workspace))
        settle(window)
        yield window, workspace
        window.close()


def until(window: BrowserWindow, is_so: Callable[[], object], patience_s: float = PATIENCE_S) -> None:
    """Run a window until something is so."""
    end = time.monotonic() + patience_s
    window.run(lambda: bool(is_so()) or time.monotonic() > end)
    assert is_so(), words(window)


def settle(window: BrowserWindow) -> None:
    """Let a window do what is to be done now."""
    done: list[int] = []
    window._calls.put(lambda: window._calls.put(lambda: done.append(1)))  # what is done may ask for more
    until(window, lambda: done)


def elements(window: BrowserWindow) -> list[Any]:
    """Return all elements of the panel that are there and seen, in order."""
    found: list[Any] = []

    def walk(container: Any) -> None:
        for child in container._children.values():
            if getattr(child, "visible", True):
                found.append(child)
                if hasattr(child, "_children"):
                    walk(child)

    walk(window.gui._container_handle_from_uuid["root"])
    return found


def words(window: BrowserWindow) -> str:
    """Return all that is to be read in the panel, without the marks of Markdown."""
    texts = []
    for element in elements(window):
        texts += [str(getattr(element, name)) for name in ("content", "label", "value") if hasattr(element, name)]
        texts += map(str, getattr(element, "options", ()))
    return "\n".join(texts).replace("\\", "").replace("**", "")


def element(window: BrowserWindow, label: str) -> Any:
    """Return the element of a label."""
    return next(one for one in elements(window) if getattr(one, "label", None) == label)


def press(window: BrowserWindow, label: str, value: Any = None) -> None:
    """Press a button, or give an input a value, as a browser does; and let the window do what follows."""
    handle = element(window, label)
    if value is not None:
        handle._impl.value = value
    for call in handle._impl.update_cb:
        call(SimpleNamespace(client=object(), target=handle))
    settle(window)


def seen_by_someone(window: BrowserWindow) -> None:
    """Let a window believe that a browser looks at it."""
    client = SimpleNamespace(camera=SimpleNamespace())
    window.server.get_clients = lambda: {0: client}


class Client:
    """A connection to a window as its page has one, that sends files."""

    def __init__(self, window: BrowserWindow) -> None:
        address = window.url.replace("http", "ws")
        self.socket = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None)  # type: ignore[list-item]

    def send(self, message: Any) -> None:
        self.socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def start(self, button: Any, name: str, size: int, number: str = "1") -> None:
        """Announce a file."""
        self.send(messages.FileTransferStartUpload(button._impl.uuid, number, name, "video/mp4", 9, size))

    def part(self, button: Any, index: int, content: bytes, number: str = "1") -> None:
        """Send a part of a file."""
        self.send(messages.FileTransferPart(button._impl.uuid, number, index, content))

    def close(self) -> None:
        self.socket.close()
