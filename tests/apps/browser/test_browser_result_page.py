"""The page of a result in a window without a browser: what it says, and what its buttons do."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh

from scopemap.apps.browser.files_part import export_place
from scopemap.apps.browser.frame_images import depth_words
from scopemap.apps.browser.marks import CLICKED
from scopemap.apps.browser.result_page import ResultPage
from scopemap.apps.browser.runs import BrowserRun
from scopemap.apps.browser.workspace import Workspace
from scopemap.apps.coverage.coverage import CAUTION, NO_SPOT, coverage
from scopemap.engine.notices import Notice
from scopemap.report.measured_by_hand import read_measurements
from scopemap.report.page import PAGE, page_to_send, write_report
from scopemap.report.plain_step import plain_step
from scopemap.result.result import Result
from scopemap.result.summary import summary_lines
from scopemap.result.wording import facts_of_notices
from tests.support.drawn_run import CAMERA, FRAMES, IN_RESULT, draw_run, pose_of, tube
from tests.support.front_door import call
from tests.support.shown_window import ShownWindow, shown_window

pytestmark = pytest.mark.slow

pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")

KNOWN = {"known": True, "source": "a ruler", "measured": True}
NOT_ADJUSTED = facts_of_notices([Notice("mapping-none")])
FACTS = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def click(shown: ShownWindow, page: ResultPage, pixel: tuple[float, float], frame: int = 4) -> None:
    """Click on what a frame shows at a pixel."""
    pose = pose_of(frame)
    shown.window.do(page.click, pose[:3, 3], pose[:3, :3] @ CAMERA.unproject(np.array(pixel)))
    shown.settle()


def pictures(shown: ShownWindow) -> np.ndarray:
    """The pictures of the frame, beside each other: below the strip of the time line."""
    return np.asarray(shown.handles("Image")[1].image)


def ring(shown: ShownWindow) -> int:
    """How many pixels of the frame's picture mark the place that was clicked."""
    return int((pictures(shown) == CLICKED).all(-1).sum())


def test_it_says_what_the_summary_of_the_run_says(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, notices=NOT_ADJUSTED)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        word, *lines = summary_lines(Result(folder))
        assert word.replace(". ", "\n", 1) in shown.words.replace("### ", "")
        for line in lines:
            name, _, fact = line.strip().partition("  " if line.startswith("  ") else ": ")
            assert f"{name}: {plain_step(fact.strip())}" in shown.words.replace("Caution. ", "Caution: ").replace(
                "Note. ", "Note: "
            )
        # Without a workspace nothing can be started.
        assert not [label for label in shown.labels() if label.startswith("Run again")]
        assert shown.ways == ("Whole surface",)


def test_a_caution_starts_the_run_that_mends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "video.mp4").write_bytes(b"")
    monkeypatch.setattr(BrowserRun, "start", lambda run: None)
    camera = FACTS | {"source": "70 deg", "origin": "assumed"}
    folder = draw_run(tmp_path / "one", name=str(tmp_path / "video.mp4"), notices=NOT_ADJUSTED, camera=camera)
    with Workspace(tmp_path) as workspace, shown_window() as shown:
        shown.show(ResultPage(folder, workspace))
        shown.choose("Dropdown", "Which endoscope was it?", "laparoscope")
        shown.press("Run again with this endoscope")
        (run,) = workspace.runs.runs
        assert run.source == tmp_path / "video.mp4"
        assert run.arguments[:2] == ("--config", str(folder / "config.toml"))
        assert run.arguments[-2:] == ("--scope", "laparoscope")
        assert "video.mp4, run again as seen by a laparoscope" in shown.words
        # What it ends in is the page of its own result.
        draw_run(run.out)
        run.status = "done"
        shown.until(lambda: "Colour by" in shown.labels("Dropdown"))
        shown.show(ResultPage(folder, workspace))
        shown.press("Run again with mapping.method=local")
        assert workspace.runs.runs[-1].arguments[-2:] == ("--set", "mapping.method=local")


def test_a_field_of_view_is_typed_and_not_suggested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "video.mp4").write_bytes(b"")
    monkeypatch.setattr(BrowserRun, "start", lambda run: None)
    notices = facts_of_notices([Notice("camera-unknown", {"reason": "nothing tells it"})])
    camera = FACTS | {"source": "70 deg", "origin": "assumed"}
    folder = draw_run(tmp_path / "one", name=str(tmp_path / "video.mp4"), notices=notices, camera=camera)
    with Workspace(tmp_path) as workspace, shown_window() as shown:
        shown.show(ResultPage(folder, workspace))
        for typed in ("", "wide", "200"):
            shown.element("Text", "Its horizontal field of view").value = typed
            shown.press("Run again with this field of view")
            assert "type a number from 5 to 170 first" in shown.words
        assert not workspace.runs.runs
        shown.element("Text", "Its horizontal field of view").value = "82,5"
        shown.press("Run again with this field of view")
        assert workspace.runs.runs[0].arguments[-2:] == ("--fov", "82.5")


