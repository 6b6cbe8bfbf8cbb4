"""Files that are sent to the page: written to disk part by part as they come, limited, under their names made safe.

viser's own handlers keep a whole file in memory. Its client sends all parts without waiting, shows a notification of
its own, and takes a file for sent when as many bytes as it has were acknowledged.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

PART = ".part"
"""What the name of a file ends in while it comes."""
UNKNOWN_KIND = ".video"
"""What is added to the name of a video of a kind that is not known, so that it is read as nothing else; not shown."""
_MOST_AT_ONCE = 4
_KEPT_FREE_BYTES = 500_000_000
_QUIET_EVERY_S = 0.5
_LOST = "the connection to the page was lost while it was sent: send it again"


@dataclass
class _Transfer:
    """A file that is being sent by a client: its parts so far are in `part`, and go to `path` in the end."""

    client: int
    button: str
    name: str
    size: int
    path: Path
    part: Path
    file: IO[bytes]
    parts: int = 0
    received: int = 0
    quieted_s: float = 0.0


class Receiver:
    """Takes files of a kind that are sent by the page's button, in place of viser's handlers.

    server : viser's. kind : in a word. new_file : returns where a file of a name goes; its folder exists.
    most_bytes : of one file. advice : what to do with a larger one.
    What comes of them is asked for: `take` and `take_refusal`. Called in viser's thread, which therefore waits for the
    disk: no more than a few parts are ever in memory.
    """

    def __init__(
        self, server: Any, kind: str, new_file: Callable[[str], Path], most_bytes: int, advice: str = ""
    ) -> None:
        from viser import _messages as messages

        self._server, self._messages, self._kind = server, messages, kind
        self._new_file, self._most_bytes, self._advice = new_file, most_bytes, advice
        self._transfers: dict[str, _Transfer] = {}
        self._buttons: set[str] = set()
        self._arrived: deque[Path] = deque()
        self._refusals: deque[tuple[str, str]] = deque()
        self._lock = threading.Lock()
        server._websock_server.register_handler(messages.FileTransferStartUpload, self._start)
        server._websock_server.register_handler(messages.FileTransferPart, self._take_part)
        # Not the server's own: it tells nothing of clients that never sent where they look from.
        server._websock_server.on_client_disconnect(self._disconnected)

    def button(self, gui: Any, label: str, offered: str = "*/*") -> Any:
        """Return a new button that sends a file; offered : which files the browser offers, as in HTML's `accept`."""
        handle = gui.add_upload_button(label, mime_type=offered)
        self._buttons = {handle._impl.uuid}
        return handle

    @property
    def progress(self) -> float | None:
        """How much of what is being sent has come, percent; None where nothing is."""
        transfers = list(self._transfers.values())
        if not transfers:
            return None
        return 100 * sum(one.received for one in transfers) / sum(one.size for one in transfers)

    def take(self) -> Path | None:
        """Return the next file that has come since the last call, or None."""
        return self._arrived.popleft() if self._arrived else None

    def take_refusal(self) -> tuple[str, str] | None:
        """Return the name of a file that was refused since the last call, and why in a sentence; or None."""
        return self._refusals.popleft() if self._refusals else None

    def close(self) -> None:
        """Remove what has come in part."""
        with self._lock:
            for number in list(self._transfers):
                self._drop(number)

    def _start(self, client: int, message: Any) -> None:
        if message.source_component_uuid not in self._buttons:
            return
        size, number, button = int(message.size_bytes), str(message.transfer_uuid), message.source_component_uuid
        name = Path(str(message.filename)).name or self._kind
        with self._lock:
            if (reason := self._reason(size)) is None and number not in self._transfers:
                try:
                    path = self._new_file(name)
                    part = path.with_name(path.name + PART)
                    file = part.open("xb")
                except OSError as error:
                    reason = f"the {self._kind} cannot be kept: {error.strerror or error}"
                else:
                    self._transfers[number] = _Transfer(client, button, name, size, path, part, file)
            if reason is not None:
                self._refusals.append((name, reason))
                self._end_in_client(client, number, button, size)
                return
        self._quiet(client, number)

    def _reason(self, size: int) -> str | None:
        """Return why a file of a size, bytes, is refused; None: it is not."""
        if size <= 0:
            return "the file that was sent is empty"
        if size > self._most_bytes:
            most = _in_words(self._most_bytes)
            return f"the {self._kind} has {_in_words(size)}, at most {most} are taken{self._advice}"
        if len(self._transfers) >= _MOST_AT_ONCE:
            return f"{_MOST_AT_ONCE} files are being sent: wait for one of them"
        coming = sum(one.size - one.received for one in self._transfers.values())
        # Its folder may not exist before it has a name.
        folder = self._new_file("").parent
        free = shutil.disk_usage(folder).free - coming
        if size + _KEPT_FREE_BYTES > free:
            left = _in_words(max(free, 0))
            return f"the {self._kind} has {_in_words(size)}, and the disk has {left} left: make room first"
        return None

    def _take_part(self, client: int, message: Any) -> None:
        number = str(message.transfer_uuid)
        with self._lock:
            transfer = self._transfers.get(number)
            # Parts of a refused file keep coming: its sender cannot be stopped.
            if transfer is None or transfer.client != client:
                return
            transfer.received += len(message.content)
            try:
                fits = message.part_index == transfer.parts and transfer.received <= transfer.size
                if not (fits and isinstance(message.content, bytes)):
                    raise OSError("its parts do not make up the file that was announced")
                transfer.parts += 1
                transfer.file.write(message.content)
                if transfer.received == transfer.size:
                    transfer.file.close()
                    transfer.part.replace(transfer.path)
            except OSError as error:
                self._refusals.append((transfer.name, f"the {self._kind} cannot be kept: {error.strerror or error}"))
                self._drop(number)
                self._end_in_client(client, number, transfer.button, transfer.size)
                return
            if transfer.received == transfer.size:
                del self._transfers[number]
                self._arrived.append(transfer.path)
                self._end_in_client(client, number, transfer.button, transfer.size)
            elif time.monotonic() - transfer.quieted_s > _QUIET_EVERY_S:
                transfer.quieted_s = time.monotonic()
                self._quiet(client, number)

    def _disconnected(self, client: Any) -> None:
        with self._lock:
            for number in [number for number, one in self._transfers.items() if one.client == client.client_id]:
                self._refusals.append((self._transfers[number].name, _LOST))
                self._drop(number)

    def _drop(self, number: str) -> None:
        transfer = self._transfers.pop(number)
        with suppress(OSError):
            transfer.file.close()
        transfer.part.unlink(missing_ok=True)

    def _quiet(self, client: int, number: str) -> None:
        """Hide the client's own notification, which shows the file's name and would call a refused file a success."""
        self._send(client, self._messages.RemoveNotificationMessage(f"upload-{number}"))

    def _end_in_client(self, client: int, number: str, button: str, size: int) -> None:
        self._quiet(client, number)
        self._send(client, self._messages.FileTransferPartAck(button, number, size, size))

    def _send(self, client: int, message: Any) -> None:
        """Send to one browser alone: to all, it would be kept for all that ever come."""
        handle = self._server.get_clients().get(client)
        if handle is not None:
            handle._websock_connection.queue_message(message)


def _in_words(size: int) -> str:
    unit, name = next(((u, n) for u, n in ((1e9, "GB"), (1e6, "MB")) if size >= u), (1e3, "kB"))
    return f"{size / unit:.1f} {name}"
