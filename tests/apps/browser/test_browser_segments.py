"""Measuring where each part of a video has a surface of its own: what is on one is not looked for on another."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scopemap.apps.browser.files_part import surface_words
from scopemap.apps.browser.result_page import ResultPage
from scopemap.engine.fusion.mesh_files import save_mesh
from scopemap.engine.notices import Level
from scopemap.report.facts import report_facts
from scopemap.report.measured_by_hand import read_measurements
from scopemap.report.page import write_report
from scopemap.report.page_data import page_data
from scopemap.result.result import Result
from scopemap.result.surface_segments import SurfaceSegment, save_segments
from tests.apps.browser.test_browser_result_page import click
from tests.support.drawn_run import IN_RESULT, draw_run, tube
from tests.support.shown_window import shown_window

pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")

HALF = IN_RESULT // 2


def in_two_segments(folder: Path, levels: tuple[Level, Level] = ("doubtful", "doubtful"), main: int = 0) -> Path:
    """A drawn result whose second half has a surface of its own, with fewer triangles.

    levels : of the two segments. main : the one whose surface stands for the result.
    """
    times_s = Result(folder).frames["time_s"]
    ends = ((0, HALF - 1), (HALF, IN_RESULT - 1))
    segments = [
        SurfaceSegment(number, *frames, float(times_s[frames[0]]), float(times_s[frames[1]]), levels[number], 0.02, 0.9)
        for number, frames in enumerate(ends)
    ]
    whole = tube()
    part = whole.submesh([range(len(whole.faces) // 2)], append=True, repair=False)
    save_segments(segments, [whole, part], folder, comment="drawn")
    save_mesh((whole, part)[main], folder / "mesh.ply", comment="drawn")
    provenance = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    (folder / "provenance.json").write_text(json.dumps(provenance | {"main_segment": main}), encoding="utf-8")
    with (folder / "frames.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        inside = int(row["index"]) < IN_RESULT
        row["segment"] = str(int(int(row["index"]) >= HALF)) if inside else ""
    with (folder / "frames.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return folder


def test_window_and_report_open_at_the_main_segment_and_the_list_goes_to_others(tmp_path: Path) -> None:
    folder = in_two_segments(draw_run(tmp_path), ("doubtful", "good"), main=1)
    facts = report_facts(Result(folder), 1000)
    assert page_data(facts)["opens_at"] == HALF
    # The third surface is that of another segment, and no submap's.
    assert (len(facts.meshes), set(facts.submap_meshes)) == (3, {0, 1})
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        part, slider = shown.element("Dropdown", "Go to part"), shown.element("Slider", "Frame")
        assert (slider.value, part.value) == (HALF, part.options[1])
        assert part.options[0].endswith(" s: doubtful")
        assert part.options[1].endswith(" s: good, the main part")
        shown.choose("Dropdown", "Go to part", part.options[0])
        assert slider.value == 0
        shown.choose("Slider", "Frame", HALF + 2)
        assert part.value == part.options[1]


def test_a_result_of_one_surface_lists_no_parts(tmp_path: Path) -> None:
    with shown_window() as shown:
        shown.show(ResultPage(draw_run(tmp_path)))
        assert "Go to part" not in shown.labels("Dropdown")
        assert shown.element("Slider", "Frame").value == 0


def test_the_files_say_which_part_they_show_and_how_their_numbers_become_mm(tmp_path: Path) -> None:
    folder = in_two_segments(draw_run(tmp_path))
    times = Result(folder).segments[0].words
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        assert f"The surface is that of the part from {times}. Its scale is unknown: its numbers are no mm." in (
            shown.words
        )
        shown.choose("ButtonGroup", "Measure", "Distance")
        for pixel in ((24.0, 45.0), (40.0, 45.0)):
            click(shown, page, pixel)
        shown.element("Text", "Length of this line").value = "5"
        shown.press("Use as reference")
        ends = np.array(read_measurements(folder)[0]["world"])
        factor = 5 / np.linalg.norm(ends[1] - ends[0])
        frame = read_measurements(folder)[0]["frame"]
        assert (
            "Its numbers are mm in STL and 3D Slicer, m in GLB: those of the result times "
            f"{factor:.3g}, by your reference of 5 mm in frame {frame}."
        ) in shown.words
        shown.press("Surface for printing (STL)")
        shown.until(lambda: shown.sent)
        (stl,) = shown.sent.values()
        printed = trimesh.load(io.BytesIO(stl), file_type="stl")
        np.testing.assert_allclose(printed.bounds, Result(folder).mesh.bounds * factor, rtol=1e-4)
        # The files hold the main surface: a reference on another one does not count.
        other = Result(folder)
        other.provenance["main_segment"] = 1
        assert (
            f"Its numbers are no mm: your reference of 5 mm in frame {frame} holds only for the part from {times}."
            in (surface_words(other))
        )
        shown.press("Forget the reference")
        assert "its numbers are no mm" in shown.words
    known = Result(draw_run(tmp_path / "known", scale={"known": True, "source": "a ruler", "measured": True}))
    assert surface_words(known) == (
        "The surface is that of the whole result. Its numbers are mm in STL and 3D Slicer, m in GLB."
    )


def test_the_downloaded_report_has_no_links_to_files_that_are_not_beside_it(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    (page, _) = write_report(folder)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.press("Download the report")
        (sent,) = shown.sent.values()
    assert b"<a data-file>" not in sent
    assert b"In the result's folder: summary.png, mesh.ply, mesh.glb" in sent
    kept = page.read_bytes()
    assert b"Beside this page: <a data-file>summary.png</a>" in kept
    # Nothing else differs.
    assert len(kept) - len(sent) < 500


def test_what_was_measured_on_one_surface_is_not_looked_for_on_another(tmp_path: Path) -> None:
    folder = in_two_segments(draw_run(tmp_path))
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        shown.choose("Slider", "Frame", 4)
        shown.choose("ButtonGroup", "Measure", "Distance")
        # In the half that the other surface has not.
        for pixel in ((24.0, 45.0), (40.0, 45.0)):
            click(shown, page, pixel)
        shown.element("Text", "Length of this line").value = "5"
        shown.press("Use as reference")
        for pixel in ((20.0, 20.0), (60.0, 44.0)):
            click(shown, page, pixel)
        shown.until(lambda: "/page/measured/0/words" in shown.nodes)
        for _ in range(2):
            shown.choose("Slider", "Frame", HALF + 1)
            shown.settle()
            times_s = Result(folder).segments[0].words
            assert f"Your reference is on the surface of {times_s}." in shown.words
            assert shown.words.count(f"on the surface of {times_s}") == 2
            assert "Go to the reference" in shown.labels()
            assert "/page/measured/0/words" not in shown.nodes
            assert "/page/reference/words" not in shown.nodes
            assert "each of 2 parts of the video has its own" in shown.words
            assert not shown.window._error.visible
            shown.press("Go to the reference")
            assert "Go to the reference" not in shown.labels()
            assert shown.element("Slider", "Frame").value < HALF
            assert "Sizes are in mm by your reference (5 mm)." in shown.words
            assert "/page/measured/0/words" in shown.nodes
            # Opened again it is the same.
            page = ResultPage(folder)
            shown.show(page)
