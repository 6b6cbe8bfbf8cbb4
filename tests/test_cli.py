"""The command line as people use it: what it writes and prints, and how it refuses."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from front_door import warned
from tiny_phantom import FRAMES, SIZE, only_images, write_black, write_tiny

from scopemap import __version__
from scopemap.cli.app import main

OPTIONS = {
    "run": "--out --preset --config --dataset --camera --fov --camera-fit --stereo --deinterlace --near-far --depth"
    " --camera-at-rest --surface-at --flow --frames --fps --size --device --colours --mesh-faces --mesh-smooth"
    " --mesh-watertight --set --overwrite --resume --json --quiet",
    "evaluate": "--truth --align --unit --paper-units --json --quiet",
    "phantom": "--scene --frames --size --seed --path --deform --loop --events --set --json --quiet",
    "models list": "--json --quiet",
    "models pull": "--json --quiet",
    "models verify": "--json --quiet",
}
JSON_KEYS = ["input", "dataset", "frames", "tracked", "lost", "rotation_only", "in_other_maps", "skipped", "camera"]
JSON_KEYS += ["scale", "estimators", "notices", "seconds", "versions", "machine", "surface"]
JSON_KEYS += ["interrupted_at_frame", "resumed_after_frame", "input_content"]
JSON_KEYS += ["out", "preset", "mesh_faces"]


@dataclass(frozen=True)
class _Said:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


Say = Callable[..., _Said]


@pytest.fixture
def scopemap(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Say:
    """The command `scopemap`, by its own door: what it says and its exit code."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")

    def call(*arguments: object) -> _Said:
        monkeypatch.setattr(sys, "argv", ["scopemap", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        code = caught.value.code
        said = capfd.readouterr()
        return _Said(code if isinstance(code, int) else int(code is not None), said.out, said.err)

    return call


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
    with (out / "frames.csv").open(newline="") as file:
        return [int(row["index"]) for row in csv.DictReader(file)]


def _refused(said: _Said, pattern: str) -> None:
    """One line on stderr that names the trouble, nothing on stdout, exit code 1."""
    assert said.code == 1, said
    assert said.out == ""
    assert said.err.count("\n") == 1, said.err
    assert said.err.startswith("scopemap: ")
    assert re.search(pattern, said.err), said.err


# ---- run


def test_run_writes_its_folder_and_says_what_it_found(scopemap: Say, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = scopemap("run", folder, "--out", out, "--depth", f"files:{folder}")
    assert said.code == 0, said.err
    assert {"trajectory.tum", "mesh.ply", "mesh.glb", "frames.csv", "config.toml", "provenance.json", "depth"} <= {
        path.name for path in out.iterdir()
    }
    assert f"{FRAMES} of {FRAMES} frames tracked" in said.out
    assert re.search(r"path \d+\.\d mm", said.out)
    assert "scale: measured depth" in said.out
    assert "camera: calibration file camera.yaml" in said.out
    assert str(out) in said.out
    assert f"frame {FRAMES} of {FRAMES}" in said.err
    assert str(out / "report.html") in said.out
    assert "writing the report" in said.err


def test_json_has_its_keys_and_nothing_else_is_printed(scopemap: Say, images: Path, tmp_path: Path) -> None:
    said = scopemap("run", images, "--out", tmp_path / "out", "--json", "--preset", "realtime", "--near-far", "5:80")
    assert said.code == 0
    assert list(said.json) == JSON_KEYS
    assert re.fullmatch(r"warning: the camera is unknown, and assumed: .*\n", said.err)
    assert (said.json["frames"], said.json["preset"], said.json["dataset"]) == (FRAMES, "realtime", "images")
    assert said.json["out"] == str(tmp_path / "out")
    assert said.json["estimators"]["anchor"] == "near-far 5:80 mm"
    assert "assumed: horizontal field of view 70 deg" in said.json["camera"]["source"]
    assert said.json["mesh_faces"] > 0


def test_quiet_says_nothing(scopemap: Say, images: Path, tmp_path: Path) -> None:
    said = scopemap("run", images, "--out", tmp_path / "out", "--quiet", "--set", "fusion.enabled=false")
    assert (said.code, said.out, said.err) == (0, "", "")


@pytest.mark.parametrize(("text", "expected"), [("2:8:2", [2, 4, 6]), (":3", [0, 1, 2]), ("-2:", [7, 8])])
def test_frames_is_a_slice(scopemap: Say, images: Path, tmp_path: Path, text: str, expected: list[int]) -> None:
    said = scopemap("run", images, "--out", tmp_path / "out", "--frames", text, "--quiet", "--flow", "none")
    assert said.code == 0, said.err
    assert _indices(tmp_path / "out") == expected


def test_options_reach_the_settings_and_win_over_a_file(scopemap: Say, images: Path, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[tracking]\nadvanced.huber = 2.5\nkeyframe_every = 3\n[networks]\nflow = 'dis'\n")
    options = ("--set", "tracking.advanced.huber=1.5", "--flow", "none", "--device", "cpu")
    arguments = ("--config", tmp_path / "s.toml", *options)
    said = scopemap("run", images, "--out", tmp_path / "out", "--size", "80x64", "--fov", "90", *arguments, "--json")
    assert said.code == 0, said.err
    written = (tmp_path / "out" / "config.toml").read_text()
    for line in ("tracking.advanced.huber = 1.5", "tracking.keyframe_every = 3", 'networks.flow = "none"', '"cpu"'):
        assert line in written
    camera = said.json["camera"]
    assert (camera["width"], camera["height"], camera["fx"]) == (80, 64, pytest.approx(40.0))


def test_a_file_may_name_the_preset(scopemap: Say, images: Path, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text('preset = "realtime"\n')
    for more in ((), ("--preset", "default"), ("--set", "preset=default")):
        preset = "default" if more else "realtime"
        arguments = ("--config", tmp_path / "s.toml", "--frames", "0:2", "--json", "--overwrite", *more)
        assert scopemap("run", images, "--out", tmp_path / "out", *arguments).json["preset"] == preset


def test_an_earlier_run_is_kept_unless_overwritten(scopemap: Say, images: Path, tmp_path: Path) -> None:
    arguments = ("run", images, "--out", tmp_path / "out", "--quiet", "--flow", "none", "--frames")
    assert scopemap(*arguments, "0:3").code == 0
    _refused(scopemap(*arguments, "0:2"), r"not empty.*--overwrite")
    assert _indices(tmp_path / "out") == [0, 1, 2]
    assert scopemap(*arguments, "0:2", "--overwrite").code == 0
    assert _indices(tmp_path / "out") == [0, 1]


def test_a_lost_frame_is_told(scopemap: Say, tmp_path: Path) -> None:
    folder = write_tiny(tmp_path / "phantom", "black:3-3", frames=6)
    said = scopemap("run", folder, "--out", tmp_path / "out", "--depth", f"files:{folder}")
    assert said.code == 0
    assert "5 of 6 frames tracked" in said.out
    assert re.search(r"^lost: 0\.10 s \(1 frame\), too dark: go nearer", said.out, re.MULTILINE)


# ---- video


def test_a_video_that_breaks_off_is_used_as_far_as_it_goes(scopemap: Say, images: Path, tmp_path: Path) -> None:
    pictures = [cv2.imread(str(file)) for file in sorted(images.iterdir())]
    file = _video(tmp_path / "scope.avi", pictures * 2)
    file.write_bytes(file.read_bytes()[: int(0.5 * file.stat().st_size)])
    said = scopemap("run", file, "--out", tmp_path / "out")
    assert said.code == 0, said.err
    assert re.search(r"^warning: .*scope\.avi breaks off after \d+.* frames; these were used", said.err, re.MULTILINE)
    assert 4 <= len(_indices(tmp_path / "out")) < 2 * FRAMES


@pytest.mark.parametrize("level", [0, 2, 120])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_a_black_or_even_video_is_refused(scopemap: Say, level: int, noise: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [np.clip(rng.normal(level, noise, (*SIZE[::-1], 3)), 0, 255).astype(np.uint8) for _ in range(5)]
    file = _video(tmp_path / "even.mp4", pictures)
    _refused(scopemap("run", file, "--out", tmp_path / "out", "--quiet"), r"no frame of .*even\.mp4 could be used")


def test_quiet_keeps_warnings_to_the_files(scopemap: Say, images: Path, tmp_path: Path) -> None:
    file = _video(tmp_path / "scope.avi", [cv2.imread(str(file)) for file in sorted(images.iterdir())] * 2)
    file.write_bytes(file.read_bytes()[: int(0.5 * file.stat().st_size)])
    said = scopemap("run", file, "--out", tmp_path / "out", "--quiet")
    assert (said.code, said.out, said.err) == (0, "", "")
    assert warned(json.loads((tmp_path / "out" / "provenance.json").read_text()))


# ---- refusals


def _nothing(folder: Path) -> tuple[object, ...]:
    return (folder / "absent.mp4",)


def _empty_folder(folder: Path) -> tuple[object, ...]:
    (folder / "empty").mkdir()
    return (folder / "empty",)


def _no_video(folder: Path) -> tuple[object, ...]:
    (folder / "notes.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    return (folder / "notes.mp4",)


def _text(folder: Path) -> tuple[object, ...]:
    (folder / "notes.txt").write_text("a line of text\n" * 300)
    return (folder / "notes.txt",)


def _one_frame(folder: Path) -> tuple[object, ...]:
    (folder / "one").mkdir()
    cv2.imwrite(str(folder / "one" / "0.png"), np.full((64, 80, 3), 90, np.uint8))
    return (folder / "one",)


def _black_images(folder: Path) -> tuple[object, ...]:
    return (write_black(folder / "black"),)


def _wrong_calibration(folder: Path) -> tuple[object, ...]:
    storage = cv2.FileStorage(str(folder / "c.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.diag([500.0, 500.0, 1.0]) + np.array([[0, 0, 320], [0, 0, 240], [0, 0, 0]]))
    storage.release()
    return (write_black(folder / "black"), "--camera", folder / "c.yaml")


def _image_without_pose(folder: Path) -> tuple[object, ...]:
    c3vd = folder / "c3vd"
    c3vd.mkdir()
    for i in range(3):
        cv2.imwrite(str(c3vd / f"{i:04d}_color.png"), np.full((108, 135, 3), 90, np.uint8))
    (c3vd / "pose.txt").write_text(("1,0,0,0,0,1,0,0,0,0,1,0,1,2,3,1\n") * 2)
    return (c3vd,)


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (_nothing, r"absent\.mp4: no such file or folder"),
        (_empty_folder, "there is no image"),
        (_no_video, r"reading the video .*notes\.mp4"),
        (_text, r"notes\.txt: it is a text file, not a video"),
        (_one_frame, "1 frame.* two are needed"),
        (_black_images, "no frame of .* could be used"),
        (_wrong_calibration, r"is for 640x480 px, but the images are 160x128 px"),
        (_image_without_pose, r"0002_color\.png has no line in pose\.txt"),
    ],
)
def test_bad_input_is_one_line(
    scopemap: Say, make: Callable[[Path], tuple[object, ...]], pattern: str, tmp_path: Path
) -> None:
    _refused(scopemap("run", *make(tmp_path), "--out", tmp_path / "out", "--quiet"), pattern)


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        (("--set", "tracking.hubber=2"), "unknown setting 'tracking.hubber': did you mean 'tracking.advanced.huber'"),
        (("--set", "tracking"), "expected KEY=VALUE"),
        (("--set", "tracking.advanced.huber=-1"), r"'tracking\.advanced\.huber'.*greater than 0.*got -1"),
        (("--frames", "3"), "expected START:STOP"),
        (("--frames", "0:9:0"), "step must be positive"),
        (("--frames", "50:60"), "0 frame.* two are needed"),
        (("--size", "80"), "expected WIDTHxHEIGHT"),
        (("--size", "8x8"), "too small"),
        (("--near-far", "10"), "expected NEAR:FAR"),
        (("--near-far", "80:10"), "nearest must be positive and smaller"),
        (("--depth", "sonar"), "unknown depth 'sonar'"),
        (("--depth", "files:/nowhere"), "/nowhere is no folder"),
        (("--flow", "farneback"), "unknown flow 'farneback': choose one of dis"),
        (("--dataset", "endomopper"), "unknown data set 'endomopper': choose one of"),
        (("--dataset", "video"), "it is a folder"),
        (("--camera", "/nowhere.yaml"), "cannot read the calibration"),
        (("--config", "/nowhere.toml"), "cannot read the settings"),
    ],
)
def test_a_bad_option_is_one_line(
    scopemap: Say, arguments: tuple[str, ...], pattern: str, images: Path, tmp_path: Path
) -> None:
    _refused(scopemap("run", images, "--out", tmp_path / "out", "--quiet", *arguments), pattern)
    assert not (tmp_path / "out" / "trajectory.tum").exists()


def test_missing_weights_are_one_line(
    scopemap: Say, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCOPEMAP_WEIGHTS_DIR", str(tmp_path / "none"))
    said = scopemap("run", images, "--out", tmp_path / "out", "--preset", "paper", "--quiet")
    _refused(said, "scopemap models pull")


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("run", "somewhere"),
        ("run", "somewhere", "--out", "x", "--preset", "fast"),
        ("run", "somewhere", "--out", "x", "--fov", "500"),
        ("run", "somewhere", "--out", "x", "--wrong"),
        ("evaluate", "somewhere"),
        ("phantom",),
        ("models", "burn"),
        ("frobnicate",),
    ],
)
def test_wrong_usage_is_code_2(scopemap: Say, arguments: tuple[str, ...]) -> None:
    said = scopemap(*arguments)
    assert said.code == 2
    assert "Usage: scopemap" in said.err


def test_other_commands_refuse_in_one_line_too(scopemap: Say, tmp_path: Path) -> None:
    _refused(scopemap("evaluate", tmp_path / "no", "--truth", tmp_path / "no"), "no")
    _refused(scopemap("phantom", tmp_path / "p", "--size", "wide"), "expected WIDTHxHEIGHT")
    _refused(scopemap("models", "verify", "no-such-model"), "no-such-model")


def test_interruption_is_code_130(scopemap: Say, images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("scopemap.runner.with_report.reconstruct", interrupt)
    said = scopemap("run", images, "--out", tmp_path / "out")
    assert said.code == 130
    assert "Traceback" not in said.err


def test_a_bug_keeps_its_traceback(images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("scopemap.runner.with_report.reconstruct", break_down)
    monkeypatch.setattr(sys, "argv", ["scopemap", "run", str(images), "--out", str(tmp_path / "out")])
    with pytest.raises(ZeroDivisionError, match="a bug"):
        main()


# ---- help


@pytest.mark.parametrize("command", OPTIONS)
def test_help_names_the_options(scopemap: Say, command: str) -> None:
    said = scopemap(*command.split(), "--help")
    assert said.code == 0
    named = set(re.findall(r"--[a-z][a-z-]*", said.out))
    assert set(OPTIONS[command].split()) <= named


def test_help_names_the_commands_and_version_the_version(scopemap: Say) -> None:
    said = scopemap("--help")
    assert {command.split()[0] for command in OPTIONS} <= set(re.findall(r"[a-z]+", said.out))
    assert scopemap("--version").out == f"scopemap {__version__}\n"


def test_evaluate_takes_what_run_wrote(scopemap: Say, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert scopemap("run", folder, "--out", out, "--depth", f"files:{folder}", "--quiet").code == 0
    figures = scopemap("evaluate", out, "--truth", folder, "--align", "origin", "--json").json
    assert (figures["frames"], figures["tracked"]) == (FRAMES, FRAMES)
    assert figures["ate_rmse_mm"] < 0.5
    assert figures["tlr"] == pytest.approx(1.0, abs=0.2)


def test_python_m_scopemap_is_the_same_command() -> None:
    command = [sys.executable, "-m", "scopemap", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, f"scopemap {__version__}")
