"""Pages at localhost: only for this machine's own pages; the live page and a run's page in a real browser."""

from __future__ import annotations

import http.client
import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from drawn_run import draw_run
from front_door import refused

from scopemap.engine.errors import InputError
from scopemap.report.serving import LocalServer, live_page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
STATE = {
    **{"state": "lost", "words": "lost: move back slowly", "reason": "too dark", "frame": 3, "frames_per_s": 14.5},
    **{"latency_ms": 71, "latency_p50_ms": 70, "latency_p95_ms": 99, "read": 40, "dropped": 2, "tracked": 30},
    **{"lost": 8, "map": 0, "path": [[0, 0, 0], [1, 0, 4], [3, 0, 9]], "scale_known": False, "snapshot": ""},
    "full": False,
    "coverage": {"count": 2, "drawn": True, "words": "Of map 1 until 9 s, 31 % was not seen"},
}


@pytest.fixture
def served() -> Iterator[tuple[LocalServer, list[str]]]:
    done: list[str] = []
    jpeg = cv2.imencode(".jpg", np.full((64, 80, 3), 140, np.uint8))[1].tobytes()
    pages = {
        "/": live_page,
        "/state": lambda: ("application/json", json.dumps(STATE).encode()),
        "/picture.jpg": lambda: ("image/jpeg", jpeg),
        "/coverage.png": lambda: ("image/jpeg", jpeg),
        "/later": lambda: None,
    }
    server = LocalServer(pages, {f"/{name}": lambda name=name: done.append(name) for name in ("pause", "reset")})  # type: ignore[misc]
    yield server, done
    server.close()


def _ask(server: LocalServer, method: str, path: str, host: str = "", origin: str = "") -> int:
    port = int(server.url.rstrip("/").rpartition(":")[2])
    connection = http.client.HTTPConnection("localhost", port, timeout=5)
    headers = {"Host": host or f"localhost:{port}"} | ({"Origin": origin} if origin else {})
    connection.request(
        method, path, headers={name: value.replace("PORT", str(port)) for name, value in headers.items()}
    )
    return connection.getresponse().status


def test_pages_and_actions_answer(served: tuple[LocalServer, list[str]]) -> None:
    server, done = served
    assert [_ask(server, "GET", path) for path in ("/", "/picture.jpg?3", "/later", "/none")] == [200, 200, 503, 404]
    assert _ask(server, "GET", "/", host="127.0.0.1:PORT") == 200
    assert _ask(server, "POST", "/pause", origin="http://localhost:PORT") == 204
    assert [_ask(server, "GET", "/pause"), _ask(server, "POST", "/none")] == [404, 404]
    assert done == ["pause"]


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("evil.example:PORT", ""),
        ("localhost", ""),
        ("", "http://evil.example"),
        ("", "null"),
        ("", "https://localhost:PORT"),
    ],
)
def test_other_hosts_and_origins_are_refused(served: tuple[LocalServer, list[str]], host: str, origin: str) -> None:
    server, done = served
    assert _ask(server, "GET", "/state", host, origin) == 403
    assert _ask(server, "POST", "/reset", host, origin) == 403
    assert done == []


def test_it_listens_at_localhost_alone_and_a_taken_port_is_refused(served: tuple[LocalServer, list[str]]) -> None:
    port = int(served[0].url.rstrip("/").rpartition(":")[2])
    # Another address of this machine.
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", port), timeout=5)
    with pytest.raises(InputError, match="choose another one"):
        LocalServer({}, port=port)


def _browser() -> Any:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    return playwright.sync_playwright()


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_the_live_page_shows_the_state_and_its_buttons_work(
    served: tuple[LocalServer, list[str]], size: tuple[int, int]
) -> None:
    server, done = served
    with _browser() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        faults: list[str] = []
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(server.url)
        page.locator("html[data-frame='3']").wait_for(timeout=20_000)
        assert page.locator("#state").inner_text() == "lost: move back slowly"
        assert "2 of 40 dropped" in page.locator("#facts").inner_text()
        assert "unknown" in page.locator("#facts").inner_text()
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        page.wait_for_timeout(300)
        assert page.evaluate("document.getElementById('picture').naturalWidth") == 80
        assert page.evaluate("document.getElementById('map').naturalWidth") == 80
        assert page.locator("#coverage").inner_text() == "Of map 1 until 9 s, 31 % was not seen"
        path = cv2.imdecode(np.frombuffer(page.locator("#path").screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert (np.abs(path.astype(int) - path[2, 2]).max(-1) > 60).sum() > 100  # the path is drawn
        page.click("#pause")
        page.click("#reset")
        page.wait_for_timeout(300)
        assert done == ["pause", "reset"]
        assert faults == []
        browser.close()


def test_view_serves_a_runs_page(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = draw_run(tmp_path / "run")
    command = [sys.executable, "-m", "scopemap", "view", str(run), "--no-browser"]
    # A job in the background of a shell ignores Ctrl-C, and so would its children.
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heed) as process:
        timer = threading.Timer(60, process.kill)
        timer.start()
        assert process.stdout is not None
        url = next(word for word in process.stdout.readline().split() if word.startswith("http"))
        with urlopen(url, timeout=10) as answer:
            assert f'"all_faces": {48 * 2 * 60 + 48}'.encode() in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
        timer.cancel()
    capfd.readouterr()
    assert "no finished run" in refused(capfd, "view", tmp_path / "none", "--no-browser")
