"""A frame with which a stage fails is lost, with the reason; the run goes on, unless many fail."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scopemap import open_sequence, reconstruct
from scopemap.engine.config import Config
from scopemap.engine.depth.estimate import DepthEstimate
from scopemap.engine.depth.mapis import DenseMatcher
from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth
from scopemap.engine.frame import Frame
from scopemap.engine.masking.masker import Masker
from scopemap.engine.tracking.tracker import Tracker
from scopemap.input.depth_files import FilesDepth
from scopemap.input.images import ImageFolder
from scopemap.input.source import Source
from tests.support.front_door import warned
from tests.support.result_files import frame_rows
from tests.support.tiny_phantom import FRAMES, with_true_depth, write_tiny

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("phantom"))


def _break(patch: pytest.MonkeyPatch, kind: type, name: str, calls: set[int], error: BaseException) -> None:
    """Have a method fail at some of its calls, counted from 0."""
    method: Callable[..., Any] = getattr(kind, name)
    count = iter(range(1000))

    def failing(*arguments: Any, **named: Any) -> Any:
        if next(count) in calls:
            raise error
        return method(*arguments, **named)

    patch.setattr(kind, name, failing)


def _lost(out: Path) -> dict[int, str]:
    """The reasons by the numbers of the frames that a result calls lost."""
    return {int(row["index"]): row["reason"] for row in frame_rows(out) if row["status"] == "lost"}


@pytest.mark.parametrize(
    ("kind", "name", "reason"),
    [
        (Masker, "__call__", "depth failed: it broke"),
        (Tracker, "track", "tracking failed: it broke"),
    ],
)
def test_a_frame_with_which_a_stage_fails_is_lost_with_the_reason(
    kind: type, name: str, reason: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _break(monkeypatch, kind, name, {4}, np.linalg.LinAlgError("it\nbroke"))
    result = reconstruct(open_sequence(folder), with_true_depth(folder), out=tmp_path / "out")
    assert _lost(tmp_path / "out") == {4: reason}
    assert warned(result.provenance)[0] == f"Processing failed in 1 frame, first in frame 4: {reason}."
    assert len(result.mesh.faces) > 100


@pytest.mark.parametrize("at", [0, FRAMES - 1])
def test_the_first_and_the_last_frame_may_fail(
    at: int, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _break(monkeypatch, FilesDepth, "estimate", {at}, RuntimeError("it broke"))
    reconstruct(open_sequence(folder), with_true_depth(folder), out=tmp_path / "out")
    assert _lost(tmp_path / "out") == {at: "depth failed: it broke"}


def test_a_frame_without_flow_to_the_one_before_is_still_tracked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _break(monkeypatch, DenseMatcher, "match", {4}, RuntimeError("it broke"))
    result = reconstruct(open_sequence(folder), Config())
    assert result.provenance["tracked"] == FRAMES
    assert "frame 4: flow failed: it broke" in warned(result.provenance)[0]


def test_where_many_frames_fail_the_run_ends_with_the_reason(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _break(monkeypatch, Tracker, "track", set(range(2, 99)), RuntimeError("it broke"))
    with pytest.raises(RuntimeError, match="it broke") as caught:
        reconstruct(open_sequence(folder), with_true_depth(folder), out=tmp_path / "out")
    assert "the run ends at frame 5: 4 frames failed, first frame 2, " in caught.value.__notes__[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", [-np.inf, 0.0])
def test_depth_that_is_no_number_is_unknown_and_told(
    value: float, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate = ScopeNetDepth.estimate

    def spoilt(self: ScopeNetDepth, frame: Frame) -> DepthEstimate:
        found = estimate(self, frame)
        return replace(found, values=np.full_like(found.values, value)) if frame.index == 4 else found

    monkeypatch.setattr(ScopeNetDepth, "estimate", spoilt)
    result = reconstruct(open_sequence(folder), Config())
    assert result.provenance["tracked"] == FRAMES
    assert np.isfinite(result.mesh.vertices).all()
    told = "The network returned no depth for 1 frame, first for frame 4."
    assert (told in warned(result.provenance)) == (value != 0)


def _hang_at(name: str, patch: pytest.MonkeyPatch) -> threading.Event:
    """Have reading one image take until the event is set; the limit is seconds then."""
    read, gate = ImageFolder._image, threading.Event()

    def hanging(self: ImageFolder, file: Path) -> np.ndarray | None:
        if file.name == name:
            gate.wait(60)
        return read(self, file)

    patch.setattr(ImageFolder, "_image", hanging)
    patch.setattr(Source, "frame_limit_s", 2.0)
    return gate


def test_a_reader_that_hangs_ends_the_frames_and_what_was_tracked_is_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence, started = open_sequence(folder), time.monotonic()
    gate = _hang_at("0006_color.png", monkeypatch)
    try:
        result = reconstruct(sequence, with_true_depth(folder))
    finally:
        gate.set()
    assert time.monotonic() - started < 50
    assert result.trajectory.indices[result.trajectory.tracked].tolist() == [*range(6)]
    (warning,) = [warning for warning in warned(result.provenance) if "hangs" in warning]
    late = "its picture after frame 5 did not come within 3 s: a decoder or a disk hangs; the frames until then"
    assert warning == f"{folder}: {late} were used."
    assert len(result.mesh.faces) > 100
