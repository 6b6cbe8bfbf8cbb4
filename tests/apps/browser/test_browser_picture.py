"""The video's picture in the window, in place of the surface: it is sharp, and a click on it is the pixel it shows."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.apps.browser.result_page import ResultPage
from scopemap.engine.geometry.rendering import render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.camera_files.writing import write_calibration
from scopemap.report.measured_by_hand import read_measurements
from scopemap.runner.reread_frames import sharp_picture
from tests.support.drawn_run import CAMERA, FRAMES, IN_RESULT, draw_run, draw_run_of_frames, pose_of, tube
from tests.support.shown_window import ShownWindow, shown_window

pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")

KNOWN = {"known": True, "source": "a ruler", "measured": True}
LARGER = 3
PICTURE, MODEL = "/page/video_picture", "/page/model"


def run_of_large_frames(root: Path) -> Path:
    """A run at a working size, and its input, three times as large."""
    folder, camera = draw_run_of_frames(root), CAMERA.resized(LARGER * CAMERA.width, LARGER * CAMERA.height)
    write_calibration(camera, root / "frames" / "camera.yaml")
    for index in range(FRAMES):
        cv2.imwrite(
            str(root / "frames" / f"{index:06d}.png"), render_mesh(tube(), camera, pose_of(index)).rgb[..., ::-1]
        )
    return folder


def click_on_picture(shown: ShownWindow, page: ResultPage, pixel: tuple[float, float], eye: np.ndarray) -> None:
    """Click on a pixel of the picture in the scene, looking from anywhere, (3,) mm in the camera of the frame."""
    picture, pose = shown.nodes[PICTURE], pose_of(page._shown.index)
    # Where the picture is and how large is what the browser draws.
    middle = transform(inverse(pose), np.array(picture.position)[None])[0]
    size = np.array([picture.render_width, picture.render_height])
    offset = ((np.array(pixel) + 0.5) / [CAMERA.width, CAMERA.height] - 0.5) * size
    place = transform(pose, (middle + np.append(offset, 0.0))[None])[0]
    start = transform(pose, eye[None])[0]
    shown.window.do(page.click, start, place - start)
    shown.settle()


def test_the_picture_is_at_the_resolution_of_the_video(tmp_path: Path) -> None:
    folder = run_of_large_frames(tmp_path)
    found = sharp_picture(folder, 5)
    assert found is not None
    drawn = cv2.imread(str(tmp_path / "frames" / "000005.png"))[..., ::-1]
    assert found.shape == drawn.shape
    assert np.abs(found.astype(int) - drawn).mean() < 1
    assert sharp_picture(folder, 5000) is None


def test_points_on_the_picture_are_measured_in_its_frame(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    page = ResultPage(folder)
    with shown_window() as shown:
        shown.show(page)
        shown.choose("Slider", "Frame", 4)
        shown.choose("Checkbox", "On the video's picture", True)
        shown.until(lambda: PICTURE in shown.nodes)
        assert not shown.nodes[MODEL].visible
        np.testing.assert_allclose(shown.window.server.initial_camera.position, pose_of(4)[:3, 3], atol=1e-6)
        shown.choose("ButtonGroup", "Measure", "Distance")
        # The second time from beside the camera: a ray of one's own would meet the surface elsewhere.
        click_on_picture(shown, page, (20.0, 20.0), np.zeros(3))
        click_on_picture(shown, page, (60.0, 44.0), np.array([3.0, -2.0, -1.0]))
        shown.until(lambda: len(read_measurements(folder)) == 1)
        (kept,) = read_measurements(folder)
        assert kept["frame"] == 4
        np.testing.assert_allclose(kept["points"], [(20.0, 20.0), (60.0, 44.0)], atol=0.05)
        # Beside the picture there is nothing, though the hidden surface goes on there.
        click_on_picture(shown, page, (-30.0, 20.0), np.zeros(3))
        assert "There is no surface there." in shown.words
        shown.choose("Checkbox", "On the video's picture", False)
        assert PICTURE not in shown.nodes
        assert shown.nodes[MODEL].visible


def test_a_lesion_is_outlined_on_the_picture(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, scale=KNOWN)
    page = ResultPage(folder)
    corners = [(52.0, 26.0), (64.0, 26.0), (64.0, 38.0), (52.0, 38.0)]
    with shown_window() as shown:
        shown.show(page)
        shown.choose("Slider", "Frame", 4)
        shown.choose("Checkbox", "On the video's picture", True)
        shown.until(lambda: PICTURE in shown.nodes)
        shown.choose("ButtonGroup", "Measure", "Lesion")
        for corner in corners:
            click_on_picture(shown, page, corner, np.array([3.0, -2.0, -1.0]))
        shown.press("Measure the lesion")
        shown.until(lambda: len(read_measurements(folder)) == 1)
    (kept,) = read_measurements(folder)
    assert (kept["kind"], kept["frame"]) == ("lesion", 4)
    np.testing.assert_allclose(kept["points"], corners, atol=0.05)


def test_the_picture_follows_the_frame_and_says_where_there_is_none(tmp_path: Path) -> None:
    folder = run_of_large_frames(tmp_path)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.choose("Checkbox", "On the video's picture", True)
        shown.until(lambda: PICTURE in shown.nodes)
        first = np.array(shown.nodes[PICTURE].position)
        assert shown.nodes[PICTURE].image.shape[1] == LARGER * CAMERA.width
        shown.choose("Slider", "Frame", 6)
        shown.until(lambda: PICTURE in shown.nodes)
        moved = np.array(shown.nodes[PICTURE].position) - first
        assert np.linalg.norm(moved) > 1
        # A lost frame has no pose, so that nothing can be measured in it.
        shown.choose("Slider", "Frame", IN_RESULT)
        assert PICTURE not in shown.nodes
        assert shown.nodes[MODEL].visible
        assert "This frame has no pose in this submap: nothing can be measured in it." in shown.words


def test_without_the_video_only_what_was_kept_is_shown(tmp_path: Path) -> None:
    folder = draw_run(tmp_path, pictures=False)
    with shown_window() as shown:
        shown.show(ResultPage(folder))
        shown.choose("Checkbox", "On the video's picture", True)
        shown.until(lambda: "The video is not where it was" in shown.words)
        assert PICTURE not in shown.nodes
        assert shown.nodes[MODEL].visible
