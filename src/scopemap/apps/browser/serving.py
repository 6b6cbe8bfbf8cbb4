"""viser's server, for pages of this machine alone: other hosts and origins are refused, and nothing leaves it."""

from __future__ import annotations

import contextlib
import http
import io
import mimetypes
import re
import socket
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from scopemap.engine.errors import InputError
from scopemap.terminal.window_beside import check_installed

LOOPBACK = "127.0.0.1"
_OWN_NAMES = {LOOPBACK, "localhost", "[::1]", "::1"}
_ALL = ("0.0.0.0", "::")  # noqa: S104
_TITLE = "scopemap"
RUN_GOES_ON = "scopemap-run-goes-on"
"""Name of an element of the page; while it is there the page draws rarely, unless someone moves it."""
_RARELY = (Path(__file__).parent / "draw_rarely.js").read_text(encoding="utf-8").replace("ELEMENT", RUN_GOES_ON)
NEXT_CLICK = "scopemap-next-click"
"""Class of what says what the next click does: over the scene, so that it is seen wherever the panel is scrolled to."""
# viser docks panels at the left and right of the scene. The time line, which is docked at the left, belongs below the
# scene; in windows of up to 900 px so does the panel at the right, which would leave half of the width to the scene.
# In windows of 576 px and less viser has a layout of its own.
_STYLE = b"""<style>
@media (min-width: 577px) {
  [data-dock-root] { display: grid; grid-template: minmax(0, 1fr) auto / minmax(0, 1fr) auto; }
  [data-dock-root] > :first-child { position: relative !important; inset: 0 !important; grid-area: 1 / 1; }
  [data-dock-root] > [data-dock-region] { position: relative !important; inset: 0 !important; }
  [data-dock-root] > :not(:first-child):has(+ [data-dock-region]) { display: none; } /* shadows */
  [data-dock-region="left"] { grid-area: 2 / 1; width: auto !important; height: min(310px, 34vh); }
  [data-dock-region="left"] > div > div { width: 100% !important; }
  [data-dock-region="left"] :is([data-dock-region-handle], [data-dock-region-resize]) { display: none !important; }
  [data-dock-region="right"] { grid-area: 1 / 2 / 3 / 3; }
}
@media (min-width: 577px) and (max-width: 900px) {
  [data-dock-root] { grid-template: minmax(0, 1fr) auto 38% / minmax(0, 1fr); }
  [data-dock-region="left"] { height: min(270px, 28vh); }
  [data-dock-region="right"] { grid-area: 3 / 1; width: auto !important; }
  [data-dock-region="right"] > div > div { width: 100% !important; }
  [data-dock-region-handle], [data-dock-region-resize] { display: none !important; }
}
.NEXT_CLICK {
  position: fixed; left: 10px; top: 10px; max-width: min(480px, 50vw); padding: 4px 10px; border-radius: 6px;
  background: rgba(255, 255, 255, .9); color: #17202b; font-size: 15px; pointer-events: none;
}
.NEXT_CLICK.measures { font-weight: bold; border-left: 5px solid #228be6; }
</style>""".replace(b"NEXT_CLICK", NEXT_CLICK.encode())
# What the page may load: itself, what it makes in memory, and its own connection.
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval'; "
    "connect-src 'self' ws: data: blob:; form-action 'none'; frame-ancestors 'none'; object-src 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}


def start_server(port: int = 0, host: str = LOOPBACK, files: Mapping[str, Path] | None = None) -> Any:
    """Return viser's server at a port of this machine; 0: any free one.

    files : that are served beside viser's page, by their paths, such as "/result/report.html"; it may change later.

    Requests that name another host than this machine (unless `host` lets others in), and those of pages of another
    origin, are refused: a page in the web must not see an operation or press its buttons. viser's tunnel is closed.

    Raises `InputError` where viser is not installed or the port is taken.
    """
    check_installed()
    import viser
    from viser import _messages

    _refuse_taken(host, port)
    # It prints a banner.
    with (
        _guarded(only_own=host in _OWN_NAMES, files={} if files is None else files),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        server = viser.ViserServer(host, port, verbose=False)
    # viser keeps all of a file that is sent in memory, however large: `uploads.py` takes files instead.
    for refused in (_messages.ShareUrlRequest, _messages.FileTransferStartUpload, _messages.FileTransferPart):
        server._websock_server.unregister_handler(refused)
    return server


def url_of(host: str, port: int) -> str:
    """Return where a browser of this machine finds what is served at a host's port."""
    name = "localhost" if host in (LOOPBACK, *_ALL) else host
    return f"http://{f'[{name}]' if ':' in name else name}:{port}/"


def stop_server(server: Any) -> None:
    """Stop it; what it prints is left out."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _refuse_taken(host: str, port: int) -> None:
    """Raise `InputError` where nothing can be served there: viser would take the next port."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind((host, port))
    except (OSError, OverflowError) as error:
        raise InputError(f"cannot serve on {host}, port {port}: {error}; choose another one") from None


@contextlib.contextmanager
def _guarded(*, only_own: bool, files: Mapping[str, Path]) -> Iterator[None]:
    """Context in which servers of websockets refuse foreign requests, and serve files, as viser itself cannot."""
    import websockets.asyncio.server as websockets

    serve = websockets.serve

    @wraps(serve)
    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        checked = _checked(process_request, only_own=only_own, files=files)
        return serve(*arguments, process_request=checked, **options)

    websockets.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.serve = serve  # type: ignore[misc]


def _checked(answer: Callable[..., Any], *, only_own: bool, files: Mapping[str, Path]) -> Callable[..., Any]:
    """Return what answers a request with one of some files, or as `answer` does, where it may be answered."""

    def checked(connection: Any, request: Any) -> Any:
        if not _is_own(request.headers.get_all("Host"), request.headers.get_all("Origin"), only_own=only_own):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "only for pages of this machine\n")
        if (file := files.get(urlsplit(request.path).path)) is not None and file.is_file():
            return _file_response(file)
        # Compressed it could not be given a title.
        if "Accept-Encoding" in request.headers:
            del request.headers["Accept-Encoding"]
        response = answer(connection, request)
        if response is not None:
            for name, value in _HEADERS.items():
                response.headers[name] = value
            if response.headers.get("Content-Type", "").startswith("text/html"):
                head = f"<title>{_TITLE}</title><script>{_RARELY}</script>".encode() + _STYLE
                response.body = re.sub(rb"<title>.*?</title>", lambda found: head, response.body)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
        return response

    return checked


def _file_response(file: Path) -> Any:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    kind, content = mimetypes.guess_type(file.name)[0] or "application/octet-stream", file.read_bytes()
    headers = _HEADERS | {"Content-Type": kind, "Content-Length": str(len(content)), "Connection": "close"}
    return Response(http.HTTPStatus.OK, "OK", Headers(headers), content)


def _is_own(hosts: list[str], origins: list[str], *, only_own: bool) -> bool:
    """Return whether a request that names these hosts and origins is one of this machine's own page."""
    if len(hosts) != 1 or len(origins) > 1:
        return False
    try:
        named = urlsplit(f"//{hosts[0]}").hostname or ""
        return (not only_own or named in _OWN_NAMES) and all(urlsplit(one).netloc == hosts[0] for one in origins)
    except ValueError:  # brackets that do not close
        return False
