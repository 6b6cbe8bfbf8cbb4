"""Files of a result: its report and its surface in one click, other forms and a film; all are named after the video."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.window import BrowserWindow, escaped
from scopemap.apps.export.formats import FORMATS, export_run
from scopemap.report.page import PAGE, page_to_send
from scopemap.report.reference_scale import holds_for, reference_scale
from scopemap.result.result import Result
from scopemap.result.result_folder import SUMMARY_PICTURE

EXPORTS = "exports"
"""Folder of a result with what the window wrote; `verify` knows it."""
_FILM = "film of the video beside the surface"
_FILM_FILE = "film.mp4"
_SURFACES = {
    "Surface for viewing (GLB)": "glb",
    "Surface for 3D Slicer": "slicer",
    "Surface for printing (STL)": "stl",
}
_MOST_SENT = 100_000_000
_PLACE = "/result/"
_BESIDE = (SUMMARY_PICTURE, "mesh.ply", "mesh.glb", "trajectory.tum", "frames.csv", "provenance.json")
"""What the report links to."""


class FilesPart:
    """Controls of the report and of exports."""

    def __init__(self, shown: ShownResult) -> None:
        self._shown, window, gui = shown, shown.window, shown.window.gui
        page = shown.whole.folder / PAGE
        window.files.clear()
        if page.is_file() and window.anonymous:
            gui.add_markdown(f"The report, which names the video, is in the result's folder: {PAGE}")
        elif page.is_file():
            window.files.update({_PLACE + name: shown.whole.folder / name for name in (PAGE, *_BESIDE)})
            link = f'<a href="{_PLACE}{PAGE}" target="_blank" rel="noopener" style="color:#228be6">Open the report</a>'
            gui.add_html(f'<div style="margin:4px 8px;font-size:15px">{link}</div>')
            self._on_press("Download the report", partial(self._send, page))
            gui.add_markdown("It is one file to keep, print or send.")
        if not shown.surface.is_empty:
            self._which = gui.add_markdown("")
            shown.follow(submap=self._say_which, sizes=self._say_which)
            self._say_which()
            for label, name in _SURFACES.items():
                self._on_press(label, partial(self._write, name))
        with gui.add_folder("All other forms", expand_by_default=False):
            self._to = gui.add_dropdown("Format", [_FILM, *FORMATS])
            self._on_press("Write", lambda client: self._write(self._to.value, client))
        self._words = gui.add_markdown("")

    def _say_which(self) -> None:
        shown = self._shown
        self._which.content = escaped(surface_words(shown.run))

    def _on_press(self, label: str, call: Callable[[Any], None]) -> None:
        """Make a button whose press calls with the browser that it came from."""
        window = self._shown.window
        window.gui.add_button(label).on_click(lambda event: window.do(call, event.client))

    def _write(self, name: str, client: Any) -> None:
        run = self._shown.run
        out = export_place(run.folder, name)
        words = f"writing {out.name}"
        self._shown.window.job(words, writer(run.folder, name, out), lambda found: self._send(out, client))

    def _send(self, file: Path, client: Any) -> None:
        """Say where a file or folder is, and send it, a folder as ZIP, to a browser, unless it is too large."""
        where = f"RESULT/{file.parent.name}/{file.name}" if self._shown.window.anonymous else str(file)
        parts = [file] if file.is_file() else [part for part in sorted(file.rglob("*")) if part.is_file()]
        is_sent = client is not None and sum(part.stat().st_size for part in parts) <= _MOST_SENT
        if is_sent:
            content = zipped(file, parts) if file.is_dir() else sent_bytes(file)
            client.send_file_download(self._name(file), content, save_immediately=True)
        said = (
            "Sent to your browser, which saves it. It is also"
            if is_sent
            else "Too large to be sent to your browser. It is"
        )
        self._words.content = f"{said} here: {escaped(where)}"

    def _name(self, file: Path) -> str:
        """Return the name of a file that is sent: that of the video, and what it is."""
        video = video_name(self._shown.window, self._shown.whole)
        ending = file.suffix if file.is_file() else ".zip"
        return f"{video}{ending}" if file.stem.split("_")[0] in _SURFACES.values() else f"{video}_{file.stem}{ending}"


def video_name(window: BrowserWindow, run: Result) -> str:
    """Return the name of a result's video, without its ending, for names of files that are sent."""
    source = Path(str(run.provenance.get("input", "")))
    return Path(window.names.of(source, "video")).stem or "result"


def surface_words(run: Result) -> str:
    """Return which part of the video the surface in the files is, and what its numbers are, as sentences.

    run : the result or the submap that is exported.
    """
    segments, main = run.segments, run.main_segment
    part = f"the part from {segments[main].words}" if len(segments) > 1 else "the whole result"
    which, units = f"The surface is that of {part}.", "Its numbers are mm in STL and 3D Slicer, m in GLB"
    if run.scale_known:
        return f"{which} {units}."
    known = reference_scale(run)
    if known is None:
        return f"{which} Its scale is unknown: its numbers are no mm."
    if holds_for(known, run, main):
        return f"{which} {units}: those of the result times {known.factor:.3g}, by your {known.words}."
    elsewhere = f"your {known.words} holds only for the part from {segments[known.segment].words}"
    return f"{which} Its numbers are no mm: {elsewhere}."


def sent_bytes(file: Path) -> bytes:
    """Return the content of a file as it is sent; the report without links to the files beside it."""
    return page_to_send(file) if file.name == PAGE else file.read_bytes()


def zipped(folder: Path, parts: list[Path]) -> bytes:
    """Return files of a folder as ZIP, with the folder's name before theirs."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in parts:
            archive.write(part, part.relative_to(folder.parent))
    return content.getvalue()


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
