"""Kept measurements of the speed of clips, and what takes more processor time now than when they were kept."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from scopemap.engine.config import Config
from scopemap.engine.errors import InputError
from scopemap.input.frame_choice import slice_of
from scopemap_bench.speed import Speed, StageTime, timed_runs

TOLERANCE = 0.1
"""Share by which a stage may be slower."""
WHOLE_TOLERANCE = 0.25
"""Share by which the whole process may be slower: beside other work it is so by a tenth or more (nflba_03 60 to 67)."""

_MORE_RUNS = 2  # of a clip that seems slower as a whole: the median of three runs decides


def as_json(speeds: Sequence[Speed]) -> list[dict[str, Any]]:
    """Return the figures, rounded, as `read_speeds` reads them."""
    text = json.dumps([asdict(speed) for speed in speeds])
    rounded: list[dict[str, Any]] = json.loads(text, parse_float=lambda number: round(float(number), 4))
    return rounded


def read_speeds(file: Path) -> list[Speed]:
    """Return the measurements that a file holds; raises `InputError` where it holds none."""
    try:
        found = [_read(record) for record in json.loads(file.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(f"reading {file}: it holds no measurements of speed ({error})") from None
    if not found:
        raise InputError(f"reading {file}: its list of measurements is empty")
    return found


def _read(record: dict[str, Any]) -> Speed:
    stages = {name: StageTime(**stage) for name, stage in record["stages"].items()}
    return Speed(**record | {"size": tuple(record["size"]), "stages": stages})


def is_here(record: Speed, data: Path | None) -> bool:
    """Return whether the video of a record is in `data` (None: the working directory); the phantom always is."""
    return record.video is None or ((data or Path()) / record.video).exists()


def measured_again(record: Speed, data: Path | None, *, whole: bool) -> tuple[Speed, list[str]]:
    """Measure what was recorded; return the measurement, and a line for each stage that is slower now.

    Raises `InputError` and `SettingsError`.

    Parameters
    ----------
    data : folder that the record's video is in; None: the working directory.
    whole : look at the whole process alone. Where one run is slower than allowed, the median of three counts.
    """
    tolerance = WHOLE_TOLERANCE if whole else TOLERANCE
    with timed_runs(record.video, slice_of(record.selection or None), Config.load(record.preset), data) as run:
        now = run()
        slower = now.slower_than(record, tolerance, whole=whole)
        if slower and whole:
            runs = sorted([now, *(run() for _ in range(_MORE_RUNS))], key=lambda speed: speed.whole_ratio)
            now = runs[len(runs) // 2]
            slower = now.slower_than(record, tolerance, whole=True)
    return now, slower
