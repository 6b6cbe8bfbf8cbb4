"""Two results in the window: how far they are apart, what one alone has, what changed; `scopemap view` opens it."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
import trimesh

from scopemap.apps.browser.compare_page import ComparePage
from scopemap.apps.browser.surface_pair import distance_to_see
from scopemap.apps.browser.two_results import apart_of, compare_results, is_alone, is_same_input
from scopemap.apps.browser.window import BrowserWindow
from scopemap.apps.exams.change import Change
from scopemap.apps.exams.compare_exams import ExamComparison
from scopemap.apps.exams.registration import Correspondences3D, Registration
from scopemap.apps.measure.hand_measure import HandMeasure, add_measurement
from scopemap.engine.errors import InputError
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.engine.geometry.se3 import so3_exp
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result
from tests.support.drawn_run import FRAMES, IN_RESULT, changed, draw_run, tube
from tests.support.front_door import call, refused
from tests.support.shown_window import shown_window
from tests.support.window_without_browser import element, elements, press, until, words

pytestmark = pytest.mark.slow

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
# Without a graphics card: WebGL on the processor.
ARGUMENTS = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
TURN = so3_exp(np.array([0.2, -0.5, 0.9]))
ANOTHER_WORLD = Similarity(1.7, TURN, np.array([30.0, -8.0, 4.0]))
KNOWN = {"known": True, "source": "measured"}
CUT_MM = 50.0
PATIENCE_MS = 180_000


def moved(
    folder: Path,
    world: Similarity,
    *,
    mesh: trimesh.Trimesh | None = None,
    noise: float = 0.0,
    first: int = 0,
    **facts: Any,
) -> Path:
    """The drawn run in another world, with another surface, poses that are off, and without its first frames."""
    run = Result(draw_run(folder, **facts))
    mesh, rng = mesh or run.mesh, np.random.default_rng(0)
    surface = trimesh.Trimesh(
        world.transform_points(np.asarray(mesh.vertices)), mesh.faces, vertex_colors=vertex_colours(mesh), process=False
    )
    poses = world.transform_poses(run.frames["T_world_camera"])
    poses[:, :3, 3] += noise * rng.normal(size=(FRAMES, 3))
    rows = []
    for number in range(FRAMES):
        row = {"index": number, "time_s": number / 25, "map": -1, "status": "lost", "reason": "too blurred"}
        if run.frames.tracked[number] and number >= first:
            row |= {"map": 0, "status": "ok", "reason": "", "T_world_camera": poses[number]}
        rows.append(row)
    changed(run, mesh=surface, frames=FrameTable.of(rows), others=[]).save(folder)
    return folder


def cut_tube() -> trimesh.Trimesh:
    mesh = tube()
    return mesh.submesh([np.flatnonzero(mesh.triangles_center[:, 2] < CUT_MM)], append=True)


def test_the_same_run_in_another_world_is_nowhere_apart(tmp_path: Path) -> None:
    first, second = Result(draw_run(tmp_path / "a")), Result(moved(tmp_path / "b", ANOTHER_WORLD, first=3))
    assert is_same_input(first, second)
    found = compare_results(first, second)
    assert (found.align, found.in_mm) == ("sim3", False)
    assert (found.both, found.only_first, found.only_second) == (IN_RESULT - 3, 3, 0)
    assert found.path_rmse < 1e-4
    assert found.median < 1e-3
    assert found.alone == (0, 0)
    assert found.surfaces is not None
    assert max(apart_of(surface).max() for surface in found.surfaces) < 1e-2
    assert found.S_first_second.scale == pytest.approx(1 / 1.7, rel=1e-5)
    said = found.sentences("a", "b")
    assert said[0] == "11 frames are tracked by both, 3 by a alone, 0 by b alone."
    assert said[1].endswith("scale (0.588) the paths are 0.0 % of the median depth apart (RMSE).")


def test_what_one_alone_has_is_found(tmp_path: Path) -> None:
    whole, part = Result(draw_run(tmp_path / "a")), Result(moved(tmp_path / "b", ANOTHER_WORLD, mesh=cut_tube()))
    found, back = compare_results(whole, part), compare_results(part, whole)
    mesh = tube()
    missing = mesh.area_faces[mesh.triangles_center[:, 2] >= CUT_MM].sum() / mesh.area
    assert 0.8 * missing < found.alone[0] <= missing
    assert found.alone[1] == 0
    assert (back.alone[0], back.alone[1]) == pytest.approx((0, found.alone[0]), abs=0.02)
    assert found.median < 1e-3
    assert found.surfaces is not None
    assert np.asarray(found.surfaces[0].vertices)[is_alone(found.surfaces[0]), 2].min() > CUT_MM


def test_of_known_scales_lengths_are_those_of_the_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rigid, folders = Similarity(1.0, TURN, np.array([3.0, 0.0, 1.0])), (tmp_path / "a", tmp_path / "b")
    first = Result(draw_run(folders[0], scale=KNOWN))
    found = compare_results(first, Result(moved(folders[1], rigid, noise=0.4, scale=KNOWN)))
    assert (found.align, found.in_mm) == ("se3", True)
    assert 0.1 < found.path_rmse < 1
    assert f"the paths are {found.path_rmse:.2f} mm apart" in found.sentences("a", "b")[1]
    assert call(*found.command(str(folders[0]), str(folders[1])).split()[1:], "--json") == 0
    assert json.loads(capfd.readouterr().out)["ate_rmse_mm"] == pytest.approx(found.path_rmse, rel=1e-3)


def test_the_input_is_known_by_its_content_else_by_its_name(tmp_path: Path) -> None:
    def run(name: str, video: str, content: dict[str, Any] | None = None) -> Result:
        return Result(draw_run(tmp_path / name, pictures=False, name=video, input_content=content))

    one, same, other = ({"bytes": 3, "sha256": digit} for digit in "112")
    named, renamed = run("a", "video.mp4", one), run("b", "copy.mp4", same)
    assert is_same_input(named, renamed)
    assert not is_same_input(named, run("c", "video.mp4", other))
    assert is_same_input(named, run("d", "video.mp4"))
    assert not is_same_input(named, run("e", "another.mp4"))


# ---- the page


def registered(residual: float) -> Registration:
    """How two examinations of one world lie to each other."""
    pairs = Correspondences3D(np.zeros((40, 3)), np.zeros((40, 3)))
    return Registration(Similarity.identity(), residual, pairs, 1.0, 0.9, by_second=True)


@contextmanager
def opened(page: ComparePage, *, anonymous: bool = False) -> Iterator[BrowserWindow]:
    window = BrowserWindow(anonymous=anonymous)
    try:
        window.show(page)
        yield window
    finally:
        window.close()


def test_the_page_says_and_shows_how_far_two_are_apart(tmp_path: Path) -> None:
    first, second = draw_run(tmp_path / "one"), moved(tmp_path / "other", ANOTHER_WORLD, mesh=cut_tube())
    with opened(ComparePage(first, second)) as window:
        until(window, lambda: "One over the other" in words(window))
        said, found = words(window), window._page._found  # type: ignore[union-attr]
        assert "### one and other" in said
        assert all(line in said for line in found.sentences("one", "other"))
        assert found.command(str(first), str(second)) in said
        assert "Distance to the other surface, % of the median depth" in said
        nodes = window.scene._handle_from_node_name
        drawn = {f"/page/{side}/surface" for side in ("first", "second")}
        assert drawn <= nodes.keys()
        assert sum(name.startswith(("/page/first/path", "/page/second/path")) for name in nodes) == 2
        assert np.linalg.norm(nodes["/page/second"].position) > 1
        press(window, "One over the other", True)
        assert np.linalg.norm(nodes["/page/second"].position) == 0
        sent = nodes["/page/first/surface"].glb_data
        for chosen, meaning in (
            ("in one alone", "in other alone"),
            ("one colour each", "path of"),
            ("picture", "path"),
        ):
            press(window, "Colours", chosen)
            assert meaning in words(window)
            assert nodes["/page/first/surface"].glb_data != sent
            sent = nodes["/page/first/surface"].glb_data
        assert drawn <= nodes.keys()
    with opened(ComparePage(first, second), anonymous=True) as window:
        until(window, lambda: "One over the other" in words(window))
        assert "### result 1 and result 2" in words(window)
        assert str(tmp_path) not in words(window)


def test_what_cannot_be_compared_is_a_sentence(tmp_path: Path) -> None:
    run = draw_run(tmp_path / "a", pictures=False)
    with pytest.raises(InputError, match="cannot be compared with itself"):
        ComparePage(run, run / "maps" / "..")
    with pytest.raises(InputError, match="no finished run"):
        ComparePage(run, tmp_path / "none")
    late = moved(tmp_path / "late", ANOTHER_WORLD, first=IN_RESULT - 1)
    with opened(ComparePage(run, late)) as window:
        until(window, lambda: "cannot be compared" in words(window))
        assert "at least 3 are needed" in words(window)
        assert "Traceback" not in words(window)
    elsewhere = draw_run(tmp_path / "c", pictures=False, name="another.mp4")
    with opened(ComparePage(run, elsewhere)) as window:
        until(window, lambda: "was not found" in words(window))
        assert "two examinations of one place" in words(window)


def test_the_changes_of_two_examinations_are_flown_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = draw_run(tmp_path / "a")
    second = draw_run(tmp_path / "b", name="another.mp4")
    place = np.array([0.0, 10.0, 40.0])
    compared = 1 + (np.linalg.norm(tube().vertices - place, axis=1) < 4).astype(np.uint8)
    change = Change("shape", place, 12.34, 1.5, 0.0, 21.0, 5, (6, 8))
    found = ExamComparison(registered(0.01), tube(), [change], [(0, 1), (9, 10)], 0.1, 0.2, (compared, compared))
    monkeypatch.setattr("scopemap.apps.exams.compare_exams.compare_exams", lambda *folders: found)
    with opened(ComparePage(first, second)) as window:
        until(window, lambda: "One over the other" in words(window))
        assert "1 place changed" in words(window)
        assert "They fit: matched points are 1.0% of the depth apart" in words(window)
        assert "changed" in element(window, "Colours").options[0]
        nodes, camera = window.scene._handle_from_node_name, window.server.initial_camera
        before = np.array(camera.position)
        press(window, "1: shape, 12.3 units², in a alone")
        assert np.asarray(camera.look_at) == pytest.approx(place)
        assert np.linalg.norm(np.array(camera.position) - before) > 1
        assert np.asarray(nodes["/page/first/change"].position) == pytest.approx(place)
        assert "1.50 units nearer to the camera in b; 21 sigmas, in 5 views of a" in words(window)
        labels = [getattr(one, "label", "") for one in elements(window)]
        assert {"1: shape, a, frame 6", "b, frame 8"} <= set(labels)
        press(window, "The same place", "frames 9 and 10")
        assert "a, frame 9" in words(window)
        sent = nodes["/page/first/surface"].glb_data
        press(window, "Colours", "picture")
        assert nodes["/page/first/surface"].glb_data != sent
        # One over the other they are told apart: of the same colours, each has a tint.
        sides = ("/page/first/surface", "/page/second/surface")
        assert nodes[sides[0]].glb_data == nodes[sides[1]].glb_data
        beside = nodes[sides[0]].glb_data
        press(window, "One over the other", True)
        assert len({beside, *(nodes[side].glb_data for side in sides)}) == 3
        press(window, "One over the other", False)
        assert nodes[sides[1]].glb_data == beside
        assert [nodes[f"/page/{side}/name"].text for side in ("first", "second")] == ["a", "b"]


def test_lesions_of_both_lie_in_the_world_of_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = draw_run(tmp_path / "a"), draw_run(tmp_path / "b", name="another.mp4")
    corners = np.array([[0.0, 10.0, 40.0], [2.0, 10.0, 40.0], [2.0, 10.0, 43.0]])
    for folder, name in zip(folders, ("polyp", "scar"), strict=True):
        add_measurement(folder, HandMeasure(".", 2, corners[:, :2], None, None, [], corners, "lesion", name))
    compared = np.ones(len(tube().vertices), np.uint8)
    of = registered(0.01)._replace(S_first_second=ANOTHER_WORLD)
    found = ExamComparison(of, tube(), [], [], 0.1, 0.2, (compared, compared))
    monkeypatch.setattr("scopemap.apps.exams.compare_exams.compare_exams", lambda *folders: found)
    with opened(ComparePage(*folders)) as window:
        until(window, lambda: "One over the other" in words(window))
        nodes = window.scene._handle_from_node_name
        for side, name, world in (
            ("first", "polyp", corners),
            ("second", "scar", ANOTHER_WORLD.transform_points(corners)),
        ):
            assert nodes[f"/page/{side}/lesion/0/words"].text == name
            places = [nodes[f"/page/{side}/lesion/0/{corner}"].position for corner in range(3)]
            np.testing.assert_allclose(places, world, rtol=1e-6)


def test_the_comparison_is_downloaded_as_one_file_of_both_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = draw_run(tmp_path / "a", name="before.mp4"), draw_run(tmp_path / "b", name="after.mp4")
    change = Change("shape", np.array([0.0, 10.0, 40.0]), 12.34, 1.5, 0.0, 21.0, 5, (6, 8), "both")
    compared = np.ones(len(tube().vertices), np.uint8)
    found = ExamComparison(registered(0.01), tube(), [change], [(0, 1)], 0.1, 0.2, (compared, compared))
    monkeypatch.setattr("scopemap.apps.exams.compare_exams.compare_exams", lambda *folders: found)
    for anonymous, name in ((False, "before_and_after.html"), (True, "video 1_and_video 2.html")):
        with shown_window(anonymous=anonymous) as shown:
            shown.show(ComparePage(first, second))
            shown.until(lambda: "Download the comparison" in shown.labels())
            shown.press("Download the comparison")
            ((sent, page),) = shown.sent.items()
        assert sent == name
        assert page.count(b"<img src='data:image/jpeg;base64,") == page.count(b"<img") == 2
        assert b"<td>shape</td><td>12.34</td><td>1.50</td><td>0.00</td><td>21</td><td>both</td>" in page
        assert (b"<title>a and b</title>" in page) == (not anonymous)
        assert str(tmp_path).encode() not in page


def test_of_two_that_do_not_fit_no_change_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = draw_run(tmp_path / "a"), draw_run(tmp_path / "b", name="another.mp4")
    compared = np.zeros(len(tube().vertices), np.uint8)
    found = ExamComparison(registered(0.286), tube(), [], [(0, 1)], 0.88, 0.63, (compared, compared))
    asked: list[tuple[Path, ...]] = []
    monkeypatch.setattr(
        "scopemap.apps.exams.compare_exams.compare_exams", lambda *folders: (asked.append(folders), found)[1]
    )
    with opened(ComparePage(first, second)) as window:
        until(window, lambda: "Exchange the two" in words(window))
        said = words(window)
        assert "One over the other" not in said
        assert said.index("They do not fit: matched points are 28.6%") < said.index("Found in a")
        assert "Changed places are not judged" in said
        assert "what changed" not in said
        press(window, "Exchange the two")
        until(window, lambda: "Found in b: 90% of the keyframes of a" in words(window))
    assert asked == [(first, second), (second, first)]


@pytest.mark.parametrize("aspect", [0.4, 0.6, 1.0, 2.5])
def test_both_surfaces_are_in_the_picture_whatever_its_shape(aspect: float) -> None:
    fov_rad = np.deg2rad(75)
    points = np.random.default_rng(0).uniform([-9, -2, -3], [9, 2, 3], (500, 3))
    back = distance_to_see(points, fov_rad, aspect)
    z = points[:, 2] + back
    seen = np.abs(points[:, :2]) / z[:, None] / (np.tan(fov_rad / 2) * np.array([aspect, 1.0]))
    assert z.min() > 0
    assert 0.8 < seen.max() < 0.95


# ---- the command


@contextmanager
def viewing(*arguments: object) -> Iterator[str]:
    """Where `scopemap view ARGUMENTS --no-browser` shows its window; it is ended by Ctrl-C."""
    program = [sys.executable, "-m", "scopemap", "view", *map(str, arguments), "--no-browser"]
    # A job in the background of a shell ignores Ctrl-C, and so would its children.
    heed = partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, preexec_fn=heed) as process:
        assert process.stdout is not None
        try:
            yield next(word for word in process.stdout.readline().split() if word.startswith("http"))
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()


def test_view_opens_a_window_until_ctrl_c(tmp_path: Path) -> None:
    with viewing(draw_run(tmp_path / "run")) as url, urlopen(url, timeout=20) as page:
        assert page.status == 200
        assert b"<title>scopemap</title>" in page.read()


def test_view_refuses_in_a_sentence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = draw_run(tmp_path / "run", pictures=False)
    assert "no finished run" in refused(capfd, "view", tmp_path / "none", "--no-browser")
    assert "with itself" in refused(capfd, "view", run, "--compare", run, "--no-browser")
    assert call("view", run, "--compare", run, "--turntable", tmp_path / "film.mp4") == 2
    assert "not of films" in capfd.readouterr().err
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install 'scopemap[app]'" in refused(capfd, "view", run, "--no-browser")


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (Debian: apt-get install chromium)")
@pytest.mark.parametrize("width", [1280, 800])
def test_a_browser_shows_both_and_asks_only_this_machine(tmp_path: Path, width: int) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    first, second = draw_run(tmp_path / "one"), moved(tmp_path / "other", ANOTHER_WORLD, mesh=cut_tube())
    with viewing(first, "--compare", second) as url, playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": width, "height": 800})
        page.set_default_timeout(PATIENCE_MS)  # of a machine that others keep busy
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda socket: asked.append(socket.url))
        page.goto(url)
        page.get_by_text("Distance to the other surface").wait_for()
        assert page.get_by_text("one and other").is_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        # Both are drawn, left and right of the middle of the picture.
        shown: list[float] = []
        for _ in range(60):
            picture = page.screenshot(clip={"x": 0, "y": 200, "width": width - 420, "height": 560})
            shown = coloured_columns(picture)
            if shown and shown[0] < 0.45 and shown[-1] > 0.55:
                break
            page.wait_for_timeout(500)
        assert shown
        assert shown[0] < 0.45
        assert shown[-1] > 0.55
        browser.close()
    own = {"localhost", "127.0.0.1"}
    foreign = [
        one for one in asked if urlsplit(one).scheme not in ("data", "blob") and urlsplit(one).hostname not in own
    ]
    assert (foreign, len(asked) > 2) == ([], True)


def coloured_columns(picture: bytes) -> list[float]:
    """Which columns of a picture have a colour, over its width."""
    import cv2

    rgb = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).astype(int)
    columns = np.flatnonzero(((rgb.max(-1) - rgb.min(-1)) > 60).sum(0) > 5)
    return [float(columns[0]) / rgb.shape[1], float(columns[-1]) / rgb.shape[1]] if len(columns) else []
