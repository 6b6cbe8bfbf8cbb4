"""A small server for pages of this machine's own browser: localhost only, requests of other pages are refused."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any

from scopemap.engine.errors import InputError

Content = tuple[str, bytes]
"""A content type and bytes."""

_ADDRESS = "127.0.0.1"
_MOST_SENT = 1_000_000
_HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}


class LocalServer:
    """Serves pages at http://localhost:PORT/ in threads of its own until it is closed.

    pages : by path, what returns a GET's content; None: not there yet (503). actions : by path, what a POST calls.
    uploads : by path, what a POST calls with the bytes that were sent, at most 1 MB; an `InputError` there answers 400.
    port : 0: any free one. Requests that name another host, and those that pages of another origin send, are refused
    (403): a page in the web must not read an operation or press its buttons.

    Raises `InputError` where the port is taken.
    """

    def __init__(
        self,
        pages: Mapping[str, Callable[[], Content | None]],
        actions: Mapping[str, Callable[[], None]] | None = None,
        port: int = 0,
        uploads: Mapping[str, Callable[[bytes], None]] | None = None,
    ) -> None:
        try:
            self._server = _Server((_ADDRESS, port), _handler(pages, actions or {}, uploads or {}))
        except (OSError, OverflowError) as error:
            raise InputError(f"cannot serve on port {port}: {error}; choose another one") from None
        self.url = f"http://localhost:{self._server.server_port}/"
        """Where the page is."""
        threading.Thread(target=self._server.serve_forever, name="serve", daemon=True).start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """Does not ask for the name of 127.0.0.1: where no file of the machine knows it, a name server would be asked."""

    def server_bind(self) -> None:
        TCPServer.server_bind(self)
        self.server_name, self.server_port = _ADDRESS, self.server_address[1]


def live_page() -> Content:
    """Return the page of a live session."""
    return "text/html; charset=utf-8", (files("scopemap.report") / "assets" / "live.html").read_bytes()


def _handler(
    pages: Mapping[str, Callable[[], Content | None]],
    actions: Mapping[str, Callable[[], None]],
    uploads: Mapping[str, Callable[[bytes], None]],
) -> type[BaseHTTPRequestHandler]:
    """Return the class that answers requests."""

    class Handler(BaseHTTPRequestHandler):
        server: ThreadingHTTPServer
        timeout = 30

        def do_GET(self) -> None:
            if not self._is_own():
                return
            page = pages.get(self.path.partition("?")[0])
            if page is None:
                self._answer(404, "text/plain", b"no such page")
                return
            content = page()
            if content is None:
                self._answer(503, "text/plain", b"not there yet")
            else:
                self._answer(200, *content)

        def do_POST(self) -> None:
            if not self._is_own():
                return
            action, upload = actions.get(self.path), uploads.get(self.path)
            if action is not None:
                action()
            found = 404 if action is None else 204
            self._answer(_taken(self, upload) if upload is not None else found, "text/plain", b"")

        def _is_own(self) -> bool:
            """Return whether the request is for this server and from its own page or no page; else refuse it."""
            own = [f"{name}:{self.server.server_port}" for name in (_ADDRESS, "localhost")]
            origin = self.headers.get("Origin")
            if self.headers.get("Host") in own and (origin is None or origin in [f"http://{host}" for host in own]):
                return True
            self._answer(403, "text/plain", b"only for pages of this machine")
            return False

        def _answer(self, code: int, kind: str, content: bytes) -> None:
            self.send_response(code)
            for name, value in (_HEADERS | {"Content-Type": kind, "Content-Length": str(len(content))}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *values: Any) -> None:
            """Log nothing."""

    return Handler


def _taken(request: BaseHTTPRequestHandler, upload: Callable[[bytes], None]) -> int:
    """Hand on what a request sends, and return the code of the answer."""
    size = request.headers.get("Content-Length", "")
    if not size.isdecimal() or len(size) > 9 or int(size) > _MOST_SENT:
        return 413
    try:
        upload(request.rfile.read(int(size)))
    except InputError:
        return 400
    return 204
