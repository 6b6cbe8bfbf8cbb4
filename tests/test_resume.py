"""A run that was killed goes on where it was, and ends in the same bytes as one that nothing disturbed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from front_door import call, refused, warned
from tiny_phantom import FRAMES, write_tiny

from scopemap import Config, Result, open_sequence, reconstruct
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.engine.kept import Kept
from scopemap.engine.odometry import Step
from scopemap.engine.tracking.track import FrameTracker, KeyframeDecision, Track
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.checkpoint import CHECKPOINT, SavedState
from scopemap.result.result_folder import LOCK, UNFINISHED
from scopemap.runner.checkpoints import can_resume, check_resumable, discard_unfinished, identity_of
from scopemap.runner.observers import RunStopped

pytestmark = pytest.mark.slow

# Seconds, and sums of files that hold some.
_OF_ITS_TIME = {"provenance.json", "SHA256SUMS"}


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
    return reconstruct(open_sequence(folder), Config.load(preset), out=out, **options)


def _bytes(out: Path) -> dict[str, bytes]:
    files = [file for file in out.rglob("*") if file.is_file() and file.name not in _OF_ITS_TIME]
    return {str(file.relative_to(out)): file.read_bytes() for file in files}


def _killing(at: int) -> Callable[[Step], None]:
    def kill(step: Step) -> None:
        if step.frame.index >= at:
            raise _Killed

    return kill


def _kill(folder: Path, out: Path, preset: str, at: int, **options: Any) -> None:
    with pytest.raises(_Killed):
        _run(folder, out, preset, observers=(_killing(at),), **options)


def test_a_killed_run_goes_on_to_the_same_bytes(folder: Path, whole: tuple[str, Path], tmp_path: Path) -> None:
    preset, wanted = whole
    out = tmp_path / "run"
    for at in (3, 5, FRAMES - 1):
        _kill(folder, out, preset, at)
    assert [path.name for path in out.iterdir()] == [UNFINISHED]
    seen: list[int] = []
    result = _run(folder, out, preset, observers=(lambda step: seen.append(step.frame.index),))
    after = result.provenance["resumed_after_frame"]
    assert after >= 1
    assert seen == list(range(after + 1, FRAMES))
    assert _bytes(out) == _bytes(wanted)


def test_a_stopped_run_keeps_every_frame_and_goes_on_to_the_same_bytes(
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
    _run(folder, out, preset, observers=(stop_in_the_middle,))
    assert tracked == list(range(FRAMES)), "no frame is tracked twice"
    assert _bytes(out) == _bytes(wanted)


@pytest.mark.parametrize("doing", ["adjusting keyframes", "fusing", "writing"])
def test_a_run_killed_after_the_last_frame_tracks_none_again(
    doing: str, folder: Path, whole: tuple[str, Path], tmp_path: Path
) -> None:
    preset, wanted = whole
    out = tmp_path / "run"

    def kill(stage: str, done: int, total: int) -> None:
        if stage == doing and done in (0, 2):
            raise _Killed

    with pytest.raises(_Killed):
        _run(folder, out, preset, progress=kill)
    seen: list[Step] = []
    _run(folder, out, preset, observers=(seen.append,))
    assert not seen
    assert _bytes(out) == _bytes(wanted)


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
    # Of a checkpoint that the kill cut off there may be other arrays.
    state = (out / UNFINISHED / CHECKPOINT / "state.json").read_text()
    files = [file for file in sorted((out / UNFINISHED / CHECKPOINT).iterdir()) if file.name in state]
    files.append(out / UNFINISHED / CHECKPOINT / "state.json")
    assert can_resume(out / UNFINISHED, identity, found)
    for file in (files[-1], *files[:-1:20]):
        content = file.read_bytes()
        for at in (0, len(content) // 2, len(content) - 3):
            _flip(file, at)
            assert not can_resume(out / UNFINISHED, identity, found), (file, at)
            assert f"{CHECKPOINT} is damaged: {file.name}" in found[-1]
            file.write_bytes(content)
        file.unlink()
        assert file == files[-1] or not can_resume(out / UNFINISHED, identity, found)
        file.write_bytes(content)
    _flip(files[-1], 0)
    with pytest.raises(InputError, match=r"is damaged: state.json .*; --no-resume begins a new one"):
        check_resumable(out, open_sequence(folder), Config())


def test_numpy_and_json_open_a_checkpoint(folder: Path, killed: Path) -> None:
    place = killed / UNFINISHED / CHECKPOINT
    document = json.loads((place / "state.json").read_text())
    last, state = document["facts"]["last"], document["state"]
    assert {"preprocess", "match", "track", "fusion", "run"} <= state.keys()
    assert state["track"]["_last_track"]["index"] == state["run"]["frames"]["last_index"] == last
    keyframe = state["track"]["_tracker"]["_keyframe"]["frame"]
    (name,) = keyframe["rgb"]["npy"]
    camera = keyframe["camera"]
    rgb = np.load(place / name)
    assert (rgb.dtype, rgb.shape) == (np.uint8, (camera["height"], camera["width"], 3))
    tracked = state["track"]["mapper"]["_backend"]["_tracked"]
    poses = [np.reshape(one["T_world_camera"]["values"], one["T_world_camera"]["shape"]) for one in tracked]
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-12)


def test_a_flipped_byte_of_any_stored_file_is_noticed(folder: Path, killed: Path, tmp_path: Path) -> None:
    identity = identity_of(open_sequence(folder), Config())
    sizes = {facts["name"]: facts["size"] for facts in SavedState(killed / UNFINISHED).check()}
    assert {"frames", "frame_entries", "frame_table", "frame_texts", "tracked_poses"} <= sizes.keys()
    for name, size in sizes.items():
        out = shutil.copytree(killed, tmp_path / name)
        file, found = out / UNFINISHED / "stored_frames" / name, list[str]()
        with file.open("ab") as stream:
            stream.write(b"put in after the checkpoint")
        assert can_resume(out / UNFINISHED, identity, found)
        if size:
            for at in (0, size // 2, size - 1):
                _flip(file, at)
                assert not can_resume(out / UNFINISHED, identity, found), (name, at)
                _flip(file, at)
            assert f"the stored frames {file} are damaged" in found[0]
            file.unlink()
            assert not can_resume(out / UNFINISHED, identity, found), name


@pytest.mark.parametrize("name", ["stored_frames/frames", f"{CHECKPOINT}/state.json"])
def test_a_run_with_a_damaged_checkpoint_begins_anew_and_says_so(
    name: str, folder: Path, killed: Path, whole: tuple[str, Path], tmp_path: Path
) -> None:
    preset, wanted = whole
    if preset != "default":
        pytest.skip("the killed run is of the default preset")
    out, seen, told = shutil.copytree(killed, tmp_path / "run"), list[int](), list[str]()
    file = out / UNFINISHED / name
    if name.startswith(CHECKPOINT):
        file.write_bytes(file.read_bytes()[:3000])
    else:
        _flip(file, 5000)
    result = _run(
        *(folder, out, preset),
        observers=(lambda step: seen.append(step.frame.index),),
        progress=lambda doing, done, total: told.append(doing),
    )
    assert seen == list(range(FRAMES))
    assert _bytes(out) == _bytes(wanted)
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
    left = {CHECKPOINT, LOCK, "stored_frames", UNFINISHED, "replaced", "moving"}
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


class _Keeping(_Counting):
    seen: Kept[int] = 0


@pytest.mark.parametrize("kind", [_Counting, _Keeping])
def test_a_tracker_of_ones_own_goes_on_by_what_it_keeps(kind: type[_Counting], folder: Path, tmp_path: Path) -> None:
    wanted = _run(folder, tmp_path / "whole", "realtime", tracker=kind())
    _kill(folder, tmp_path / "run", "realtime", 5, tracker=kind())
    found = _run(folder, tmp_path / "run", "realtime", tracker=kind())
    assert (found.provenance["resumed_after_frame"] is not None) == (kind is _Keeping)
    np.testing.assert_array_equal(found.frames["T_world_camera"], wanted.frames["T_world_camera"])


def test_the_command_resumes_and_reports_it(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    _kill(folder, out, "realtime", 4)
    ask = ("run", folder, "--out", out, "--preset", "realtime", "--resume")
    assert "input.fps was not set, and is 3.0" in refused(capfd, *ask, "--fps", "3")
    assert call(*ask) == 0
    said = capfd.readouterr()
    assert "resuming after" in said.err
    assert "s since it was resumed after frame " in said.out
