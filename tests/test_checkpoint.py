"""The checkpoint of a run: what is kept comes back by its declared types, and damage is never taken for whole."""

from __future__ import annotations

import json
from collections import Counter, defaultdict, deque
from dataclasses import dataclass, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plane_scene import frame, pose
from result_files import through_checkpoint

from scopemap.engine.errors import InputError
from scopemap.engine.flow.corners import KeyframeMatcher
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.fusion.tsdf import VoxelBlocks, pack
from scopemap.engine.kept import Kept, kept
from scopemap.engine.tracking.causes import LossCause
from scopemap.result.checkpoint import CHECKPOINT, SavedState
from scopemap.runner.checkpoints import Checkpoints


class _Point(NamedTuple):
    place: tuple[float, float]
    name: str = ""


@dataclass(frozen=True)
class _Fit:
    points: list[_Point]
    residual: float | None
    matrix: np.ndarray


@dataclass(eq=False)
class _Everything:
    """Values of all the kinds that are declared somewhere."""

    number: Kept[int] = 0
    share: Kept[float] = 0.0
    is_due: Kept[bool] = False
    text: Kept[str] = ""
    content: Kept[bytes] = b""
    cause: Kept[LossCause] = LossCause.NONE
    array: Kept[np.ndarray | None] = None
    fit: Kept[_Fit | int | None] = None
    recent: Kept[deque[float] | None] = None
    seen: Kept[set[tuple[int, int]] | None] = None
    by_number: Kept[dict[int, list[_Fit]] | None] = None
    by_name: Kept[dict[str, tuple[int, ...]] | None] = None


_FLOATS = st.one_of(st.floats(), st.floats(width=32).map(np.float32), st.floats().map(np.float64))
_ARRAYS = arrays.arrays(
    st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_]), arrays.array_shapes(min_side=0)
).map(lambda array: np.asfortranarray(array) if array.size % 2 else array)
_POINTS = st.builds(_Point, st.tuples(_FLOATS, _FLOATS), st.text())
_FITS = st.builds(_Fit, st.lists(_POINTS, max_size=3), st.none() | _FLOATS, _ARRAYS)
_OWNERS = st.builds(
    _Everything,
    **{"number": st.integers(), "share": _FLOATS, "is_due": st.booleans() | st.booleans().map(np.bool_)},
    **{"text": st.text(), "content": st.binary(), "cause": st.sampled_from(LossCause)},
    **{"array": st.none() | _ARRAYS, "fit": st.one_of(st.none(), st.integers(), _FITS)},
    recent=st.lists(_FLOATS, max_size=3).map(lambda values: deque(values, maxlen=4)),
    seen=st.sets(st.tuples(st.integers(), st.integers()), max_size=4),
    by_number=st.dictionaries(st.integers(), st.lists(_FITS, max_size=2), max_size=2),
    by_name=st.dictionaries(st.text(), st.lists(st.integers(), max_size=3).map(tuple), max_size=3),
)


