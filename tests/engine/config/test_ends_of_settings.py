"""Every setting at the ends of its documented range gets through a run, or is refused in words."""

from __future__ import annotations

from functools import reduce
from itertools import zip_longest
from operator import or_
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from scopemap import Config, open_sequence, reconstruct
from scopemap.engine.errors import InputError, SettingsError
from tests.support.tiny_phantom import write_tiny

pytestmark = pytest.mark.slow

FRAMES = 30
QUICK = {"networks.flow": "dis", "networks.perceptual": "structure", "tracking.keyframe_every": 3}
NEEDS_MORE = {
    "depth.anchor=depth-pro": "weights of Depth Pro",
    "depth.depth_pro_focal=network": "weights of Depth Pro",
    "networks.perceptual=lpips": "weights of LPIPS",
}
OPEN = {
    "fusion.truncation_mm=10000.0": "touches every block within ten metres: no end in sight",
    "fusion.max_depth_mm=1000000.0": "no pose is near enough to the origin for such a depth",
}
"""Ends with which a run does not get through yet."""
REFUSED = {
    "run.memory_mb=1": "are the least",
    "tracking.min_valid_share=1": "no frame of .* could be used",
    "depth.anchor=near-far": "needs a range",
}
"""Ends that no run of this clip can have, and what is said then."""
WITH = {"fusion.voxel_mm=0.01": {"depth.factor": 1000.0}}
"""What an end is tried with: a world whose surface has not some million triangles, the nearest tissue at 1 mm."""
ALONE = {
    "tracking.camera_at_rest=True",
    "mapping.global_adjustment=False",
}
"""Ends with which a run does not reach what other settings change."""


def _ends(field: FieldInfo) -> list[Any]:
    """The ends that belong to a field's range, or all its values where these are named."""
    if bool in {field.annotation, *get_args(field.annotation)}:
        return [not field.default]
    if get_origin(field.annotation) is Literal:
        return [value for value in get_args(field.annotation) if value != field.default]
    found = (getattr(part, end, None) for part in field.metadata for end in ("ge", "le"))
    return [value for value in found if value is not None and value != field.default]


def _by_stage() -> list[list[tuple[str, Any]]]:
    """The settings of each stage at their ends, but for those that need more."""
    found = []
    for group, holder in Config.model_fields.items():
        kind = holder.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            ends = [(f"{group}.{name}", value) for name, field in kind.model_fields.items() for value in _ends(field)]
            found.append([end for end in ends if _id(end) not in NEEDS_MORE | OPEN])
    return found


def _id(end: tuple[str, Any]) -> str:
    return f"{end[0]}={end[1]}"


def _runs() -> list[dict[str, Any]]:
    """The settings of each run: for time one of each stage at an end, so that they hide nothing from each other."""
    stages = [[end for end in stage if _id(end) not in {*ALONE, *REFUSED}] for stage in _by_stage()]
    together = [dict(end for end in ends if end is not None) for ends in zip_longest(*stages)]
    return together + [dict([end]) for stage in _by_stage() for end in stage if _id(end) in ALONE]


@pytest.fixture(scope="module")
def phantom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("ends") / "phantom", frames=FRAMES)


@pytest.mark.parametrize("ends", _runs(), ids=lambda ends: ",".join(map(_id, ends.items())))
def test_a_run_with_settings_at_an_end_of_their_ranges(ends: dict[str, Any], phantom: Path) -> None:
    others = [WITH.get(_id(end), {}) for end in ends.items()]
    result = reconstruct(open_sequence(phantom), Config.load(settings=reduce(or_, others, QUICK | ends)))
    assert len(result.frames) == FRAMES
    assert "frames-failed" not in {notice["code"] for notice in result.provenance["notices"]}


@pytest.mark.parametrize("end", [end for stage in _by_stage() for end in stage if _id(end) in REFUSED], ids=_id)
def test_an_end_that_a_clip_cannot_have_is_refused(end: tuple[str, Any], phantom: Path) -> None:
    with pytest.raises((InputError, SettingsError), match=REFUSED[_id(end)]):
        reconstruct(open_sequence(phantom), Config.load(settings=QUICK | dict([end])))


@pytest.mark.parametrize("end", [*NEEDS_MORE.items(), *OPEN.items()], ids=lambda end: end[0])
def test_an_end_that_is_left_out(end: tuple[str, str]) -> None:
    pytest.skip(end[1])


def test_all_ends_are_found() -> None:
    found = {_id(end) for stage in _by_stage() for end in stage}
    assert {*ALONE, *REFUSED, "mapping.depth_step_sigma=0", "fusion.voxel_mm=0.01"} <= found
