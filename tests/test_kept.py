"""Every attribute that changes as frames come is kept, so that a run that was killed has it again."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pipeline_steps import stepped
from tiny_phantom import write_tiny

from scopemap.engine.config import Config
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.kept import kept
from scopemap.engine.pipeline import Pipeline
from scopemap.input.opening import open_sequence
from scopemap.report.frame_pictures import FramePictures
from scopemap.result.depth_maps import DepthWriter
from scopemap.runner.estimators import create_estimators
from scopemap.runner.run import Clock, Run

pytestmark = pytest.mark.slow

# They follow from what is kept, or are no frame's.
NOT_KEPT = {
    "AlikeFeatures._kept",
    "Backend._pending",
    "Backend._worker",
    "FramePictures._before",
    "FrameStore._known",
    "KeyframeMatcher._small",
    "Mapper._read",
    "Relocaliser._features",
    "StoredFile._file",
}


def _is_value(value: object) -> bool:
    """Whether an object is stored by its fields."""
    return isinstance(value, tuple) or (is_dataclass(value) and not kept(type(value)))


def _owners(value: Any, met: dict[int, Any]) -> Iterator[Any]:
    """Every object of scopemap that is reached from one, which is not stored by its fields."""
    if id(value) in met:
        return
    met[id(value)] = value
    inner: list[Any] = []
    if isinstance(value, Mapping):
        inner = list(value.values())
    elif isinstance(value, list | tuple | set | deque):
        inner = list(value)
    elif type(value).__module__.startswith("scopemap."):
        inner = list(vars(value).values()) if hasattr(value, "__dict__") else []
        if not _is_value(value):
            yield value
    for one in inner:
        yield from _owners(one, met)


def _signature(value: Any) -> Any:
    """Something that changes with a value, but not with what an object in it holds."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value)).digest()
    if isinstance(value, Mapping):
        return [(key, _signature(item)) for key, item in value.items()]
    if is_dataclass(value) and _is_value(value):
        return {name: _signature(item) for name, item in vars(value).items()}
    if isinstance(value, list | tuple | set | deque):
        return [_signature(item) for item in value]
    return value if value is None or isinstance(value, int | float | str | bytes) else id(value)


@pytest.mark.parametrize(
    ("preset", "changes"),
    [
        ("default", {"tracking.keyframe_every": 2}),
        ("realtime", {"tracking.keyframe_every": 2}),
        ("default", {"tracking.camera_at_rest": True, "tracking.keyframe_every": 2, "depth.backend": "shading"}),
        (
            "paper",
            {
                "depth.backend": "shading",
                "depth.anchor": "shading",
                "networks.flow": "dis",
                "networks.perceptual": "structure",
            },
        ),
    ],
)
def test_what_changes_is_kept(preset: str, changes: dict[str, Any], tmp_path: Path) -> None:
    sequence = open_sequence(write_tiny(tmp_path / "phantom", "black:4-5,cut:8-11", frames=12))
    config, pictures = Config.load(preset, settings=changes), FramePictures()
    with closing(FrameStore(tmp_path, name="stored")) as store:
        pipeline = Pipeline(config, create_estimators(config, sequence), store)
        run = Run(sequence, pipeline, Clock(), (DepthWriter(tmp_path),))
        before: dict[int, dict[str, Any]] = {}
        changed: set[str] = set()
        for frame in sequence.frames():
            step = stepped(pipeline, frame)
            run.take(step)
            pictures(step)
            pipeline.mapper.settle()
            owners = list(_owners([pipeline, run.frames, run.kept_maps, run.checked, *run.writers, pictures], {}))
            now = {id(owner): {name: _signature(value) for name, value in vars(owner).items()} for owner in owners}
            for owner in owners:
                known, found = before.get(id(owner), now[id(owner)]), now[id(owner)]
                # What begins in the class is in the object once it has changed.
                other = [name for name in found if name not in known or known[name] != found[name]]
                changed |= {f"{type(owner).__name__}.{name}" for name in other if name not in kept(type(owner))}
            before = now
        assert len(run.frames) == 12
    assert changed <= NOT_KEPT, changed - NOT_KEPT
