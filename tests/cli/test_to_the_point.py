"""Options that ask for what is not there: the sentence names what was asked for, and what there is."""

from __future__ import annotations

from pathlib import Path

import onnxruntime
import pytest

from scopemap.engine.config import Config
from scopemap.engine.errors import SettingsError
from tests.support.drawn_clips import clip, write
from tests.support.drawn_inputs import picture, save
from tests.support.front_door import refused


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("clip") / "v.mp4", clip(25, size=(64, 48)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    images = tmp_path_factory.mktemp("images")
    for number in range(25):
        save(images / f"{number:02d}.png", picture(number, (64, 48)))
    return images


@pytest.mark.parametrize("kind", ["video", "folder"])
@pytest.mark.parametrize("frames", ["500:600", "20:10", "24:", "::30"])
def test_frames_that_are_not_there(
    kind: str, frames: str, request: pytest.FixtureRequest, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = request.getfixturevalue(kind)
    said = refused(capfd, "run", source, "--out", tmp_path / "o", "--frames", frames, "--quiet")
    assert f"{source}: " in said
    assert frames in said
    assert "of its 25" in said


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--scope", "x"), "unknown scope 'x': choose one of 'colonoscope', 'gastroscope', 'bronchoscope'"),
        (("--set", "depth.backend=abacus"), "abacus"),
        (("--set", "tracking.foo=1"), "unknown setting 'tracking.foo'"),
        (("--set", "tracking.foo"), "unknown setting 'tracking.foo'"),
        (("--set", "tracking.foo"), "tracking has method, camera_at_rest, keyframe_every"),
        (("--set", "input.scop=colonoscope"), "did you mean 'input.scope'?"),
        (("--set", "tracking.keyframe_every"), "expected KEY=VALUE"),
    ],
)
def test_names_that_are_not_known(
    arguments: tuple[str, ...], expected: str, video: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert expected in refused(capfd, "run", video, "--out", tmp_path / "o", "--quiet", *arguments)


@pytest.mark.parametrize("preset", ["default", "realtime"])
def test_a_device_that_is_not_there(
    preset: str, video: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    said = refused(capfd, "run", video, "--out", tmp_path / "o", "--preset", preset, "--device", "cuda", "--quiet")
    assert "this build of ONNX Runtime has no CUDA: install onnxruntime-gpu" in said


def test_choices_of_python_are_named_too() -> None:
    with pytest.raises(SettingsError, match="unknown colours 'blue': choose one of"):
        Config.load(settings={"fusion.colours": "blue"})
