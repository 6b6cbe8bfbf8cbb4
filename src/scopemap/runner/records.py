"""The records of a run's frames, packed: as objects those of hours of video would take hundreds of megabytes."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np

from scopemap.errors import InputError
from scopemap.frame import REGIONS, RowTable
from scopemap.reconstruction import FrameRecord
from scopemap.tracking.track import Status, Track

_OF_TRACK = (
    *("keyframe", "iterations", "map", "residual", "inlier_share", "correlation", "overlap"),
    *("usable", "sharpness", "motion", "quality"),
)
_RECORD = np.dtype(
    [
        *((name, np.int64) for name in ("index", "keyframe", "iterations", "map", "text")),
        *((name, np.float64) for name in ("time_s", "residual", "inlier_share", "correlation", "overlap")),
        *((name, np.float64) for name in ("depth_scale", "warped_share", "usable", "sharpness", "motion", "quality")),
        ("nonrigidity", np.float32, REGIONS),
        *((name, np.float64, (4, 4)) for name in ("T_tracked", "T_world_camera")),
        ("has_pose", np.int64),
        ("sizes", np.int64, (3,)),
    ]
)
"""A record; `text` is where name, status and reason begin, `sizes` are their bytes."""


class FrameRecords:
    """Takes the record of each frame as tracked, and returns all of them.

    table : where they are kept.
    """

    def __init__(self, table: RowTable) -> None:
        self._rows, self._texts = table("records", _RECORD), table("record_texts", np.dtype(np.uint8))
        self.last_index = -1
        """Number of the last frame, -1 before the first."""

    def __len__(self) -> int:
        """Return the number of records."""
        return len(self._rows)

    def append(self, record: FrameRecord) -> None:
        """Put a record in; its submap is not known yet."""
        track, row = record.track, np.zeros(1, _RECORD)
        row["index"], row["time_s"], row["text"] = record.index, record.time_s, len(self._texts)
        for name in _OF_TRACK:
            row[name] = getattr(track, name)
        row["depth_scale"], row["warped_share"] = record.depth_scale, record.warped_share
        row["T_tracked"] = track.T_world_camera
        row["nonrigidity"] = np.nan if track.nonrigidity is None else track.nonrigidity
        if record.T_world_camera is not None:
            row["has_pose"], row["T_world_camera"] = True, record.T_world_camera
        # A file's name may hold bytes that are no UTF-8.
        texts = [text.encode("utf-8", "surrogateescape") for text in (record.name, track.status, track.reason)]
        row["sizes"] = [len(text) for text in texts]
        self._texts.append(np.frombuffer(b"".join(texts), np.uint8))
        self._rows.append(row)
        self.last_index = record.index

    def read(self) -> list[FrameRecord]:
        """Return all records."""
        texts = self._texts.read().tobytes()
        return [_record(row, texts) for row in self._rows.read()]

    def thin(self) -> set[int]:
        """Forget every second one of the older half; return the numbers of these frames."""
        kept = np.ones(len(self), bool)
        kept[1 : len(self) // 2 : 2] = False
        forgotten = self._rows.read()["index"][~kept]
        self._rows.keep(kept)
        return set(forgotten.tolist())


def check_tracked(records: list[FrameRecord], path: Path) -> None:
    """Raise `InputError` where no frame of the input at a path was tracked."""
    if all(record.track.status == "lost" for record in records):
        reason = records[0].track.reason if records else "interrupted before the first"
        guess = "" if "max_depth_mm" in reason else " (black or constant?)"
        raise InputError(f"no frame of {path} could be used: {reason}{guess}")


def _record(row: np.void, texts: bytes) -> FrameRecord:
    ends = (row["text"] + np.cumsum([0, *row["sizes"]])).tolist()
    name, status, reason = (texts[a:b].decode("utf-8", "surrogateescape") for a, b in pairwise(ends))
    track = Track(
        int(row["index"]),
        cast(Status, status),
        reason,
        row["T_tracked"],
        int(row["keyframe"]),
        float(row["residual"]),
        float(row["inlier_share"]),
        float(row["correlation"]),
        float(row["overlap"]),
        int(row["iterations"]),
        int(row["map"]),
        float(row["usable"]),
        float(row["sharpness"]),
        float(row["motion"]),
        float(row["quality"]),
        row["nonrigidity"].copy(),
    )
    pose = row["T_world_camera"] if row["has_pose"] else None
    scale, share = float(row["depth_scale"]), float(row["warped_share"])
    return FrameRecord(track.index, float(row["time_s"]), name, track, pose, scale, share)
