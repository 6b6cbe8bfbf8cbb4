"""What can be seen of a run while it goes on: it grows, and moves; the result is the same without it."""

from __future__ import annotations

import hashlib
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from scopemap.apps.browser.run_page import RunPage
from scopemap.engine.config import Config
from scopemap.engine.frame import Frame
from scopemap.engine.odometry import Step
from scopemap.input.opening import open_sequence
from scopemap.result.result import Result
from scopemap.result.result_folder import UNFINISHED
from scopemap.result.run_view import (
    RunProgress,
    SeenMap,
    look,
    read_map,
    read_pictures,
    read_progress,
    view_folder,
    write_progress,
)
from scopemap.runner import watched
from scopemap.runner.observers import RunStopped
from scopemap.runner.reconstruct import reconstruct
from scopemap.runner.watched import RunWatch
from tests.support.shown_window import shown_window
from tests.support.tiny_phantom import FRAMES, SIZE, only_images, with_true_depth, write_tiny

pytestmark = pytest.mark.slow

TIMED = {"provenance.json", "SHA256SUMS"}


class Looking(RunWatch):
    """Writes at once after each step and each final frame, and looks at what is there."""

    def __init__(self, out: Path, total: int) -> None:
        super().__init__(out, total)
        self.folder = view_folder(out)
        self.reported: list[RunProgress] = []
        self.maps: list[SeenMap] = []
        self.pictures: list[tuple[bytes, bytes]] = []

    def __call__(self, step: Step) -> None:
        super().__call__(step)
        self._see()

    def final(self, frame: Frame) -> None:
        super().final(frame)
        self._see()

    def _see(self) -> None:
        self.folder.mkdir(exist_ok=True)
        look(self.folder)
        self._write()
        for found, seen in (
            (self.reported, read_progress(self.folder)),
            (self.maps, read_map(self.folder)),
            (self.pictures, read_pictures(self.folder)),
        ):
            assert seen is not None
            found.append(seen)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom") / "clip")


@pytest.fixture(scope="module")
def settings(phantom: Path) -> Config:
    return with_true_depth(phantom, tracking__keyframe_every=2)


@pytest.fixture(scope="module")
def looked(phantom: Path, settings: Config, tmp_path_factory: pytest.TempPathFactory) -> tuple[Looking, Path]:
    out, patch = tmp_path_factory.mktemp("run") / "out", pytest.MonkeyPatch()
    patch.setattr(watched, "_POINTS_EVERY_S", 0.0)
    patch.setattr(watched, "_DRAWN_EVERY_S", 0.0)
    watch = Looking(out, FRAMES)
    reconstruct(open_sequence(phantom), settings, out=out, observers=(watch,), progress=watch.progress)
    patch.undo()
    return watch, out


def test_the_path_and_the_points_grow(looked: tuple[Looking, Path]) -> None:
    watch, _ = looked
    tracking = [seen for seen, progress in zip(watch.maps, watch.reported, strict=True) if progress.doing == "tracking"]
    assert [len(seen.index) for seen in tracking] == list(range(1, FRAMES + 1))
    sizes = [len(seen.points) for seen in tracking]
    assert sizes == sorted(sizes)
    assert sizes[-1] > 3 * sizes[0] > 0
    assert all(len(seen.points) == len(seen.colours) for seen in watch.maps)
    assert tracking[-1].keyframe.sum() >= 2
    assert tracking[-1].aspect == SIZE[0] / SIZE[1]


def test_points_are_where_the_frame_saw_them(looked: tuple[Looking, Path], phantom: Path) -> None:
    watch, _ = looked
    camera, first = open_sequence(phantom).camera, watch.maps[0]
    pixels = camera.project(first.points.astype(float))
    assert ((pixels > -1) & (pixels < np.array(SIZE))).all()
    assert np.abs(pixels - np.round(pixels)).max() < 1e-2


def test_after_the_adjustment_the_frames_are_final(looked: tuple[Looking, Path], settings: Config) -> None:
    watch, out = looked
    final = [(progress, seen) for progress, seen in zip(watch.reported, watch.maps, strict=True) if progress.adjusted]
    assert len(final) == FRAMES
    progress, seen = final[-1]
    assert progress.doing != "tracking"
    np.testing.assert_allclose(seen.T_world_camera, Result(out).trajectory.T_world_camera, atol=1e-4)


def test_the_state_tells_how_far_it_is(looked: tuple[Looking, Path]) -> None:
    reported = looked[0].reported
    assert [progress.done for progress in reported[:FRAMES]] == list(range(1, FRAMES + 1))
    assert {progress.total for progress in reported[:FRAMES]} == {FRAMES}
    assert reported[0].status == "initial"
    assert {progress.status for progress in reported[1:FRAMES]} == {"ok"}


def test_pictures_are_those_of_the_frame(looked: tuple[Looking, Path]) -> None:
    for content in looked[0].pictures[-1]:
        shown = np.asarray(Image.open(io.BytesIO(content)))
        assert shown.shape == (SIZE[1], SIZE[0], 3)
        assert shown.std() > 5


