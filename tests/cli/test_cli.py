"""The command line as people use it: what it writes and prints, its help, and how it refuses."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import typer.main

from scopemap import __version__
from scopemap.cli.app import app, main
from tests.support.front_door import call, refused, warned
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import FRAMES, SIZE, only_images, write_black, write_tiny

pytestmark = pytest.mark.slow

Capture = pytest.CaptureFixture[str]
JSON_KEYS = [
    "input",
    "dataset",
    "frames",
    "tracked",
    "lost",
    "rotation_only",
    "in_other_maps",
    "selection",
    "skipped",
    "camera",
]
JSON_KEYS += ["scale", "estimators", "notices", "seconds", "versions", "machine", "surface"]
JSON_KEYS += [
    "segments",
    "main_segment",
    "loops",
    "interrupted_at_frame",
    "resumed_after_frame",
    "input_absolute",
    "input_relative",
]
JSON_KEYS += ["input_content"]
JSON_KEYS += ["verdict", "out", "preset", "mesh_faces"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "sound")


@pytest.fixture(scope="module")
def images(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return only_images(folder, tmp_path_factory.mktemp("plain") / "images")


def _video(file: Path, images: list[np.ndarray]) -> Path:
    with av.open(str(file), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.gop_size = *SIZE, "yuv420p", 1
        stream.bit_rate = 4_000_000
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode())
    return file


def _indices(out: Path) -> list[int]:
    return [int(row["index"]) for row in frame_rows(out)]


# ---- run


def test_run_writes_its_folder_and_says_what_it_found(tmp_path: Path, capfd: Capture) -> None:
    folder, out = write_tiny(tmp_path / "phantom", "black:3-3"), tmp_path / "out"
    assert call("run", folder, "--out", out, "--depth", f"files:{folder}") == 0
    said = capfd.readouterr()
    assert {"trajectory.tum", "mesh.ply", "mesh.glb", "frames.csv", "config.toml", "provenance.json", "depth"} <= {
        path.name for path in out.iterdir()
    }
    assert re.search(rf"^  frames   {FRAMES - 1} of {FRAMES} tracked, 1 lost; path \d+\.\d mm$", said.out, re.MULTILINE)
    assert re.search(
        r"^Note: The camera was lost in 1 frames?, .* too dark\. Next time, go nearer", said.out, re.MULTILINE
    )
    for words in ("scale    measured depth", "camera   calibration file camera.yaml", str(out / "report.html")):
        assert words in said.out
    assert f"frame {FRAMES} of {FRAMES}" in said.err
    assert "writing the report" in said.err
    assert "not adjusted" not in said.err + said.out  # depth was measured


def test_json_has_its_keys_and_nothing_else_is_printed(images: Path, tmp_path: Path, capfd: Capture) -> None:
    assert call("run", images, "--out", tmp_path, "--json", "--preset", "realtime", "--near-far", "5:80") == 0
    said = capfd.readouterr()
    facts = json.loads(said.out)
    assert list(facts) == JSON_KEYS
    assert said.err.startswith("warning: The focal length is assumed: ")
    assert all(line.startswith("warning: ") for line in said.err.splitlines())
    assert (facts["frames"], facts["preset"], facts["dataset"]) == (FRAMES, "realtime", "images")
    assert facts["out"] == str(tmp_path)
    assert facts["estimators"]["anchor"] == "near-far 5:80 mm"
    assert "assumed: horizontal field of view 70 deg" in facts["camera"]["source"]
    assert facts["mesh_faces"] > 0


def test_options_reach_the_settings_and_win_over_a_file(images: Path, tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "s.toml").write_text(
        "[tracking]\nmethod = 'paper'\nhuber = 0.4\nkeyframe_every = 3\n[networks]\nflow = 'dis'\n"
    )
    options = ("--config", tmp_path / "s.toml", "--set", "tracking.photometric=scopemap", "--flow", "none")
    options += ("--device", "cpu", "--size", "80x64", "--fov", "90", "--frames", "2:8:2", "--json")
    assert call("run", images, "--out", tmp_path / "out", *options) == 0
    written = (tmp_path / "out" / "config.toml").read_text()
    lines = ('tracking.method = "paper"', 'tracking.photometric = "scopemap"', "tracking.huber = 0.4", '"cpu"')
    for line in (*lines, "tracking.keyframe_every = 3", 'networks.flow = "none"', 'tracking.checks = "poses"'):
        assert line in written
    camera = json.loads(capfd.readouterr().out)["camera"]
    assert (camera["width"], camera["height"], camera["fx"]) == (80, 64, pytest.approx(40.0))
    assert _indices(tmp_path / "out") == [2, 4, 6]


def test_a_video_that_breaks_off_is_used_as_far_as_it_goes(images: Path, tmp_path: Path, capfd: Capture) -> None:
    """The warning is printed unless all is to be quiet, and is kept in the result."""
    file = _video(tmp_path / "scope.avi", [cv2.imread(str(file)) for file in sorted(images.iterdir())] * 2)
    file.write_bytes(file.read_bytes()[: int(0.5 * file.stat().st_size)])
    pattern = r"scope\.avi breaks off after \d+.* frames; these were used"
    for quiet in ((), ("--quiet",)):
        assert call("run", file, "--out", tmp_path / "out", "--overwrite", *quiet) == 0
        said = capfd.readouterr()
        assert (said.out + said.err == "") if quiet else re.search(f"^Note: .*{pattern}", said.out, re.MULTILINE)
        assert re.search(pattern, " ".join(warned(json.loads((tmp_path / "out" / "provenance.json").read_text()))))
    assert 4 <= len(_indices(tmp_path / "out")) < 2 * FRAMES


# ---- refusals


def _even_video(folder: Path, level: int, noise: float) -> tuple[object, ...]:
    rng = np.random.default_rng(0)
    pictures = [np.clip(rng.normal(level, noise, (*SIZE[::-1], 3)), 0, 255).astype(np.uint8) for _ in range(5)]
    return (_video(folder / "even.mp4", pictures),)


def _wrong_calibration(folder: Path) -> tuple[object, ...]:
    storage = cv2.FileStorage(str(folder / "c.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.diag([500.0, 500.0, 1.0]) + np.array([[0, 0, 320], [0, 0, 240], [0, 0, 0]]))
    storage.release()
    return (write_black(folder / "black"), "--camera", folder / "c.yaml")


def _text(folder: Path) -> tuple[object, ...]:
    (folder / "notes.txt").write_text("a line of text\n" * 300)
    return (folder / "notes.txt",)


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (lambda folder: (folder / "absent.mp4",), r"absent\.mp4: no such file or folder"),
        (_text, r"notes\.txt: it is a text file, not a video"),
        (lambda folder: _even_video(folder, 0, 0.0), r"no frame of .*even\.mp4 could be used"),
        (lambda folder: _even_video(folder, 120, 3.0), r"no frame of .*even\.mp4 could be used"),
        (_wrong_calibration, r"is for 640x480 px, but the images are 160x128 px"),
    ],
)
def test_bad_input_is_one_line(
    make: Callable[[Path], tuple[object, ...]], pattern: str, tmp_path: Path, capfd: Capture
) -> None:
    assert re.search(pattern, refused(capfd, "run", *make(tmp_path), "--out", tmp_path / "out", "--quiet"))


TOO_LARGE = "is too large: 32000 px a side and 64 million pixels at most"


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        (("--frames", "0:9:0"), "step must be positive"),
        (("--frames", "50:60"), "0 frame.* two are needed"),
        (("--size", "8x8"), "too small"),
        (("--size", "40000x100"), f"the working size 40000x100 px {TOO_LARGE}"),
        (("--size", "20000x20000"), f"the working size 20000x20000 px {TOO_LARGE}"),
        (("--near-far", "80:10"), "nearest must be positive and smaller"),
        (("--depth", "sonar"), "unknown depth 'sonar'"),
        (("--flow", "farneback"), "unknown flow 'farneback': choose one of dis"),
        (("--dataset", "endomopper"), "unknown data set 'endomopper': choose one of"),
        (("--camera", "/nowhere.yaml"), "cannot read the calibration"),
        (("--camera", "120 120 80 64 1e10 0 0 0"), "check the distortion coefficients"),
        (("--camera", "120 120 80 64 0 0 1e10 0"), "check the distortion coefficients"),
        (("--preset", "paper"), "pull depth-anything && .*pull depth-pro && .*pull raft"),
    ],
)
def test_a_bad_option_is_one_line(
    arguments: tuple[str, ...],
    pattern: str,
    images: Path,
    tmp_path: Path,
    capfd: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    assert re.search(pattern, refused(capfd, "run", images, "--out", tmp_path / "out", "--quiet", *arguments))
    assert not (tmp_path / "out" / "trajectory.tum").exists()


def test_other_commands_refuse_in_one_line_too(tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no" in refused(capfd, "evaluate", tmp_path / "no", "--truth", tmp_path / "no")
    assert "no-such-model" in refused(capfd, "models", "verify", "no-such-model")
    for name in ("b.mp4", "a.AVI", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    for command in (("run", tmp_path, "--out", tmp_path / "out"), ("inspect", tmp_path, "--out", tmp_path / "a.png")):
        found = refused(capfd, *command)
        assert "it holds 2 video(s) (a.AVI, b.mp4) and no images; give one of them, such as" in found
    monkeypatch.setattr("scopemap.terminal.options.os.access", lambda *_: False)
    found = refused(capfd, "inspect", tmp_path / "none.mp4", "--out", tmp_path / "new" / "a.png")
    assert f"no permission to write in {tmp_path}" in found


@pytest.mark.parametrize(
    "arguments",
    [
        *(("run",), ("run", "somewhere"), ("run", "somewhere", "--out", "x", "--wrong")),
        *(("run", "somewhere", "--out", "x", "--preset", "fast"), ("run", "somewhere", "--out", "x", "--fov", "500")),
        *(("evaluate", "somewhere"), ("models", "burn"), ("frobnicate",)),
    ],
)
def test_wrong_usage_is_code_2(arguments: tuple[str, ...], capfd: Capture) -> None:
    assert call(*arguments) == 2
    assert "Usage: scopemap" in capfd.readouterr().err


def test_an_interruption_is_code_130_and_a_bug_keeps_its_traceback(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    def fails(error: BaseException) -> Callable[..., None]:
        def fail(*_: object, **__: object) -> None:
            raise error

        return fail

    command = ("run", images, "--out", tmp_path / "out")
    monkeypatch.setattr("scopemap.runner.with_report.reconstruct", fails(KeyboardInterrupt()))
    assert call(*command) == 130
    assert "Traceback" not in capfd.readouterr().err
    monkeypatch.setattr("scopemap.runner.with_report.reconstruct", fails(ZeroDivisionError("a bug")))
    monkeypatch.setattr(sys, "argv", ["scopemap", *map(str, command)])
    with pytest.raises(ZeroDivisionError, match="a bug"):
        main()


# ---- help


def _commands(command: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    for one, below in command.commands.items():
        yield from _commands(below, f"{name}{one} ") if hasattr(below, "commands") else [(f"{name}{one}", below)]


COMMANDS = dict(_commands(typer.main.get_command(app)))


def test_help_names_the_commands_and_version_the_version(capfd: Capture) -> None:
    assert call("--help") == 0
    assert {name.split()[0] for name in COMMANDS} <= set(re.findall(r"[a-z-]+", capfd.readouterr().out))
    done = subprocess.run([sys.executable, "-m", "scopemap", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"scopemap {__version__}\n"
