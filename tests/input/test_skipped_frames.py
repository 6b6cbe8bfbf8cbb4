"""A run on a video of which some frames are left out: what lies in its folder, and what reads it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config
from scopemap.input.camera_files.writing import write_calibration
from scopemap.input.frame_choice import FrameChoice
from scopemap.input.source import SourceFrame
from scopemap.result.trajectories import read_trajectory
from tests.support.drawn_videos import encode
from tests.support.front_door import call, said
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import only_images, write_tiny

pytestmark = pytest.mark.slow

FAST = ("--preset", "realtime", "--quiet")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    folder = tmp_path_factory.mktemp("phantom")
    images = only_images(write_tiny(folder / "sound"), folder / "images")
    return [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in sorted(images.iterdir())]


@pytest.fixture(scope="module")
def video(pictures: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 3 and 7 repeat those before them; it begins black."""
    order = [0, 1, 1, 2, 3, 4, 4, 5, 6]
    shown = [np.zeros_like(pictures[0]), *(pictures[number] for number in order)]
    return encode(tmp_path_factory.mktemp("video") / "v.mp4", shown)


def test_skipped_frames_are_named_counted_and_have_no_pose(
    video: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert call("run", video, "--out", out, "--preset", "realtime") == 0
    rows = frame_rows(out)
    assert [int(row["index"]) for row in rows] == list(range(10))
    skipped = {int(row["index"]): row for row in rows if row["status"] == "skipped"}
    assert {index: row["reason"] for index, row in skipped.items()} == {3: "repeats frame 2", 7: "repeats frame 6"}
    assert all(row["keyframe"] == row["residual"] == row["depth_scale"] == "" for row in skipped.values())
    assert float(skipped[3]["time_s"]) == pytest.approx(3 / 25)
    # Black is no repetition of anything: it is lost, with its own reason.
    assert rows[0]["status"] == "lost"
    assert "2 skipped as repeats" in capfd.readouterr().out
    facts = json.loads((out / "provenance.json").read_text())
    assert (facts["frames"], facts["skipped"]) == (8, {"repeated": 2})
    read = read_trajectory(out)
    assert read.indices.tolist() == [0, 1, 2, 4, 5, 6, 8, 9]
    assert not (out / "depth" / "000003.png").exists()
    assert call("evaluate", out, "--truth", out) == 0


def test_options_choose_frames(video: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert call("run", video, "--out", out, "--fps", 12.5, *FAST[:2]) == 0
    assert "frame 5 of 5" in capfd.readouterr().err
    rows = frame_rows(out)
    used = [int(row["index"]) for row in rows if row["status"] != "skipped"]
    assert used == [0, 2, 4, 6, 8]
    assert {row["reason"] for row in rows if row["status"] == "skipped"} == {"beyond 12.5 frames/s"}
    assert Config.load(file=out / "config.toml").input.fps == 12.5
    other = tmp_path / "all"
    assert call("run", video, "--out", other, "--set", "input.skip_duplicates=false", *FAST) == 0
    assert "skipped" not in {row["status"] for row in frame_rows(other)}


def test_stereo_and_fields_by_option(pictures: list[np.ndarray], tmp_path: Path) -> None:
    height, width = pictures[0].shape[:2]
    stacked = encode(tmp_path / "v.mp4", [np.vstack([one, one[:, ::-1]]) for one in pictures])
    out = tmp_path / "out"
    # The calibration is of pictures twice as large as one view.
    camera = PinholeCamera(1.6 * width, 1.6 * width, width, height, 2 * width, 2 * height)
    write_calibration(camera, tmp_path / "camera.yaml")
    arguments = ("--stereo", "top-bottom", "--deinterlace", "--camera", tmp_path / "camera.yaml", *FAST)
    assert call("run", stacked, "--out", out, *arguments) == 1
    assert call("run", stacked, "--out", out, *arguments, "--camera-fit", "scale") == 0
    facts = json.loads((out / "provenance.json").read_text())
    assert (facts["camera"]["width"], facts["camera"]["height"]) == (width, height)
    assert facts["camera"]["fx"] == pytest.approx(0.8 * width)
    assert any(note.lower().startswith("stereo, top-bottom: the upper half") for note in said(facts))
    assert any(note.lower().startswith("one field of each picture") for note in said(facts))
    read = Config.load(file=out / "config.toml").input
    assert (read.stereo, read.deinterlace, read.camera_fit) == ("top-bottom", "on", "scale")


@pytest.mark.parametrize(("rate_hz", "fps", "step"), [(30, 30, 1), (30, 15, 2), (60, 60, 1), (25, 25, 1), (24, 12, 2)])
def test_stamps_in_milliseconds_thin_evenly(rate_hz: float, fps: float, step: int) -> None:
    shown = np.zeros((8, 8, 3), np.uint8)
    frames = [SourceFrame(index, round(index / rate_hz, 3), shown) for index in range(40)]
    assert [frame.index for frame in FrameChoice(fps)(frames)] == list(range(0, 40, step))
