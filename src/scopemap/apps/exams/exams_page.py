"""The page of two examinations: their matched views side by side, and the places that changed."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scopemap.apps.exams.compare_exams import Change, ExamComparison
from scopemap.engine.errors import reporting
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.decoding import read_decoded
from scopemap.report.batch_page import write_at_once
from scopemap.report.sheet import picture_grid, rgb_of
from scopemap.result.result import Result

PAGE = "compare.html"
TABLE = "changes.json"
CHANGES = "changes.png"
VIEWS = "views.png"
_CELL_PX = (420, 330)
_RING = "#ffd000"
_MOST = 12
_STYLE = "body{font:15px/1.4 system-ui,sans-serif;margin:16px;max-width:920px}img{max-width:100%}td,th{padding:2px 9px}"
_LEGEND = "Above 0 the wall is nearer to the camera, and redder, in the second. Sigmas say how sure a change is."
_NO_DEVICE = "Research software, not a medical device."
_HEADS = "<th></th><th>what</th><th>area, {0}²</th><th>nearer by, {0}</th><th>redness</th><th>sigmas</th>"


def facts_of(found: ExamComparison, unit: str) -> dict[str, Any]:
    """Return what was found as JSON has it; unit : of lengths, "mm" or "unit"."""
    names = ("located", "residual", "only_first", "only_second")
    changes = [
        {
            "what": change.what,
            "sigmas": change.sigmas,
            "place": change.place_mm.tolist(),
            f"area_{unit}2": change.area_mm2,
            f"rise_{unit}": change.rise_mm,
            "redness": change.redness,
            "views": change.views,
            "frame_first": change.frames[0],
            "frame_second": change.frames[1],
        }
        for change in found.changes
    ]
    S = found.S_first_second
    similarity = {"scale": S.scale, "R": S.R.tolist(), "t": S.t.tolist()}
    return {name: getattr(found, name) for name in names} | {"S_first_second": similarity, "changes": changes}


def write_comparison(found: ExamComparison, first: Path, second: Path, out: Path) -> None:
    """Write OUT/compare.html with its pictures, changes.json, and second.ply, the second surface in the first's world.

    Raises `InputError` where a file cannot be written.
    """
    runs = Result(first), Result(second)
    unit = "mm" if runs[0].scale_known else "unit"
    with reporting(f"cannot write to {out}"):
        out.mkdir(parents=True, exist_ok=True)
        (out / TABLE).write_text(json.dumps(facts_of(found, unit), indent=2) + "\n", encoding="utf-8")
        found.second.export(out / "second.ply")
        changes = [pictures_of(runs, found, change, number) for number, change in enumerate(found.changes[:_MOST], 1)]
        picture_grid(changes, _CELL_PX).save(out / CHANGES)
        views = [pictures_of_view(runs, view) for view in found.views]
        picture_grid(views, _CELL_PX).save(out / VIEWS)
    rows = "".join(_row(change, number, unit) for number, change in enumerate(found.changes, 1))
    head = f"<tr>{_HEADS.format(unit)}</tr>"
    changed = f"<table>{head}{rows}</table><p>{_LEGEND}</p><img src={CHANGES} alt='Changes'>" if rows else ""
    names, lines = (html.escape(folder.name) for folder in (first, second)), summary(found, runs[0].scale)
    head = "<!doctype html><meta charset=utf-8><title>{0} and {1}</title><h1>{0} (first) and {1} (second)</h1>"
    parts = [
        head.format(*names),
        f"<style>{_STYLE}</style>",
        *(f"<p>{html.escape(line)}</p>" for line in lines),
        changed,
    ]
    parts += [f"<h2>The same places</h2><img src={VIEWS} alt='Matched views'>", f"<p><strong>{_NO_DEVICE}</strong></p>"]
    write_at_once(out / PAGE, "\n".join(parts))


def summary(found: ExamComparison, scale: str) -> Iterator[str]:
    """Yield what was found, a sentence a line; scale : what the first one's sizes rest on."""
    apart = f"matched points are {found.residual:.1%} of the depth apart (median)"
    yield f"{found.located:.0%} of the second's keyframes were found in the first; {apart}."
    yield f"Far from the other surface: {found.only_first:.0%} of the first, {found.only_second:.0%} of the second."
    count = len(found.changes)
    yield f"{count or 'No'} place{'s' * (count != 1)} changed by more than the surfaces differ elsewhere."
    yield f"Sizes are the first's: {scale}."


def _row(change: Change, number: int, unit: str) -> str:
    cells = (number, change.what, *(f"{x:.2f}" for x in (change.area_mm2, change.rise_mm, change.redness)))
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in (*cells, f"{change.sigmas:.0f}")) + "</tr>"


def pictures_of_view(runs: tuple[Result, Result], view: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return the small pictures of two frames of both, (h, w, 3) uint8, by what they are."""
    one, other = view
    return {f"first, frame {one}": _picture(runs[0], one), f"second, frame {other}": _picture(runs[1], other)}


def pictures_of(
    runs: tuple[Result, Result], found: ExamComparison, change: Change, number: int
) -> dict[str, np.ndarray]:
    """Return the small pictures of both that show a change, with a ring around it, by what they are."""
    places = change.place_mm, found.S_first_second.inverse().transform_points(change.place_mm)
    names = (f"{number}: {change.what}\nfirst, frame", "\nsecond, frame")
    return {
        f"{name} {index}": _ringed(run, index, place)
        for run, name, index, place in zip(runs, names, change.frames, places, strict=True)
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