def _same(one: Any, other: Any) -> bool:
    """Whether two values are equal to the last bit, of one type, and alike in memory."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        order = one.flags.f_contiguous == other.flags.f_contiguous
        return order and one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if isinstance(one, _Fit | _Everything):
        return all(_same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    if isinstance(one, dict):
        return list(one) == list(other) and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple | deque):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other or (one != one and other != other))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(owner=_OWNERS)
def test_all_that_is_kept_comes_back(tmp_path_factory: pytest.TempPathFactory, owner: _Everything) -> None:
    found = through_checkpoint(tmp_path_factory.mktemp("state") / "run", owner, _Everything(recent=deque(maxlen=4)))
    assert _same(owner, found)
    assert found.recent is not None
    assert found.recent.maxlen == 4


class _Owner:
    """One of the stages, as far as it matters here: it holds frames, arrays that it changes, and parts of its own."""

    frames: Kept[list[Frame]]
    mean: Kept[np.ndarray]
    change: Kept[np.ndarray]
    counts: Kept[Counter[int]]
    lists: Kept[defaultdict[int, list[int]]]
    matcher: Kept[KeyframeMatcher]

    def __init__(self) -> None:
        self.frames, self.mean, self.change = [], np.zeros(4000), np.zeros(4000)
        self.counts, self.lists = Counter(), defaultdict(list)
        self.matcher, self.settings = KeyframeMatcher(DisFlow()), object()


def test_parts_stay_the_objects_they_are_and_only_frames_share_arrays(tmp_path: Path) -> None:
    before, after, view = _Owner(), _Owner(), frame(pose())
    before.frames, before.counts, before.lists = [view, view], Counter({2: 5}), defaultdict(list, {1: [2]})
    before.matcher.set_keyframe(view)
    matcher, flow = after.matcher, after.matcher.flow
    through_checkpoint(tmp_path / "run", before, after)
    assert after.matcher is matcher
    assert after.matcher.flow is flow  # is in no file
    assert after.frames[0].rgb is after.frames[1].rgb
    assert after.mean is not after.change  # equal now, and each is changed in place
    assert (after.counts, after.lists[9], after.lists[1]) == (Counter({2: 5}), [], [2])
    other = frame(pose(at_mm=(1.0, 0.0, 0.0)))
    np.testing.assert_array_equal(matcher.match(other).pixels, before.matcher.match(other).pixels)  # type: ignore[union-attr]


def test_a_volume_that_grows_writes_what_changed(tmp_path: Path) -> None:
    blocks, checkpoint = VoxelBlocks(), SavedState(tmp_path)
    slots = blocks.slots(np.array([pack.py_func(n, 0, 0) for n in range(4000)]))
    blocks.voxels.tsdf[slots] = slots[:, None, None, None]

    def files() -> set[str]:
        checkpoint.put("volume", blocks)
        checkpoint.commit({})
        return {file.name for file in (tmp_path / CHECKPOINT).glob("*.npy")}

    first = files()
    blocks.voxels.tsdf[slots[-1]] = -1.0
    second = files()
    assert len(first - second) == len(second - first) == 1
    restored = VoxelBlocks()
    SavedState(tmp_path).restore("volume", restored)
    for one, other in zip(restored.voxels, blocks.voxels, strict=True):
        np.testing.assert_array_equal(one, other)
    restored.slots(np.array([pack.py_func(n, 1, 0) for n in range(4000)]))  # grows in place
    np.testing.assert_array_equal(restored.find(np.array([[7, 0, 0]])), [8])


def _committed(folder: Path) -> _Owner:
    owner, checkpoint = _Owner(), SavedState(folder)
    owner.frames, owner.mean = [frame(pose())], np.random.default_rng(3).normal(size=(40, 4, 4))
    checkpoint.put("part", owner)
    checkpoint.commit({"last": 1})
    return owner


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    _committed(tmp_path)
    assert SavedState(tmp_path).check() == []
    for file in (tmp_path / CHECKPOINT).iterdir():
        content = file.read_bytes()
        for length in {*range(0, len(content), len(content) // 50), len(content) - 1}:
            file.write_bytes(content[:length])
            with pytest.raises(InputError, match=f"is damaged.*{file.name}"):
                SavedState(tmp_path).check()
        file.write_bytes(content)


def test_what_a_killed_write_leaves_is_not_taken_for_an_array(tmp_path: Path) -> None:
    _committed(tmp_path)
    names = [file.name for file in (tmp_path / CHECKPOINT).glob("*.npy")]
    for name in names:
        (tmp_path / CHECKPOINT / name).write_bytes(b"")
    _committed(tmp_path)  # by another process, as far as it knows
    assert SavedState(tmp_path).check() == []


def test_no_file_names_a_class(tmp_path: Path) -> None:
    _committed(tmp_path)
    text = (tmp_path / CHECKPOINT / "state.json").read_text()
    assert not any(name in text for name in ("Frame", "Matcher", "scopemap", "__"))
    assert json.loads(text)["facts"] == {"last": 1}


def test_a_class_of_others_keeps_nothing_where_its_types_are_unknown() -> None:
    class Foreign:
        network: Network  # type: ignore[name-defined] # noqa: F821

    assert kept(Foreign) == {}


@pytest.mark.parametrize(("writing_s", "between_s"), [(0.01, 10), (0.5, 25), (3.0, 57), (30.0, 30)])
def test_a_fiftieth_of_the_time_is_written_and_a_minute_is_lost_at_most(
    writing_s: float, between_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1000.0]

    def put(state: SavedState, part: str, owner: object) -> None:
        if part == "run":
            now[0] += writing_s
            state.seconds += writing_s

    monkeypatch.setattr("scopemap.runner.checkpoints.time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(SavedState, "put", put)
    monkeypatch.setattr(SavedState, "commit", lambda state, facts: None)
    pipeline = SimpleNamespace(fusion=SimpleNamespace(store=FrameStore()))
    run = SimpleNamespace(pipeline=pipeline, sequence=SimpleNamespace(choice=None, source=None), writers=())
    states, begun = Checkpoints(tmp_path, {}, run), []  # type: ignore[arg-type]
    while len(begun) < 4:
        now[0] += 0.25
        if states.due():
            begun.append(now[0])
            states.commit(1)
    assert np.diff(begun) == pytest.approx([between_s] * 3, abs=0.8)
    assert np.diff(begun).max() + writing_s <= 60.3
