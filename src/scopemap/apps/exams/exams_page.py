"""The page of two examinations, one file: their matched views side by side, and the places that changed."""

from __future__ import annotations

import html
import json
from base64 import b64encode
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.apps.exams.change import Change
from scopemap.apps.exams.compare_exams import ExamComparison
from scopemap.apps.exams.examination import as_compared
from scopemap.apps.exams.fit import ExamFit
from scopemap.apps.exams.wording import names_of, seen_words, summary
from scopemap.engine.errors import reporting
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.decoding import read_decoded
from scopemap.report.batch_page import write_at_once
from scopemap.report.sheet import picture_grid, rgb_of
from scopemap.result.result import Result

PAGE = "compare.html"
TABLE = "changes.json"
_CELL_PX = (420, 330)
_RING = "#ffd000"
_MOST = 12
_STYLE = "body{font:15px/1.4 system-ui,sans-serif;margin:16px;max-width:920px}img{max-width:100%}td,th{padding:2px 9px}"
_LEGEND = "Above 0 the wall is nearer to the camera, and redder, in {}. Sigmas say how sure a change is."
_NO_DEVICE = "Research software, not a medical device."
_HEADS = (
    "<th></th><th>what</th><th>area, {0}²</th><th>nearer by, {0}</th><th>redness</th><th>sigmas</th>"
    "<th>in the views of</th>"
)


def facts_of(found: ExamComparison, unit: str) -> dict[str, Any]:
    """Return what was found as JSON has it; unit : of lengths, "mm" or "unit"."""
    by = found.registration
    changes = [
        {
            "what": change.what,
            "sigmas": change.sigmas,
            "place": change.place_mm.tolist(),
            f"area_{unit}2": change.area_mm2,
            f"rise_{unit}": change.rise_mm,
            "redness": change.redness,
            "seen_in": change.seen_in,
            "views": change.views,
            "frame_first": change.frames[0],
            "frame_second": change.frames[1],
        }
        for change in found.changes
    ]
    S = by.S_first_second
    return {
        "fit": str(found.fit),
        "residual": by.residual,
        "located": by.located_second,
        "located_first": by.located_first,
        "registered_by": "second" if by.by_second else "first",
        "only_first": found.only_first,
        "only_second": found.only_second,
        "S_first_second": {"scale": S.scale, "R": S.R.tolist(), "t": S.t.tolist()},
        "changes": None if found.fit is ExamFit.NONE else changes,
    }


def write_comparison(found: ExamComparison, first: Path, second: Path, out: Path) -> None:
    """Write OUT/compare.html, changes.json, and second.ply, the second surface in the first's world.

    Raises `InputError` where a file cannot be written.
    """
    runs, names = (as_compared(first), Result(second)), names_of(first.resolve().name, second.resolve().name)
    with reporting(f"cannot write to {out}"):
        out.mkdir(parents=True, exist_ok=True)
        facts = facts_of(found, "mm" if runs[0].scale_known else "unit")
        (out / TABLE).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
        found.second.export(out / "second.ply")
    write_at_once(out / PAGE, comparison_page(found, runs, names))


def comparison_page(found: ExamComparison, runs: tuple[Result, Result], names: tuple[str, str]) -> str:
    """Return the page of two examinations, which needs no other file; names : of both, as by `names_of`."""
    unit = "mm" if runs[0].scale_known else "unit"
    numbered = list(enumerate(found.changes, 1))
    rows = "".join(_row(change, number, names) for number, change in numbered)
    one, other = (html.escape(name) for name in names)
    judged, *lines = (html.escape(line) for line in summary(found, runs[0].scale, names))
    parts = [
        f"<!doctype html><meta charset=utf-8><title>{one} and {other}</title><h1>{one} and {other}</h1>",
        f"<style>{_STYLE}</style>",
        f"<p><strong>{judged}</strong></p>",
        *(f"<p>{line}</p>" for line in lines),
    ]
    if rows:
        shown = [pictures_of(runs, names, found, change, number) for number, change in numbered[:_MOST]]
        table = f"<table><tr>{_HEADS.format(unit)}</tr>{rows}</table>"
        parts += [table, f"<p>{_LEGEND.format(other)}</p>", _picture_html(shown, "Changes")]
    views = [pictures_of_view(runs, names, view) for view in found.views]
    parts += ["<h2>The same places</h2>", _picture_html(views, "Matched views")]
    return "\n".join([*parts, f"<p><strong>{_NO_DEVICE}</strong></p>"])


def _picture_html(rows: list[dict[str, np.ndarray]], what: str) -> str:
    """Return rows of pictures as one picture inside a page."""
    content = b64encode(picture_grid(rows, _CELL_PX).jpeg).decode()
    return f"<img src='data:image/jpeg;base64,{content}' alt='{what}'>"


def _row(change: Change, number: int, names: tuple[str, str]) -> str:
    cells = (number, change.what, *(f"{x:.2f}" for x in (change.area_mm2, change.rise_mm, change.redness)))
    cells += (f"{change.sigmas:.0f}", html.escape(seen_words(change, names)))
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def pictures_of_view(
    runs: tuple[Result, Result], names: tuple[str, str], view: tuple[int, int]
) -> dict[str, np.ndarray]:
    """Return the small pictures of two frames of both, (h, w, 3) uint8, by what they are."""
    return {f"{name}, frame {index}": _picture(run, index) for run, name, index in zip(runs, names, view, strict=True)}


def pictures_of(
    runs: tuple[Result, Result], names: tuple[str, str], found: ExamComparison, change: Change, number: int
) -> dict[str, np.ndarray]:
    """Return the small pictures of both that show a change, with a ring around it, by what they are."""
    places = change.place_mm, found.registration.S_first_second.inverse().transform_points(change.place_mm)
    heads = (f"{number}: {change.what}\n{names[0]}, frame", f"\n{names[1]}, frame")
    return {
        f"{head} {index}": _ringed(run, index, place)
        for run, head, index, place in zip(runs, heads, change.frames, places, strict=True)
    }


def _ringed(run: Result, index: int, place: np.ndarray) -> np.ndarray:
    rgb = _picture(run, index)
    row = np.flatnonzero(run.frames["index"] == index)
    if len(row):
        pose = run.frames["T_world_camera"][row[0]]
        pixel = run.camera.project(transform(inverse(pose), place[None]))[0] * rgb.shape[1] / run.camera.width
        x, y = np.rint(np.clip(pixel, -1e4, 1e4)).astype(int).tolist()
        cv2.circle(rgb, (x, y), rgb.shape[1] // 9, rgb_of(_RING), 2, cv2.LINE_AA)
    return rgb


def _picture(run: Result, index: int) -> np.ndarray:
    """Return the small picture of a frame, (h, w, 3) uint8; white where there is none."""
    bgr = read_decoded(run.picture_file(index)) if index >= 0 else None
    return np.full((64, 80, 3), 255, np.uint8) if bgr is None else np.ascontiguousarray(bgr[..., ::-1])
