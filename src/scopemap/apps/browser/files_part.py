"""Files of a result: exports and a film, written beside it and downloaded; where the report is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from scopemap.apps.browser.result_view import ResultView
from scopemap.apps.browser.window import escaped
from scopemap.apps.export.formats import FORMATS, export_run
from scopemap.report.page import PAGE

EXPORTS = "exports"
"""Folder of a result with what the window wrote; `verify` names it as added."""
_FILM = "film of the video beside the surface"
_FILM_FILE = "film.mp4"
_MOST_SENT = 100_000_000


class FilesPart:
    """Controls of exports."""

    def __init__(self, view: ResultView) -> None:
        self._view, window, gui = view, view.window, view.window.gui
        self._file: Path | None = None
        page = view.whole.folder / PAGE
        if page.is_file():
            where = PAGE if window.anonymous else str(page)
            gui.add_markdown(f"The report is one file to keep, print or send: `{where}`")
        self._to = gui.add_dropdown("Format", [_FILM, *FORMATS])
        window.on(gui.add_button("Write"), self._write)
        self._words = gui.add_markdown("")
        self._download = gui.add_button("Download", visible=False)
        self._download.on_click(lambda event: window.do(self._send, event.client))

    def _write(self) -> None:
        name, run = self._to.value, self._view.run
        out = export_place(run.folder, name)
        self._view.window.job(f"writing {out.name}", writer(run.folder, name, out), lambda found: self._say(out))

    def _say(self, out: Path) -> None:
        where = f"RESULT/{EXPORTS}/{out.name}" if self._view.window.anonymous else str(out)
        self._file = out if out.is_file() and out.stat().st_size <= _MOST_SENT else None
        self._words.content = f"Written: {escaped(where)}"
        self._download.visible = self._file is not None

    def _send(self, client: Any) -> None:
        if self._file is not None and client is not None:
            client.send_file_download(self._file.name, self._file.read_bytes())


def export_place(folder: Path, name: str) -> Path:
    """Return the file or folder that an export of a result is written to, numbered where that is taken."""
    ending = Path(_FILM_FILE).suffix if name == _FILM else FORMATS[name].ending
    stem = Path(_FILM_FILE).stem if name == _FILM else name
    number, place = 1, folder / EXPORTS / f"{stem}{ending}"
    while place.exists():
        number += 1
        place = folder / EXPORTS / f"{stem}_{number}{ending}"
    return place


def writer(folder: Path, name: str, out: Path) -> Callable[[], object]:
    """Return what writes an export of a result."""
    if name != _FILM:
        return lambda: export_run(folder, name, out)
    from scopemap.apps.view.fly_through import write_fly_through

    def write() -> None:
        out.parent.mkdir(exist_ok=True)
        write_fly_through(folder, out)

    return write
