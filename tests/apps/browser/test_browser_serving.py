"""The window's server: for pages of this machine alone, in one sentence where it cannot serve, silent about names."""

from __future__ import annotations

import http.client
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import viser
from typer.testing import CliRunner
from viser import _messages as messages
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from scopemap.apps.browser import command
from scopemap.apps.browser.input_page import InputPage
from scopemap.apps.browser.names import Names
from scopemap.apps.browser.serving import url_of
from scopemap.apps.browser.start_page import StartPage
from scopemap.apps.browser.window import BrowserWindow, escaped, fenced
from scopemap.apps.browser.workspace import Workspace
from scopemap.cli.app import app
from tests.support.front_door import refused
from tests.support.window_without_browser import Client, element, press, settle, until, words

pytestmark = pytest.mark.slow

DEMO = Path(command.__file__).parents[1] / "demo" / "clip"


@pytest.fixture
def window() -> Iterator[BrowserWindow]:
    made = BrowserWindow()
    yield made
    made.close()


def port_of(window: BrowserWindow) -> int:
    return int(window.server.get_port())


def ask(window: BrowserWindow, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(window), timeout=10)
    connection.request("GET", "/", headers={"Host": f"localhost:{port_of(window)}"} | headers)
    return connection.getresponse()


def test_other_hosts_and_origins_are_refused(window: BrowserWindow) -> None:
    own = f"http://localhost:{port_of(window)}"
    assert ask(window).status == ask(window, Origin=own).status == 200
    for headers in ({"Host": "evil.example"}, {"Origin": "https://evil.example"}, {"Origin": "null"}, {"Host": ""}):
        assert ask(window, **headers).status == 403, headers
    # Another program's page at this machine is another origin.
    assert ask(window, Origin="http://localhost:1").status == 403
    for origin, host in (("https://evil.example", None), (None, "evil.example")):
        headers = {} if host is None else {"Host": host}
        with pytest.raises(InvalidStatus) as caught:
            connect(
                f"ws://127.0.0.1:{port_of(window)}/",
                origin=origin,  # type: ignore[arg-type]
                additional_headers=headers,
                subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            )
        assert caught.value.response.status_code == 403


def test_the_page_may_load_nothing_from_elsewhere(window: BrowserWindow) -> None:
    response = ask(window)
    policy = dict(part.strip().partition(" ")[::2] for part in response.headers["Content-Security-Policy"].split(";"))
    assert policy["default-src"].startswith("'self' ")
    assert not any(word in part for part in policy.values() for word in ("http", "*", "wss:"))
    assert response.headers["Cache-Control"] == "no-store"
    assert response.headers["X-Frame-Options"] == "DENY"
    assert b"<title>scopemap</title>" in response.read()


def test_no_client_opens_a_tunnel(window: BrowserWindow, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda self, **rest: asked.append(self))
    client = Client(window)
    client.send(messages.ShareUrlRequest())
    # What comes after it is handled after it.
    dark = window.dark
    client.send(messages.GuiUpdateMessage(dark._impl.uuid, {"value": True}))
    until(window, lambda: dark.value)
    client.close()
    assert asked == []
    assert messages.ShareUrlRequest not in window.server._websock_server._incoming_handlers


def test_light_and_dark_stay_from_page_to_page(
    tmp_path: Path, window: BrowserWindow, monkeypatch: pytest.MonkeyPatch
) -> None:
    themes: list[bool] = []
    monkeypatch.setattr(window.gui, "configure_theme", lambda **rest: themes.append(rest["dark_mode"]))
    with Workspace(tmp_path) as workspace:
        for _ in range(2):
            window.show(StartPage(workspace))
            settle(window)
        press(window, "Dark", True)
        window.show(StartPage(workspace))
        settle(window)
        assert element(window, "Dark").value
    assert themes == [True]


