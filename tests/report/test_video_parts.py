"""The parts of a video between losses, and what joins them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from scopemap.report.video_parts import Join, video_parts
from scopemap.result.frame_table import FrameTable


def _table(rows: list[tuple[int, str, int, int, float]]) -> FrameTable:
    names = ("index", "status", "map", "keyframe", "inlier_share")
    return FrameTable.of([dict(zip(names, row, strict=True)) | {"time_s": row[0] / 10} for row in rows])


def _run() -> Any:
    """The result: 0 to 9, 20 to 29 (found again in 5), 50 to 59 (by loops alone); submap 1: 30 to 39; else lost."""
    own = {**dict.fromkeys(range(10), 0), **dict.fromkeys(range(20, 30), 20), **dict.fromkeys(range(50, 60), 50)}
    own[20], other = 5, range(30, 40)
    whole = [
        (k, "ok", 0, own[k], 0.5 + k / 100)
        if k in own
        else (k, "other-map", 1, -1, 0.6)
        if k in other
        else (k, "lost", -1, -1, 0.1)
        for k in range(60)
    ]
    whole[3] = (3, "lost", -1, -1, 0.1)  # too short a loss to end a part
    result = SimpleNamespace(frames=_table(whole), provenance={"loops": [[2, 55], [25, 51], [8, 52], [0, 4]]})
    submap = SimpleNamespace(frames=_table([(k, "ok", 0, 30, 0.6) for k in other]), provenance={})
    result.submaps = [result, submap]
    return result


def test_parts_and_what_joins_them() -> None:
    parts = video_parts(_run())
    assert [(part.submap, part.first, part.last) for part in parts] == [
        (0, 0, 9),
        (0, 20, 29),
        (1, 30, 39),
        (0, 50, 59),
    ]
    assert parts[0].joined == parts[2].joined == ()
    assert parts[1].joined == (Join(0, 0, 0.7),)
    assert [(join.part, join.loops, math.isnan(join.inliers)) for join in parts[3].joined] == [
        (0, 2, True),
        (1, 1, True),
    ]


def test_a_run_of_lost_frames_has_no_part() -> None:
    table = _table([(k, "lost", -1, -1, 0.1) for k in range(3)])
    run: Any = SimpleNamespace(frames=table, provenance={}, submaps=[SimpleNamespace(frames=table, provenance={})])
    assert video_parts(run) == []
