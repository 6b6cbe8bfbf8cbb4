"""Videos that are sent to the window's page: streamed to disk, limited, and gone with the session unless kept."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from scopemap.apps.browser import command
from scopemap.apps.browser.input_page import InputPage
from scopemap.apps.browser.start_page import StartPage
from scopemap.apps.browser.window import BrowserWindow
from scopemap.apps.browser.workspace import Workspace
from tests.support.window_without_browser import Client, element, press, settle, until, words

LIMIT = 100_000
CLIP = Path(command.__file__).parents[1] / "demo" / "clip"


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[tuple[BrowserWindow, Workspace, Client]]:
    with Workspace(tmp_path, most_bytes=LIMIT) as workspace:
        window = BrowserWindow()
        window.show(StartPage(workspace))
        settle(window)
        client = Client(window)
        yield window, workspace, client
        client.close()
        window.close()


def files(workspace: Workspace) -> list[str]:
    return sorted(path.name for path in workspace.uploads.iterdir()) if workspace.uploads.is_dir() else []


def button(window: BrowserWindow) -> Any:
    return element(window, "Send a video")


def test_a_file_is_written_as_it_comes_under_its_safe_name(
    opened: tuple[BrowserWindow, Workspace, Client],
) -> None:
    window, workspace, client = opened
    client.start(button(window), "../../Müller 1970.MP4", 10)
    client.part(button(window), 0, b"01234")
    until(window, lambda: workspace.receiver(window.server, "video").progress == 50)
    assert files(workspace) == ["Müller_1970.mp4.part"]
    assert workspace.sent == []
    client.part(button(window), 1, b"56789")
    until(window, lambda: isinstance(window._page, InputPage))
    file = workspace.uploads / "Müller_1970.mp4"
    assert file.read_bytes() == b"0123456789"
    assert workspace.sent == [file]
    # Messages name it, and no temporary folder; so does its result.
    until(window, lambda: "reading the video" in words(window))
    assert "reading the video Müller_1970.mp4" in words(window)
    assert "scopemap-app-" not in words(window)
    assert workspace.new_result(file) == workspace.results / "Müller_1970"
    # What cannot be read is no video: the list does not offer it.
    assert "the file is not kept" in words(window)
    assert workspace.sent == []


def test_a_letter_keeps_its_name_and_is_not_listed(opened: tuple[BrowserWindow, Workspace, Client]) -> None:
    window, workspace, client = opened
    client.start(button(window), "letter.pdf", 10)
    client.part(button(window), 0, b"%PDF-1.4\n\n")
    until(window, lambda: "the file is not kept" in words(window))
    assert "letter.pdf" in words(window)
    assert "letter.pdf.video" not in words(window)
    assert files(workspace) == []


@pytest.mark.parametrize(
    ("size", "parts", "sentence"),
    [
        (2 * LIMIT, [], "the video has 200.0 kB, at most 100.0 kB are taken"),
        (0, [], "is empty"),
        (6, [(1, b"abc")], "its parts do not make up the file"),
        (6, [(0, b"abc"), (0, b"abc")], "its parts do not make up the file"),
        (2, [(0, b"abc")], "its parts do not make up the file"),
    ],
)
def test_what_is_refused_is_refused_in_a_sentence(
    opened: tuple[BrowserWindow, Workspace, Client], size: int, parts: list[tuple[int, bytes]], sentence: str
) -> None:
    window, workspace, client = opened
    client.start(button(window), "a.mp4", size)
    for index, content in parts:
        client.part(button(window), index, content)
    until(window, lambda: sentence in words(window))
    assert "a.mp4 was not taken: " in words(window)
    assert files(workspace) == []
    # What is still sent of it is dropped, and the next one is taken.
    client.part(button(window), 5, b"more")
    client.start(button(window), "b.mkv", 1, "2")
    client.part(button(window), 0, b"x", "2")
    until(window, lambda: files(workspace) == ["b.mkv"])


def test_a_full_disk_and_other_buttons_take_nothing(
    opened: tuple[BrowserWindow, Workspace, Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    window, workspace, client = opened
    # viser's own would keep it in memory, for any element.
    client.start(element(window, "Try the demonstration"), "a.mp4", 5, "0")
    client.part(element(window, "Try the demonstration"), 0, b"12345", "0")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=500_000_001))
    client.start(button(window), "a.mp4", 5)
    until(window, lambda: "make room first" in words(window))
    assert files(workspace) == []
    assert not window.gui._current_file_upload_states


def test_what_came_in_part_goes_with_its_browser_and_with_the_window(
    opened: tuple[BrowserWindow, Workspace, Client],
) -> None:
    window, workspace, client = opened
    other = Client(window)
    for number, sender in (("1", client), ("2", other)):
        sender.start(button(window), "a.mp4", 10, number)
        sender.part(button(window), 0, b"0", number)
    until(window, lambda: len(files(workspace)) == 2)
    other.part(button(window), 1, b"123456789", "1")  # of another's file
    other.close()
    until(window, lambda: files(workspace) == ["a.mp4.part"])
    until(window, lambda: "the connection to the page was lost" in words(window))
    workspace.receiver(window.server, "video").close()
    assert files(workspace) == []


def send(client: Client, handle: Any, name: str, content: bytes, number: str) -> None:
    client.start(handle, name, len(content), number)
    client.part(handle, 0, content, number)


@pytest.mark.slow
def test_a_calibration_is_sent_and_chosen(opened: tuple[BrowserWindow, Workspace, Client]) -> None:
    window, workspace, client = opened
    for name in ("colon.mp4", "camera.yaml"):
        shutil.copyfile(CLIP / name, workspace.folder / name)
    (workspace.folder / "broken_camera.yaml").write_text("patient: 12")
    window.show(StartPage(workspace))
    settle(window)
    press(window, "Video", "colon.mp4")
    until(window, lambda: "in a terminal" in words(window))
    page: Any = window._page
    first = page.choice
    assert first.camera == workspace.folder / "camera.yaml"
    # One beside the video that cannot be read is a sentence at once, and the choice stays.
    press(window, "Camera", "broken_camera.yaml")
    assert "broken_camera.yaml cannot be used: it has no 3x3 camera matrix" in words(window)
    assert (page.choice, element(window, "Camera").value) == (first, "camera.yaml")
    handle = element(window, "Send a calibration")
    send(client, handle, "my camera.yaml", b"patient: 12", "1")
    until(window, lambda: "the calibration my_camera.yaml cannot be used" in words(window))
    assert workspace.sent_calibrations == []
    client.start(handle, "large.yaml", 2_000_000, "2")
    until(window, lambda: "large.yaml was not taken: the calibration has 2.0 MB, at most 1.0 MB" in words(window))
    assert page.choice == first
    # Two of one name are told from each other, and the one that was sent is chosen.
    send(client, handle, "camera.yaml", (CLIP / "camera.yaml").read_bytes(), "3")
    until(window, lambda: page.choice != first)
    sent = workspace.calibrations / "camera.yaml"
    assert page.choice.arguments() == [f"--camera={sent}"]
    assert element(window, "Camera").value == "camera.yaml (2)"
    assert "--camera=camera.yaml" in words(window)
    assert "was not taken" not in words(window)
    press(window, "Camera", "estimated from the video")
    assert page.choice.arguments() == []
    # It is there for the next video, and never taken unasked.
    window.show(InputPage(workspace, workspace.folder / "colon.mp4", lambda run: None, window.start))
    settle(window)
    until(window, lambda: "in a terminal" in words(window))
    assert "camera.yaml (2)" in element(window, "Camera").options
    assert element(window, "Camera").value == "camera.yaml"


def test_folders_of_ours_are_no_interrupted_runs(tmp_path: Path) -> None:
    with Workspace(tmp_path, keep_uploads=True) as workspace:
        workspace.new_upload("a.mp4")
        assert workspace.uploads.is_dir()
        assert workspace.interrupted == []


@pytest.mark.parametrize("keep", [True, False])
def test_uploads_go_with_the_session_unless_they_are_kept(tmp_path: Path, keep: bool) -> None:
    with Workspace(tmp_path, keep_uploads=keep) as workspace:
        file = workspace.new_upload("a.mp4")
        file.write_bytes(b"x")
    assert file.exists() == keep
    assert file.is_relative_to(tmp_path / "scopemap" / "uploads") == keep
    assert workspace.uploads.parent.exists() == keep


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("Mu\u0308ller, Erika.MP4", "M\u00fcller_Erika.mp4"),
        ("../../etc/passwd", "passwd.video"),
        ("-rf $(x).mkv", "rf_x_.mkv"),
        (".avi", "avi.video"),
        ("", "file.video"),
        ("a\0b\n<i>.avi", "a_b_i_.avi"),
        ("clip.divx", "clip.divx.video"),
        ("\u624b" * 300 + ".mp4", "\u624b" * 60 + ".mp4"),
    ],
)
def test_a_name_is_made_safe_and_numbered_where_it_is_taken(tmp_path: Path, given: str, kept: str) -> None:
    with Workspace(tmp_path) as workspace:
        file = workspace.new_upload(given)
        assert file == workspace.uploads / kept
        file.write_bytes(b"x")
        again = workspace.new_upload(given)
        assert again == file.with_stem(f"{file.stem}_2")
        again.with_name(f"{again.name}.part").write_bytes(b"x")
        assert workspace.new_upload(given) == file.with_stem(f"{file.stem}_3")
        assert workspace.sent == [file]


def test_an_anonymous_page_names_no_file_that_was_refused(tmp_path: Path) -> None:
    with Workspace(tmp_path, most_bytes=LIMIT) as workspace:
        window = BrowserWindow(anonymous=True)
        window.show(StartPage(workspace))
        settle(window)
        client = Client(window)
        client.start(button(window), "Erika.mp4", 2 * LIMIT)
        until(window, lambda: "video 1 was not taken" in words(window))
        assert "Erika" not in words(window)
        client.close()
        window.close()
