"""`scopemap calibrate`: from pictures of a board to a file that every command reads; refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from scopemap.engine.cameras.camera import source_pixel
from scopemap.engine.cameras.lenses import OpenCvCamera
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.images import read_image
from scopemap.input.opening import open_sequence
from tests.support.drawn_boards import CHECKERBOARD, PINHOLE, SIZE, Studio
from tests.support.drawn_inputs import save
from tests.support.drawn_videos import encode
from tests.support.front_door import call

Say = Callable[..., tuple[int, str, str]]
BOARD = ("--board", "9x6", "--square-mm", 3)


@pytest.fixture
def calibrate(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Say:
    """The command `scopemap calibrate` in an empty folder: exit code, stdout, stderr."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.chdir(tmp_path)

    def said(*arguments: object) -> tuple[int, str, str]:
        code, printed = call("calibrate", *arguments), capfd.readouterr()
        return code, printed.out, printed.err

    return said


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten pictures of a board in the middle, tilted, each twice."""
    folder = tmp_path_factory.mktemp("board") / "frames é [1]"
    folder.mkdir()
    studio = Studio(PINHOLE, CHECKERBOARD)
    poses = [pose for i, pose in enumerate(studio.poses(40, seed=3)) if i % 4 in (1, 2) and i // 4 % 3 == 1]
    poses += [pose for i, pose in enumerate(studio.poses(40, seed=5)) if i % 4 in (1, 2) and i // 4 % 3 == 1]
    for i, pose in enumerate(poses[:10]):
        for again in range(2):
            save(folder / f"{2 * i + again:03d}.png", studio.shot(pose, seed=2 * i + again))
    return folder


@pytest.mark.slow
def test_a_calibration_that_every_command_reads(calibrate: Say, frames: Path, tmp_path: Path) -> None:
    code, out, err = calibrate(frames, *BOARD, "--model", "pinhole", "--every", 2)
    assert code == 0
    assert "looked at 10 of 10 frames\nthe board was found in 10 of 10 frames; fitting\n" in err
    assert "warning: only 10 views that differ" in err
    assert "model: pinhole with k1" in out
    assert "calibration: calibration.yaml (use it as --camera calibration.yaml); picture: calibration.png" in out
    assert (tmp_path / "calibration.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["calibration.png", "calibration.yaml"]
    camera = read_calibration("calibration.yaml", SIZE).camera
    assert isinstance(camera, OpenCvCamera)
    assert camera.central.fx == pytest.approx(265, rel=0.02)
    sequence = open_sequence(frames, camera=tmp_path / "calibration.yaml")
    assert sequence.calibrated
    assert sequence.camera_source == "calibration file calibration.yaml"
    pixel = np.array([60.0, 60.0])
    expected = PINHOLE.project(sequence.camera.unproject(pixel))
    assert source_pixel(pixel, sequence.camera, sequence.rectifier.source) == pytest.approx(expected, abs=3)
    # What is there stays, unless the word is given.
    code, out, err = calibrate(frames, *BOARD)
    assert (code, out) == (1, "")
    assert err == "scopemap: calibration.yaml exists; give another name with --out, or --overwrite\n"
    code, out, err = calibrate(frames, *BOARD, "--model", "pinhole", "--frames", "::2", "--json", "--overwrite")
    assert (code, [line for line in err.splitlines() if not line.startswith("warning: ")]) == (0, [])
    told = json.loads(out)
    assert (told["looked_at"], told["every"], told["found"], told["image_size"]) == (10, 1, 10, list(SIZE))
    assert told["parameters"]["fx"] == pytest.approx(camera.central.fx)
    assert {"frame", "name", "corners", "rms_px", "tilt_deg", "distance_mm"} == set(told["views"][0])


@pytest.mark.slow
def test_two_views_in_a_picture_are_read_as_a_run_reads_them(calibrate: Say, frames: Path, tmp_path: Path) -> None:
    pictures = [read_image(file) for file in sorted(frames.iterdir())[::2]]
    both = [np.hstack([left, np.roll(left[::-1], 12, axis=1)]) for left in pictures]
    video = encode(tmp_path / "both.mp4", both)
    code, _, err = calibrate(video, *BOARD, "--model", "pinhole", "--set", "input.stereo=left-right")
    assert code == 0
    assert "note: stereo, left-right: the left half of each picture is used: as asked" in err
    camera = read_calibration("calibration.yaml", SIZE).camera
    assert camera.central.fx == pytest.approx(265, rel=0.02)
    assert camera.central.cx == pytest.approx(163, abs=4)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--board", "9by6", "--square-mm", 3), "cannot read the board '9by6': expected COLUMNSxROWS such as 9x6"),
        (("--board", "9x6", "--square-mm", 0), "the squares of a board must be larger than 0 mm, got 0"),
        ((*BOARD, "--charuco"), "a ChArUco board needs the side of its markers: give --marker-mm"),
        ((*BOARD, "--legacy"), "are for a ChArUco board: give --charuco, too"),
        ((*BOARD, "--charuco", "--marker-mm", 2, "--dictionary", "DICT_1"), "unknown markers 'DICT_1'"),
        ((*BOARD, "--out", "camera.txt"), "its name must end in .yaml or .yml"),
        ((*BOARD, "--out", "none/c.yaml"), "the folder none is not there or not writable"),
        ((*BOARD, "--set", "input.focal=flow"), "'input.focal' has no part in a calibration: only input.stereo and"),
        ((*BOARD, "--set", "input.stereo=both"), "input.stereo"),
    ],
)
def test_refusals(arguments: tuple[object, ...], words: str, calibrate: Say, tmp_path: Path) -> None:
    """Before any picture is looked for a board."""
    (tmp_path / "frames").mkdir()
    save(tmp_path / "frames" / "0.png", np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    code, out, err = calibrate("frames", *arguments)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert words in err
    code, _, err = calibrate("none.mp4", *BOARD)
    assert (code, err) == (1, "scopemap: reading none.mp4: no such file or folder\n")
