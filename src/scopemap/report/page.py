"""report.html and summary.png of a run: one page without any request to a network, and one picture."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.engine.errors import reporting
from scopemap.report.facts import report_facts
from scopemap.report.frame_pictures import FOLDER as PICTURES
from scopemap.report.measured_by_hand import MEASUREMENTS, checked_measurements
from scopemap.report.page_data import by_hand_data, page_data
from scopemap.report.pale_parts import LEAST_COLOUR, PALE, SURE_CONFIDENCE, WORDS
from scopemap.report.shown_mesh import MOST_FACES, base64_of
from scopemap.report.summary_picture import summary_picture
from scopemap.result.checksums import SUMS, write_checksums
from scopemap.result.json_numbers import without_nan
from scopemap.result.result import Result
from scopemap.result.result_folder import SUMMARY_PICTURE

PAGE = "report.html"
_SCRIPTS = (
    "matrices", "surface_view", "frame_panels", "curves", "words", "atlas", "places", "measured", "page", "gestures",
)  # fmt: skip
_DATA = re.compile(r'(<script type="application/json" id="data">)(.*?)(</script>)', re.DOTALL)
_LINK = re.compile(r"<a data-file>([^<]*)</a>")
"""A link to a file beside the page."""
_LICENCES = (
    "Licences: scopemap and its depth network scopenet are under Apache-2.0. Weights of other networks have licences "
    "of their own, named by `scopemap models list`; some forbid commercial use. The video and its data set keep theirs."
)


def write_report(folder: Path | str) -> list[Path]:
    """Write report.html and summary.png into a run's folder, from what the folder holds; return the two files.

    Raises `InputError` where it holds no finished run, or cannot be written.
    """
    run = Result(folder).checked()
    facts = report_facts(run)
    page, picture = Path(folder) / PAGE, Path(folder) / SUMMARY_PICTURE
    with reporting(f"cannot write {page}"):
        page.write_text(page_html([page_data(facts)]), encoding="utf-8")
    with reporting(f"cannot write {picture}"):
        summary_picture(facts).save(picture, compress_level=1)
    if (Path(folder) / SUMS).is_file():
        write_checksums(Path(folder), only=(PAGE, SUMMARY_PICTURE, PICTURES))
    return [page, picture]


def page_to_send(page: Path) -> bytes:
    """Return a report as it is sent without the files beside it: their names are text, not links.

    Raises `InputError` where it cannot be read.
    """
    with reporting(f"cannot read {page}"):
        text = page.read_text(encoding="utf-8")
    # The data holds no "<", and the scripts none of these.
    for linked, alone in (("Beside this page:", "In the result's folder:"), (" beside this page.", " in its folder.")):
        text = text.replace(linked, alone)
    return _LINK.sub(r"\1", text).encode("utf-8")


def write_comparison(folders: Sequence[Path], names: Sequence[str], file: Path) -> Path:
    """Write one page of several runs, where each is chosen by its name, and return its file.

    They share the triangles and pictures of one page.

    Raises `InputError` where a folder holds no finished run, or the file cannot be written.
    """
    share = 1 / len(folders)
    runs = [Result(folder).checked() for folder in folders]
    data = [
        page_data(report_facts(run, int(share * MOST_FACES)), name=name, share=share)
        for run, name in zip(runs, names, strict=True)
    ]
    with reporting(f"cannot write {file}"):
        file.write_text(page_html(data), encoding="utf-8")
    return file


def keep_measurements(folder: Path | str, sent: bytes) -> None:
    """Write what was measured by hand, a list as JSON, as `measurements.json` into a run's folder, and into its report.

    Raises `InputError` where it is no such list, or cannot be written.
    """
    file = Path(folder) / MEASUREMENTS
    with reporting(f"cannot write {file}"):
        _replace(file, json.dumps(checked_measurements(sent), indent=1) + "\n")
    _put_into_page(Path(folder))


def _put_into_page(folder: Path) -> None:
    """Write what is measured by hand into a run's report, where there is one; all else on it stays.

    To write all of the page takes seconds, and the one who measures waits.
    """
    page = folder / PAGE
    if not page.is_file():
        return
    with reporting(f"cannot write {page}"):
        text = page.read_text(encoding="utf-8")
        if (found := _DATA.search(text)) is None:
            raise ValueError("it is no report")
        content = json.loads(found[2])
        content["runs"][0] |= without_nan(by_hand_data(Result(folder)))
        _replace(page, text[: found.start(2)] + _as_data(content) + text[found.end(2) :])
    if (folder / SUMS).is_file():
        write_checksums(folder, only=(PAGE,))


def _replace(file: Path, text: str) -> None:
    """Write a file as a whole or not at all."""
    draft = file.with_suffix(".part")
    draft.write_text(text, encoding="utf-8")
    draft.replace(file)


def _as_data(content: dict[str, Any]) -> str:
    """Return the data of a page as its script holds it."""
    # "<" would end the script that holds the data, wherever a name in it contains "</script>".
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def page_html(runs: list[dict[str, Any]]) -> str:
    """Return the page of runs, each from `page_data`."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    maps = {"turbo": cv2.COLORMAP_TURBO, "ramp": cv2.COLORMAP_VIRIDIS}
    colours = {name: base64_of(cv2.applyColorMap(levels, number)[:, 0, ::-1], "u1") for name, number in maps.items()}
    pale = {"sure": SURE_CONFIDENCE, "level": PALE / 255, "least": LEAST_COLOUR, "words": WORDS}
    content = without_nan({"runs": runs, "licences": _LICENCES, "pale": pale} | colours)
    names = ", ".join(run["name"] for run in runs)
    parts = {
        # A file's name may hold bytes that are no UTF-8; in the data JSON escapes them.
        "title": html.escape(names.encode("utf-8", "replace").decode("utf-8"), quote=False),
        "style": _asset("page.css"),
        "script": "\n".join(_asset(f"{name}.js") for name in _SCRIPTS),
        "data": _as_data(content),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], _asset("page.html"))


def _asset(name: str) -> str:
    return (files("scopemap.report") / "assets" / name).read_text(encoding="utf-8")