def test_a_taken_port_and_no_folder_are_one_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        said = refused(capfd, "app", tmp_path, "--port", taken.getsockname()[1], "--no-browser")
    assert "cannot serve on 127.0.0.1, port" in said
    assert "choose another one" in said
    assert "is no folder" in refused(capfd, "app", tmp_path / "none", "--no-browser")


def test_without_viser_one_sentence_says_how_to_get_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'scopemap[app]'" in refused(capfd, "app", tmp_path, "--no-browser")


@pytest.mark.parametrize(("host", "warns"), [("0.0.0.0", True), ("127.0.0.1", False)])
def test_an_address_that_others_reach_is_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str, warns: bool
) -> None:
    monkeypatch.setattr(command, "serve", lambda window, **rest: window.close())
    done = CliRunner().invoke(app, ["app", str(tmp_path), "--host", host, "--no-browser"])
    assert done.exit_code == 0
    assert ("whoever reaches 0.0.0.0 sees the pictures" in done.stderr) == warns


def test_where_it_is_can_be_opened_on_this_machine() -> None:
    assert url_of("0.0.0.0", 80) == url_of("127.0.0.1", 80) == "http://localhost:80/"
    assert url_of("::1", 80) == "http://[::1]:80/"
    assert url_of("theatre.example", 80) == "http://theatre.example:80/"


def test_anonymous_pages_show_no_names(tmp_path: Path) -> None:
    folder = tmp_path / "Mustermann_1970"
    folder.mkdir()
    (folder / "Erika.mp4").write_bytes((DEMO / "colon.mp4").read_bytes())
    (folder / "Erika_camera.yaml").write_bytes((DEMO / "camera.yaml").read_bytes())
    (folder / "Max.mp4").write_bytes(b"no video")
    names = ("Mustermann", "Erika", "Max", str(tmp_path))
    with Workspace(folder) as workspace:
        window = BrowserWindow(anonymous=True)
        try:
            window.show(StartPage(workspace))
            settle(window)
            assert element(window, "Video").options == ("choose ...", "video 1", "video 2")
            texts = [words(window)]
            press(window, "Video", "video 2")
            until(window, lambda: "video 2" in words(window) and "reading" in words(window))
            texts.append(words(window))
            press(window, "Back to the start")
            press(window, "Video", "video 1")
            assert isinstance(window._page, InputPage)
            until(window, lambda: "in a terminal" in words(window))
            texts.append(words(window))
            assert "calibration 1" in texts[-1]
            run = workspace.reconstruct(folder / "Max.mp4", [])
            press(window, "Back to the start")
            until(window, lambda: run.status == "failed" or workspace.runs.tick())
            until(window, lambda: "has failed" in words(window))
            texts.append(words(window))
            window._page.show_run(run)  # type: ignore[union-attr]
            until(window, lambda: "The run has failed" in words(window))
            texts.append(words(window))
        finally:
            window.close()
    assert [(name, text) for text in texts for name in names if name in text] == []


def test_names_are_replaced_as_words(tmp_path: Path) -> None:
    names = Names(anonymous=True)
    assert names.of(tmp_path / "col.mp4", "video") == names.of(tmp_path / "col.mp4", "video") == "video 1"
    assert names.of(tmp_path / "col_2.mp4", "video") == "video 2"
    names.hide_folder(tmp_path)
    said = f"reading {tmp_path}/col_2.mp4: see col.mp4 and col_3, not colonoscope"
    assert names.hidden(said) == "reading the folder/video 2: see video 1 and video 1_3, not colonoscope"
    assert Names().of(tmp_path / "col.mp4", "video") == "col.mp4"
    assert Names().hidden(said) == said


def test_texts_from_outside_are_no_markdown() -> None:
    assert escaped("<img src=x>\n# [a](b) `c`") == r"\<img src=x\> \# \[a\]\(b\) \`c\`"
    assert fenced("a\n```\n<b>") == "````\na\n```\n<b>\n````"
