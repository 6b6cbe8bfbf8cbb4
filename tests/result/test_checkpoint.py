"""The checkpoint of a run: a record comes back as it was put in, whole or not at all, and often enough."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scopemap.engine.errors import InputError
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.masking.overlays import OverlayFinder
from scopemap.result.checkpoint import (
    CHECKPOINT,
    discard_checkpoint,
    has_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from scopemap.runner.checkpoints import Checkpoints


def test_a_record_comes_back_as_it_was_put_in(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path) == {}
    lit = np.arange(12).reshape(3, 4) % 2 == 0
    record = {"last": 7, "share": float("nan"), "said": [["code", {"x": 1.5}], "text"], "none": None, "empty": {}}
    write_checkpoint(tmp_path, record | {"stages": {"one": {"lit": lit, "count": np.int64(3)}, "two": {"lit": ~lit}}})
    found = read_checkpoint(tmp_path)
    stages, share = found.pop("stages"), found.pop("share")
    assert found == {name: value for name, value in record.items() if name != "share"}
    assert np.isnan(share)
    assert stages["one"]["count"] == 3
    np.testing.assert_array_equal(stages["one"]["lit"], lit)
    np.testing.assert_array_equal(stages["two"]["lit"], ~lit)
    discard_checkpoint(tmp_path)
    assert not has_checkpoint(tmp_path)


def test_one_that_cannot_be_written_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_checkpoint(tmp_path, {"last": 1})

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("scopemap.result.checkpoint.np.savez", full)
    with pytest.raises(InputError, match=r"cannot write the checkpoint .*: No space left"):
        write_checkpoint(tmp_path, {"last": 2})
    assert read_checkpoint(tmp_path) == {"last": 1}


def test_one_of_another_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scopemap.result.checkpoint._VERSION", 0)
    write_checkpoint(tmp_path, {"last": 1})
    monkeypatch.undo()
    with pytest.raises(InputError, match="is of another version"):
        read_checkpoint(tmp_path)
    (tmp_path / CHECKPOINT).write_bytes(b"no archive")
    with pytest.raises(InputError, match="is damaged"):
        read_checkpoint(tmp_path)


def _pictures(count: int) -> list[np.ndarray]:
    """Noise that moves behind a white box that stays."""
    noise = np.random.default_rng(1).integers(60, 200, (120, 160 + 4 * count), np.uint8)
    noise = np.kron(noise[::4, ::4], np.ones((4, 4), np.uint8))
    pictures = [np.repeat(noise[:, 4 * n : 4 * n + 160, None], 3, axis=2) for n in range(count)]
    for picture in pictures:
        picture[20:40, 20:60] = 250
    return pictures


def test_overlays_are_found_alike_by_what_was_learnt(tmp_path: Path) -> None:
    field, before, after = np.ones((120, 160), bool), OverlayFinder(), OverlayFinder()
    pictures = _pictures(60)
    for picture in pictures[:40]:
        before(picture, field)
    write_checkpoint(tmp_path, before.record())
    after.resume(read_checkpoint(tmp_path))
    found = [[finder(picture, field) for picture in pictures[40:]] for finder in (before, after)]
    assert any(mask is not None for mask in found[0])
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("writing_s", "between_s"), [(0.01, 10), (0.5, 25), (3.0, 57), (30.0, 30)])
def test_a_fiftieth_of_the_time_is_written_and_a_minute_is_lost_at_most(
    writing_s: float, between_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1000.0]

    def write(unfinished: Path, record: dict[str, Any]) -> None:
        now[0] += writing_s

    monkeypatch.setattr("scopemap.runner.checkpoints.time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr("scopemap.runner.checkpoints.write_checkpoint", write)
    run = SimpleNamespace(pipeline=SimpleNamespace(fusion=SimpleNamespace(store=FrameStore())))
    states, begun = Checkpoints(tmp_path, {}, run), []  # type: ignore[arg-type]
    while len(begun) < 4:
        now[0] += 0.25
        if states.due():
            begun.append(now[0])
            states.commit(1)
    assert np.diff(begun) == pytest.approx([between_s] * 3, abs=0.8)
    assert np.diff(begun).max() + writing_s <= 60.3
