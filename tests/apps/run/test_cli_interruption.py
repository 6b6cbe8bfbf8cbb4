"""Ctrl-C and SIGTERM: the first ends a run with what was tracked, the second at once."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest

from scopemap.engine.frame import Frame
from scopemap.engine.mapping.mapper import Mapper
from scopemap.engine.mapping.segments import Submap
from scopemap.engine.odometry import Step
from scopemap.input.sequence import Sequence
from scopemap.result.trajectories import read_trajectory
from scopemap.terminal.interruption import Interruption
from tests.support.front_door import call
from tests.support.tiny_phantom import FRAMES, write_tiny

pytestmark = pytest.mark.slow

STOPPED = FRAMES - 3


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_signal_stops_and_the_second_ends(number: signal.Signals, code: int) -> None:
    """Before the first frame there is nothing to write: the first one ends it."""
    before = signal.getsignal(number)
    with Interruption(), pytest.raises(SystemExit) as early:
        signal.raise_signal(number)
    with Interruption() as interruption:
        assert not interruption.observe(None)  # type: ignore[arg-type]
        assert interruption.exit_code == 0
        signal.raise_signal(number)
        assert interruption.observe(None)  # type: ignore[arg-type]
        assert interruption.exit_code == code
        with pytest.raises(SystemExit) as caught:
            signal.raise_signal(number)
    assert early.value.code == caught.value.code == code
    assert signal.getsignal(number) is before


def test_an_interrupted_run_writes_what_was_tracked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    every, observe, stopping, out = Sequence.frames, Interruption.observe, Event(), tmp_path / "out"

    def note(self: Interruption, step: Step) -> bool:
        if step.frame.index == STOPPED:
            os.kill(os.getpid(), signal.SIGTERM)
            stopping.set()
        return observe(self, step)

    def frames(self: Sequence, after: int = -1) -> Iterator[Frame]:
        for frame in every(self):
            if frame.index == STOPPED + 1:
                assert stopping.wait(60)
                time.sleep(0.2)  # the runner takes note
            yield frame

    monkeypatch.setattr(Interruption, "observe", note)
    monkeypatch.setattr(Sequence, "frames", frames)
    phantom = write_tiny(tmp_path / "phantom")
    assert call("run", phantom, "--out", out) == 143
    said = capfd.readouterr()
    assert "stopping after this frame" in said.err
    assert f"The run was stopped at frame {STOPPED}" in said.out
    assert f"{STOPPED + 1} of {STOPPED + 1} tracked" in said.out
    assert json.loads((out / "provenance.json").read_text())["interrupted_at_frame"] == STOPPED
    assert len(read_trajectory(out)) == STOPPED + 1
    assert (out / "mesh.ply").is_file()
    assert not (out / ".unfinished").exists()


def test_a_signal_after_the_last_frame_leaves_a_whole_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    submaps, out = Mapper.submaps, tmp_path / "out"

    def signalled(self: Mapper) -> tuple[list[Submap], list[str]]:
        os.kill(os.getpid(), signal.SIGINT)
        return submaps(self)

    monkeypatch.setattr(Mapper, "submaps", signalled)
    assert call("run", write_tiny(tmp_path / "phantom"), "--out", out, "--quiet") == 0
    assert json.loads((out / "provenance.json").read_text())["interrupted_at_frame"] is None
