"""The checkpoint of a run: values come back, shared ones as one, and a damaged file is never taken for whole."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict, deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from result_files import through_checkpoint

from scopemap.engine.config import TrackingSettings
from scopemap.engine.errors import InputError
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.tracking.track import Track
from scopemap.result.checkpoint import SavedState

_LEAVES = st.one_of(
    *(st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary(), st.just(Path("a/b"))),
    arrays.arrays(
        st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_]), arrays.array_shapes(min_side=0)
    ),
)
_VALUES = st.recursive(
    _LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.lists(inner, max_size=4).map(lambda values: deque(values, maxlen=5)),
        st.dictionaries(st.one_of(st.integers(), st.text(), st.tuples(st.integers(), st.text())), inner, max_size=4),
        st.sets(st.integers(), max_size=4),
    ),
    max_leaves=12,
)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, list | tuple | deque):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, dict):
        return list(one) == list(other) and all(_same(one[key], other[key]) for key in one)
    return type(one) is type(other) and (one == other or (one != one and other != other))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=_VALUES)
def test_values_come_back(tmp_path: Path, value: object) -> None:
    found = through_checkpoint(tmp_path / "state", value)
    assert type(found) is type(value)
    assert _same(value, found)


@dataclass
class _Foreign:
    number: int = 7


def test_own_objects_come_back_shared_and_keep_what_is_not_stored(tmp_path: Path) -> None:
    pose = np.eye(4, dtype=np.float32)
    track = Track(3, "ok", "", pose, 1)
    flow, before = DisFlow(), DisFlow()
    state = {
        **{"a": track, "b": [track, pose], "column": np.asfortranarray(np.arange(6.0).reshape(2, 3))},
        **{"counts": Counter({2: 5}), "lists": defaultdict(list, {1: [2]}), "scalar": np.float32(0.1)},
        **{"settings": TrackingSettings(keyframe_every=3), "flow": before, "foreign": _Foreign(1), "kind": Track},
    }
    now = {"flow": flow, "foreign": _Foreign(2)}
    found = through_checkpoint(tmp_path / "state", state, now)
    assert found["b"][0] is found["a"]
    assert found["b"][1] is found["a"].T_world_camera
    assert found["column"].flags.f_contiguous
    assert (found["counts"], found["lists"][9], found["lists"][1]) == (Counter({2: 5}), [], [2])
    assert found["scalar"].tobytes() == np.float32(0.1).tobytes()
    assert found["settings"] == TrackingSettings(keyframe_every=3)
    assert found["kind"] is Track
    # OpenCV's object is in no file, the estimator is the one that there is now.
    assert found["flow"] is flow
    assert isinstance(flow._dis, cv2.DISOpticalFlow)
    assert found["foreign"] == _Foreign(2)


def test_no_class_but_scopemaps_is_made(tmp_path: Path) -> None:
    file = tmp_path / "state"
    through_checkpoint(file, Track(3, "ok", "", np.eye(4), 1))
    for name in ("subprocess:Popen", "scopemap.engine.errors:sys", "scopemap.engine.tracking.track:Nothing"):
        forged = SavedState(file)
        forged.put("part", Track(3, "ok", "", np.eye(4), 1))
        (tree,) = forged._database.execute("select tree from states").fetchone()
        tree = tree.replace("scopemap.engine.tracking.track:Track", name)
        forged._database.execute("update states set tree = ?", (tree,))
        forged._digests["part"] = hashlib.blake2b(tree.encode(), digest_size=20).hexdigest()
        forged.commit({})
        with pytest.raises(InputError, match="checkpoint names"):
            forged.restore("part", None)


def test_a_checkpoint_cut_anywhere_is_refused_or_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    value = {
        "poses": rng.normal(size=(40, 4, 4)),
        "names": [f"frame {n}" for n in range(300)],
        "mask": rng.random(900) > 1,
    }
    assert _same(through_checkpoint(tmp_path / "whole", value), value)
    content, refused = (tmp_path / "whole").read_bytes(), 0
    cut = tmp_path / "cut"
    for length in range(0, len(content), 64):
        cut.write_bytes(content[:length])
        try:
            file = SavedState(cut)
            assert not file.facts or _same(file.restore("part", None), value)
            refused += not file.facts
            file.close()
        except InputError:
            refused += 1
    assert refused > 0.9 * len(content) / 64