def test_an_input_that_is_another_file_now_is_said(tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"now")
    content = {"bytes": 7, "sha256": "0" * 64}
    folder = draw_run(tmp_path / "one", name=str(video), notices=NOT_ADJUSTED, input_content=content)
    with Workspace(tmp_path) as workspace, shown_window() as shown:
        shown.show(ResultPage(folder, workspace))
        shown.press("Run again with mapping.method=local")
        assert "is another file now" in shown.window._error.content.replace("\\", "")
        assert not workspace.runs.runs


def test_frames_say_what_they_are(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.until(lambda: pictures(shown).shape == (240, 1440, 3))
        # Three of 300 x 240, as the frames are 80 x 64, in the middle.
        assert [bool((part == part[0, 0]).all()) for part in np.split(pictures(shown), [270, 1170], axis=1)] == [
            True, False, True,
        ]  # fmt: skip
        assert "Frame 0, 0.00 s: tracked" in shown.words
        shown.choose("Slider", "Frame", IN_RESULT)
        assert "Frame 14, 0.56 s: lost: too blurred." in shown.words
        shown.press("Look from here")
        assert "This frame has no pose in this submap" in shown.words
        shown.choose("Slider", "Frame", FRAMES - 1)
        assert "Frame 23, 0.92 s: tracked in submap 2, not the one that is shown" in shown.words
        shown.choose("Dropdown", "Submap", shown.element("Dropdown", "Submap").options[1])
        assert shown.words.endswith("Frame 17, 0.68 s: tracked")
        shown.choose("ButtonGroup", "Go", "Next")
        assert shown.element("Slider", "Frame").value == 18
        shown.press("Look from here")
        place = np.array(shown.window.server.initial_camera.position)
        np.testing.assert_allclose(place, pose_of(18)[:3, 3], atol=1e-6)


def test_depth_has_a_unit_or_is_said_in_multiples() -> None:
    assert depth_words(12.0, 49.0, scale_known=True) == "depth 12 to 49 mm, near red"
    assert depth_words(12.0, 48.0, scale_known=False) == "depth, far is 4 times near, near red"


def test_frames_are_played_to_their_end(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.choose("Slider", "Frame", FRAMES - 4)
        shown.choose("ButtonGroup", "Go", "Play")
        shown.until(lambda: shown.element("Slider", "Frame").value == FRAMES - 1)


def test_a_click_lists_the_frames_that_saw_the_place(tmp_path: Path) -> None:
    page = ResultPage(draw_run(tmp_path))
    with shown_window() as shown:
        shown.show(page)
        click(shown, page, (60.0, 40.0))
        listed = shown.element("Dropdown", "Frames that saw it").options
        # The best one is shown at once, with the place marked in its picture and on the surface.
        best = int(listed[0].split()[1].rstrip(","))
        assert listed[0].endswith("(best)")
        assert shown.element("Slider", "Frame").value == best
        assert "/page/clicked/0" in shown.nodes
        shown.until(lambda: ring(shown) > 100)
        other = next(name for name in listed if name.startswith("frame 4, 0.16 s"))
        shown.choose("Dropdown", "Frames that saw it", other)
        assert shown.element("Slider", "Frame").value == 4
        shown.window.do(page.click, np.array([0.0, 0.0, -50.0]), np.array([0.0, 0.0, -1.0]))
        shown.settle()
        assert "There is no surface there." in shown.words
        # The list and the marks go with their message.
        assert "Frames that saw it" not in shown.labels("Dropdown")
        assert "/page/clicked/0" not in shown.nodes
        shown.until(lambda: ring(shown) == 0)


def test_a_distance_is_measured_and_kept(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        assert shown.next_click == "A click shows which frames saw the place."
        assert "Points" not in shown.labels("ButtonGroup")
        shown.choose("ButtonGroup", "Measure", "Distance")
        assert shown.next_click == "Distance: click on the 1st of 2 points."
        click(shown, page, (20.0, 20.0))
        assert shown.next_click == "Distance: click on the 2nd of 2 points."
        assert "Points" in shown.labels("ButtonGroup")
        click(shown, page, (60.0, 44.0))
        shown.until(lambda: "straight: " in shown.words)
        assert f"scopemap measure {folder}" in shown.words
        (kept,) = read_measurements(folder)
        assert f"straight: {kept['found'][0]['value']:.3g} mm, 95 % interval " in shown.words
        value, low, high = (f"{kept['found'][0][name]:.2g}" for name in ("value", "low", "high"))
        assert shown.nodes["/page/measured/0/words"].text == f"{value} ({low} to {high}) mm"
        # One of points that no frame saw together is refused in a sentence.
        click(shown, page, (60.0, 44.0))
        shown.window.do(page.click, np.array([0.0, 0.0, 8.0]), np.array([1.0, 0.0, 0.0]))
        shown.until(lambda: "no frame saw all of these points" in shown.window._error.content)
        shown.choose("ButtonGroup", "Points", "Clear")
        assert len(read_measurements(folder)) == 1
        assert shown.ways == ("Whole surface", "Stop measuring")
        shown.choose("ButtonGroup", "", "Stop measuring")
        assert page._measure.mode == "Look"
        assert shown.ways == ("Whole surface",)
        # They are there when the result is opened again, until they are removed.
        shown.show(ResultPage(folder))
        assert f"straight: {kept['found'][0]['value']:.3g} mm" in shown.words
        assert "/page/measured/0/words" in shown.nodes


def test_from_a_frame_dragging_turns_about_what_it_sees(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.press("Look from here")
        camera = shown.window.server.initial_camera
        ahead = np.linalg.norm(np.subtract(camera.look_at, camera.position))
    assert ahead == pytest.approx(np.nanmedian(Result(folder).depth.read(0)), rel=1e-3)


def test_a_share_that_may_be_far_too_large_is_said_with_its_caution(tmp_path: Path) -> None:
    found = coverage(draw_run(tmp_path))
    assert CAUTION not in found.statement
    said, count = found.statement.split("There ")
    assert replace(found, caution=CAUTION).statement == f"{said}{CAUTION} There {count}"
    assert count == f"are {len(found.spots)} blind spots."
    assert replace(found, spots=[]).statement == f"{said}{NO_SPOT}"


def test_blind_spots_are_those_of_the_command(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    assert call("coverage", folder, "--quiet") == 0
    facts = json.loads((folder / "coverage" / "coverage.json").read_text())
    shutil.rmtree(folder / "coverage")
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.press("What was not seen")
        shown.until(lambda: "was not seen, estimated (90 % interval" in shown.words)
        assert facts["statement"] in shown.words
        # What the window found is kept as by the command.
        assert json.loads((folder / "coverage" / "coverage.json").read_text()) == facts
        spots = [label for label in shown.labels() if label[0].isdigit()]
        assert len(spots) == len(facts["blind_spots"])
        shown.press("1. ")
        assert f"seen from frame {facts['blind_spots'][0]['frame']}" in shown.words
        # It is looked at where a face was not seen, the nearest one to the spot's middle.
        found = coverage(folder)
        hidden = found.surface.triangles_center[found.unseen_faces]
        apart = np.linalg.norm(hidden - facts["blind_spots"][0]["position_mm"], axis=1)
        np.testing.assert_allclose(shown.window.server.initial_camera.look_at, hidden[apart.argmin()], rtol=1e-6)
        # Its border is outlined: each of its corners is of a face that was not seen.
        outline = shown.nodes["/page/blind_spot/outline"].points
        corners = np.asarray(found.surface.vertices)[np.unique(np.asarray(found.surface.faces)[found.unseen_faces])]
        assert len(outline) >= 3
        assert np.abs(outline.reshape(-1, 1, 3) - corners).sum(-1).min(1).max() < 1e-3


def test_an_export_is_written_beside_the_result(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with shown_window(anonymous=True) as shown:
        shown.show(ResultPage(folder))
        shown.choose("Dropdown", "Format", "tum")
        for file in ("tum.txt", "tum_2.txt"):
            shown.press("Write")
            shown.until(lambda file=file: f"RESULT/exports/{file}" in shown.words)  # type: ignore[misc]
            assert (folder / "exports" / file).is_file()
        assert str(tmp_path) not in shown.words
    assert export_place(folder, "colmap") == folder / "exports" / "colmap"


def test_report_and_surface_come_in_one_click(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    page = write_report(folder)[0].read_bytes()
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        with urlopen(f"{shown.window.url}result/report.html") as answer:
            assert answer.read() == page
        files = {"report": "video_report.html", "printing (STL)": "video.stl", "3D Slicer": "video.zip"}
        for label in ("Download the report", "Surface for printing (STL)", "Surface for 3D Slicer"):
            name = next(name for words, name in files.items() if label.endswith(words))
            shown.press(label)
            shown.until(lambda name=name: name in shown.sent)  # type: ignore[misc]
        sent = shown.sent
        assert sent["video_report.html"] == page_to_send(folder / PAGE)
        assert len(trimesh.load(io.BytesIO(sent["video.stl"]), file_type="stl").faces) == len(tube().faces)
        with zipfile.ZipFile(io.BytesIO(sent["video.zip"])) as archive:
            assert set(archive.namelist()) == {"slicer/surface.ply", "slicer/path.mrk.json"}


def test_a_result_without_a_surface_can_be_looked_at(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    (folder / "mesh.ply").unlink()
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        assert "There is no surface." in shown.words
        shown.choose("Slider", "Frame", 3)
        assert "Frame 3" in shown.words
        assert shown.element("Dropdown", "Colour by").options == ("picture",)


def test_everything_goes_with_the_page(tmp_path: Path) -> None:
    folder = draw_run(tmp_path)
    with shown_window() as shown:
        page = ResultPage(folder)
        shown.show(page)
        count = len(shown.handles("Button"))
        shown.show(ResultPage(folder))
        assert len(shown.handles("Button")) == count
        assert len(shown.window.scene._scene_pointer_cb) == 1
        assert len(shown.window.gui._command_handle_from_uuid) == 2