def test_nothing_of_it_is_in_the_result(
    looked: tuple[Looking, Path], phantom: Path, settings: Config, tmp_path: Path
) -> None:
    _, out = looked
    assert not (out / UNFINISHED).exists()
    reconstruct(open_sequence(phantom), settings, out=tmp_path / "out")
    assert _contents(out) == _contents(tmp_path / "out")


def test_what_was_seen_goes_on_with_a_run_that_was_stopped(phantom: Path, settings: Config, tmp_path: Path) -> None:
    out, counts = tmp_path / "out", list[tuple[int, int]]()

    def run(stop_at: int) -> None:
        watch = RunWatch(out, FRAMES)

        def note(step: Step) -> None:
            progress = watch.so_far()
            counts.append((progress.frames, progress.points))
            if step.frame.index == stop_at:
                raise RunStopped

        reconstruct(open_sequence(phantom), settings, out=out, observers=(watch, note))

    with pytest.raises(RunStopped):
        run(1)
    run(FRAMES)
    assert [frames for frames, _ in counts] == list(range(1, FRAMES + 1))
    points = [points for _, points in counts]
    assert points == sorted(points)
    assert points[-1] > points[0] > 0


def test_where_nobody_looks_nothing_is_drawn(phantom: Path, settings: Config, tmp_path: Path) -> None:
    out, seen = tmp_path / "out", list[tuple[set[str], RunProgress]]()

    def note(step: Step) -> None:
        watch._write()
        progress = read_progress(view_folder(out))
        assert progress is not None
        seen.append(({file.name for file in view_folder(out).iterdir()}, progress))
        if step.frame.index == FRAMES - 3:
            look(view_folder(out))

    watch = RunWatch(out, FRAMES)
    reconstruct(open_sequence(phantom), settings, out=out, observers=(watch, note))
    assert [names for names, _ in seen[:-2]] == [{"progress.json"}] * (FRAMES - 2)
    assert {"picture.jpg", "depth.jpg", "map.npz"} <= seen[-2][0]
    assert [progress.frames for _, progress in seen] == list(range(1, FRAMES + 1))


def test_a_folder_that_takes_nothing_does_not_end_the_run(
    phantom: Path, settings: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for name in ("write_progress", "write_pictures", "write_map"):
        monkeypatch.setattr(watched, name, full)
    with RunWatch(tmp_path / "out", FRAMES) as watch:
        result = reconstruct(open_sequence(phantom), settings, out=tmp_path / "out", observers=(watch,))
    assert result.frames.tracked.sum() == FRAMES


@pytest.mark.parametrize("content", [b"", b"[1]", b"{", b'{"done": 1, "unknown": 2}', b"\xff\xfe"])
def test_what_is_half_written_or_foreign_is_nothing_to_see(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "progress.json").write_bytes(content)
    (tmp_path / "map.npz").write_bytes(content)
    progress = read_progress(tmp_path)
    assert progress is None or progress == RunProgress(done=1)
    assert read_map(tmp_path) is None
    assert read_pictures(tmp_path) is None


@pytest.mark.slow
def test_a_run_in_a_terminal_can_be_watched_and_killed(phantom: Path, tmp_path: Path) -> None:
    """What a killed run leaves is taken again; what could be seen of it goes."""
    frames, out = only_images(phantom, tmp_path / "frames"), tmp_path / "out"
    command = [sys.executable, "-m", "scopemap", "run", str(frames), "--out", str(out), "--watched", "--quiet"]
    killed = subprocess.Popen(command, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    while killed.poll() is None and read_progress(view_folder(out)) is None:
        pass
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert subprocess.run(command, check=True).returncode == 0
    assert not (out / UNFINISHED).exists()
    assert (out / "report.html").is_file()


def _contents(out: Path) -> dict[str, str]:
    files = [file for file in sorted(out.rglob("*")) if file.is_file() and file.name not in TIMED]
    return {str(file.relative_to(out)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def test_the_window_says_how_long_each_phase_after_tracking_takes(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'scopemap[app]'")
    folder, run = view_folder(tmp_path), SimpleNamespace(status="running", printed="", poll=lambda: None)
    folder.mkdir(parents=True)
    watch = RunWatch(tmp_path, 3)
    step = SimpleNamespace(
        frame=SimpleNamespace(T_world_camera=None, index=0, time_s=0.0),
        track=SimpleNamespace(status="lost", reason="dark", map=0),
    )
    for _ in range(3):
        watch(step)  # type: ignore[arg-type]
        time.sleep(0.02)
    with shown_window() as shown:
        page = RunPage(run, folder, "run", lambda: None)  # type: ignore[arg-type]
        for phase in ("adjusting keyframes", "fusing", "texturing", "writing"):
            watch.progress(phase, *((1, 100) if phase == "fusing" else (0, 0)))
            write_progress(folder, watch.so_far())
            if phase == "adjusting keyframes":
                shown.show(page)
            page.tick()
            count = " 1 of 100 frames" if phase == "fusing" else ""
            assert re.search(rf"{phase}{count}, (about|at least) \d+ s left", shown.words)
        # The result is in its place then, and what can be seen of the run is gone.
        shutil.rmtree(folder)
        run.printed = "fusing frame 100 of 100\nwriting the report: about 2 s left\n"
        page.tick()
        assert "writing the report: about 2 s left" in shown.words
