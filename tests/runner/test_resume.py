"""A run that was killed goes on where it was, and ends in the result of one that nothing disturbed, within noise."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap import Config, Result, open_sequence, reconstruct
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step
from scopemap.engine.tracking.track import FrameTracker, KeyframeDecision, Track
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.checkpoint import CHECKPOINT, CHECKPOINT_NEW, read_checkpoint
from scopemap.result.result_folder import LOCK, STORED, UNFINISHED
from scopemap.runner.checkpoints import can_resume, check_resumable, discard_unfinished, identity_of
from scopemap.runner.observers import RunStopped
from tests.support.alike_runs import check_alike
from tests.support.front_door import call, refused, warned
from tests.support.tiny_phantom import FRAMES, write_tiny

pytestmark = pytest.mark.slow


class _Killed(BaseException):
    """What ends a run at once."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "sound")


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.runner.checkpoints._LEAST_S", 0.0)
    monkeypatch.setattr("scopemap.runner.checkpoints._SHARE", 1.0)


@pytest.fixture(scope="module", params=["default", "realtime"])
def whole(request: pytest.FixtureRequest, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    out = tmp_path_factory.mktemp("whole") / "run"
    _run(folder, out, request.param)
    return request.param, out


def _run(folder: Path, out: Path, preset: Any, **options: Any) -> Result:
    config = preset if isinstance(preset, Config) else Config.load(preset)
    return reconstruct(open_sequence(folder), config, out=out, **options)


def _killing(at: int) -> Callable[[Step], None]:
    def kill(step: Step) -> None:
        if step.frame.index >= at:
            raise _Killed

    return kill


def _kill(folder: Path, out: Path, preset: Any, at: int, **options: Any) -> None:
    with pytest.raises(_Killed):
        _run(folder, out, preset, observers=(_killing(at),), **options)


# What a process runs until it kills itself: as it tracks a frame, or as it says what it does.
_SUICIDE = """
import os, signal, sys
import scopemap.runner.checkpoints
from scopemap import Config, open_sequence, reconstruct

scopemap.runner.checkpoints._LEAST_S, scopemap.runner.checkpoints._SHARE = 0.0, 1.0
folder, out, preset, stage = sys.argv[1:]

def kill(doing, done=0, total=0):
    if doing == stage and done in (0, 2):
        os.kill(os.getpid(), signal.SIGKILL)

observe = lambda step: kill(f"frame {step.frame.index}")
reconstruct(open_sequence(folder), Config.load(preset), out=out, observers=(observe,), progress=kill)
"""


@pytest.mark.parametrize("stage", ["frame 7", "adjusting keyframes", "fusing", "texturing", "writing"])
def test_a_process_killed_at_any_stage_loses_nothing(
    stage: str, folder: Path, whole: tuple[str, Path], tmp_path: Path
) -> None:
    preset, wanted = whole
    out = tmp_path / "run"
    ended = subprocess.run([sys.executable, "-c", _SUICIDE, folder, out, preset, stage], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert [path.name for path in out.iterdir()] == [UNFINISHED]
    seen: list[int] = []
    result = _run(folder, out, preset, observers=(lambda step: seen.append(step.frame.index),))
    after = result.provenance["resumed_after_frame"]
    assert seen == list(range(after + 1, FRAMES))
    if not stage.startswith("frame"):
        assert after == FRAMES - 1, "nothing is tracked again"
    check_alike(result, Result(wanted))


def test_a_run_without_an_adjustment_is_resumed_too(folder: Path, tmp_path: Path) -> None:
    settings = Config.load(settings={"mapping.method": "none", "fusion.voxel_mm": 1.0})
    wanted = _run(folder, tmp_path / "whole", settings)
    for at in (3, 5, FRAMES - 1):
        _kill(folder, tmp_path / "run", settings, at)
    found = _run(folder, tmp_path / "run", settings)
    assert found.provenance["resumed_after_frame"] >= 1
    assert len(list((tmp_path / "run" / "depth").glob("*.png"))) == FRAMES
    check_alike(found, wanted)


@pytest.mark.parametrize("changes", [{}, {"tracking.camera_at_rest": True}, {"depth.backend": "shading"}])
def test_losses_and_maps_are_as_without_a_kill(changes: dict[str, Any], tmp_path: Path) -> None:
    folder = write_tiny(tmp_path / "phantom", "black:4-5,cut:8-11", frames=13)
    settings = Config.load(settings={"tracking.keyframe_every": 2} | changes)
    wanted = _run(folder, tmp_path / "whole", settings, observers=(FramePictures(),))
    for at in (6, 10):  # just after a loss, and after a cut
        _kill(folder, tmp_path / "run", settings, at)
    found = _run(folder, tmp_path / "run", settings, observers=(FramePictures(),))
    assert found.provenance["resumed_after_frame"] >= 5
    codes = [{notice["code"] for notice in result.provenance["notices"]} for result in (found, wanted)]
    assert codes[0] == codes[1]
    check_alike(found, wanted)


def test_a_stopped_run_keeps_every_frame_and_goes_on(
    folder: Path, whole: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    preset, wanted = whole
    out, tracked = tmp_path / "run", list[int]()
    # Not often: what is kept is the state at the stop.
    monkeypatch.setattr("scopemap.runner.checkpoints._LEAST_S", 1000.0)

    def stop_in_the_middle(step: Step) -> None:
        tracked.append(step.frame.index)
        if len(tracked) in (3, FRAMES):
            raise RunStopped

    for _ in range(2):
        with pytest.raises(RunStopped):
            _run(folder, out, preset, observers=(stop_in_the_middle,))
        assert [path.name for path in out.iterdir()] == [UNFINISHED]
    result = _run(folder, out, preset, observers=(stop_in_the_middle,))
    assert tracked == list(range(FRAMES)), "no frame is tracked twice"
    check_alike(result, Result(wanted))


def test_other_settings_begin_anew_or_are_refused_by_name(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    _kill(folder, out, "realtime", 4)
    other = Config.load("realtime", settings={"fusion.voxel_mm": 2.5})
    with pytest.raises(InputError, match=r"cannot resume .* fusion\.voxel_mm was not set, and is 2\.5; --no-resume"):
        check_resumable(out, open_sequence(folder), other)
    # The refusal has left what there was.
    check_resumable(out, open_sequence(folder), Config.load("realtime"))
    seen: list[Step] = []
    _run(folder, out, "realtime", observers=(seen.append,))
    assert 0 < len(seen) < FRAMES


def test_another_input_and_no_resume_begin_anew(folder: Path, tmp_path: Path) -> None:
    out, other = tmp_path / "run", write_tiny(tmp_path / "phantom", "black:6-6")
    _kill(folder, out, "realtime", 4)
    with pytest.raises(InputError, match=r"cannot resume .*: the input has changed; --no-resume"):
        check_resumable(out, open_sequence(other), Config.load("realtime"))
    assert _run(other, out, "realtime").provenance["resumed_after_frame"] is None
    _kill(folder, out, "realtime", 4, overwrite=True)
    discard_unfinished(out)
    assert _run(folder, out, "realtime", overwrite=True).provenance["resumed_after_frame"] is None


def test_files_beside_the_input_are_part_of_a_run(folder: Path, tmp_path: Path) -> None:
    sequence, file = open_sequence(folder), tmp_path / "own" / "0001.png"
    file.parent.mkdir()
    for setting in ("mask.files", "depth.model", "depth.anchor_model"):
        config = Config.load(settings={setting: str(file.parent)})
        file.write_bytes(b"one")
        before = identity_of(sequence, config)
        file.write_bytes(b"two")
        changed = {name for name, value in identity_of(sequence, config).items() if before[name] != value}
        assert changed == {f"content of {setting}"}


def test_an_input_that_changes_while_it_is_read_is_told(folder: Path, tmp_path: Path) -> None:
    source = shutil.copytree(folder, tmp_path / "in")

    def grow(step: Step) -> None:
        (source / "0100_color.png").write_bytes((source / "0000_color.png").read_bytes())

    for observers, told in (((), False), ((grow,), True)):
        result = _run(source, tmp_path / "run", "realtime", observers=observers, overwrite=True)
        assert any("changed while it was read" in text for text in warned(result.provenance)) == told
        kept = warned(json.loads((tmp_path / "run" / "provenance.json").read_text()))
        assert kept == warned(result.provenance)


@pytest.fixture(scope="module")
def killed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("killed") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scopemap.runner.checkpoints._LEAST_S", 0.0)
        patch.setattr("scopemap.runner.checkpoints._SHARE", 1.0)
        _kill(folder, out, "default", FRAMES - 1)
    return out


def _flip(file: Path, at: int) -> None:
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)


def test_a_damaged_checkpoint_is_never_resumed_from(folder: Path, killed: Path, tmp_path: Path) -> None:
    identity, out, found = identity_of(open_sequence(folder), Config()), tmp_path / "run", list[str]()
    shutil.copytree(killed, out)
    file = out / UNFINISHED / CHECKPOINT
    content = file.read_bytes()
    assert can_resume(out / UNFINISHED, identity, found)
    for at in (0, *range(1000, len(content), len(content) // 20), len(content) - 3):
        _flip(file, at)
        assert not can_resume(out / UNFINISHED, identity, found), at
        assert f"{CHECKPOINT} is damaged" in found[-1]
        file.write_bytes(content)
    _flip(file, 0)
    with pytest.raises(InputError, match=r"is damaged: .*; --no-resume begins a new one"):
        check_resumable(out, open_sequence(folder), Config())


def test_numpy_and_json_open_a_checkpoint(folder: Path, killed: Path) -> None:
    with np.load(killed / UNFINISHED / CHECKPOINT) as arrays:
        record = json.loads(arrays["record"].tobytes())
        lit = arrays[record["stages"]["preprocess"]["masks"]["lit"]["array"]]
    assert record["version"] == 1
    assert record["last"] >= 1
    assert record["stages"].keys() == {"preprocess", "match", "track"}
    assert (lit.dtype, lit.ndim) == (bool, 2)


def test_a_flipped_byte_of_any_stored_file_is_noticed(folder: Path, killed: Path, tmp_path: Path) -> None:
    identity = identity_of(open_sequence(folder), Config())
    files = read_checkpoint(killed / UNFINISHED)["stored"]["files"]
    sizes = {facts["name"]: facts["size"] for facts in files}
    assert sizes.keys() == {"frames", "frame_entries", "frame_table", "frame_texts", "tracking_log"}
    for name, size in sizes.items():
        out = shutil.copytree(killed, tmp_path / name)
        file, found = out / UNFINISHED / STORED / name, list[str]()
        with file.open("ab") as stream:
            stream.write(b"put in after the checkpoint")
        assert can_resume(out / UNFINISHED, identity, found)
        for at in (0, size // 2, size - 1):
            _flip(file, at)
            assert not can_resume(out / UNFINISHED, identity, found), (name, at)
            _flip(file, at)
        assert f"the stored frames {file} are damaged" in found[0]
        file.unlink()
        assert not can_resume(out / UNFINISHED, identity, found), name


@pytest.mark.parametrize("name", ["stored_frames/frames", CHECKPOINT])
def test_a_run_with_a_damaged_checkpoint_begins_anew_and_says_so(
    name: str, folder: Path, killed: Path, whole: tuple[str, Path], tmp_path: Path
) -> None:
    preset, wanted = whole
    if preset != "default":
        pytest.skip("the killed run is of the default preset")
    out, seen, told = shutil.copytree(killed, tmp_path / "run"), list[int](), list[str]()
    file = out / UNFINISHED / name
    if name == CHECKPOINT:
        file.write_bytes(file.read_bytes()[:3000])
    else:
        _flip(file, 5000)
    result = _run(
        *(folder, out, preset),
        observers=(lambda step: seen.append(step.frame.index),),
        progress=lambda doing, done, total: told.append(doing),
    )
    assert seen == list(range(FRAMES))
    assert (out / "mesh.ply").read_bytes() == (wanted / "mesh.ply").read_bytes()
    (notice,) = [one for one in result.provenance["notices"] if one["code"] == "checkpoint-damaged"]
    assert name.split("/")[-1] in notice["text"]
    assert told[0].startswith("starting again: ")


def test_stored_frames_that_are_damaged_while_a_run_works_end_it(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"

    def damage(step: Step) -> None:
        if step.frame.index == FRAMES - 2:
            _flip(out / UNFINISHED / "stored_frames" / "frames", 5000)

    with pytest.raises(InputError, match="the stored frames are damaged") as caught:
        _run(folder, out, "default", observers=(damage,))
    assert "--no-resume starts again" in caught.value.__notes__[0]
    assert _run(folder, out, "default").provenance["resumed_after_frame"] is None


def test_observers_are_resumed_and_saved_with_the_result(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(_Killed):
        _run(folder, out, "realtime", observers=(FramePictures(), _killing(5)))
    _run(folder, out, "realtime", observers=(FramePictures(),))
    assert len(list((out / "frames").glob("*_mask.png"))) == FRAMES
    assert "frames/measures.csv" in (out / "SHA256SUMS").read_text()
    left = {CHECKPOINT, CHECKPOINT_NEW, LOCK, STORED, UNFINISHED, "replaced", "moving"}
    assert not left & {path.name for path in out.rglob("*")}


class _Counting(FrameTracker):
    """A tracker of one's own, whose poses depend on all frames before."""

    seen: Any = 0

    def track(self, frame: Frame) -> Track:
        self.seen += 1
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = self.seen
        decision = KeyframeDecision("new" if self.seen % 3 == 1 else "none")
        return Track(frame.index, "initial" if self.seen == 1 else "ok", "", T_world_camera, 0, decision=decision)

    def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        return True


class _Resumable(_Counting):
    def replay(self, frame: Frame, track: Track) -> None:
        self.seen += 1


@pytest.mark.parametrize("kind", [_Counting, _Resumable])
def test_a_tracker_of_ones_own_goes_on_where_it_takes_frames_again(
    kind: type[_Counting], folder: Path, tmp_path: Path
) -> None:
    wanted = _run(folder, tmp_path / "whole", "realtime", tracker=kind())
    _kill(folder, tmp_path / "run", "realtime", 5, tracker=kind())
    found = _run(folder, tmp_path / "run", "realtime", tracker=kind())
    assert (found.provenance["resumed_after_frame"] is not None) == (kind is _Resumable)
    np.testing.assert_allclose(found.frames["T_world_camera"], wanted.frames["T_world_camera"], atol=0.05)


def test_the_command_resumes_and_reports_it(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    _kill(folder, out, "realtime", 4)
    ask = ("run", folder, "--out", out, "--preset", "realtime", "--resume")
    assert "input.fps was not set, and is 3.0" in refused(capfd, *ask, "--fps", "3")
    assert call(*ask) == 0
    said = capfd.readouterr()
    assert "resuming after" in said.err
    assert "s since it was resumed after frame " in said.out
