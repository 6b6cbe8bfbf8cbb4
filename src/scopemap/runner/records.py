"""The records of a run's frames, packed: as objects those of hours of video would take hundreds of megabytes."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import cast

import numpy as np

from scopemap.errors import InputError
from scopemap.frame import REGIONS, RowTable
from scopemap.mapping.submaps import Submap
from scopemap.reconstruction import FrameRecord
from scopemap.tracking.track import Status, Track
from scopemap.trajectory.causes import LossCause, causes_of_loss
from scopemap.trajectory.trajectory import OTHER_MAP, ROTATION_ONLY

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
        ("rotation", np.float64, (3, 3)),
        *((name, np.float64, (4, 4)) for name in ("T_tracked", "T_world_camera")),
        ("has_pose", np.int64),
        ("relocalised", np.int64),
        ("sizes", np.int64, (4,)),
    ]
)
"""A record; `text` is where name, status, reason and cause begin, `sizes` are their bytes."""


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
        row["relocalised"] = track.relocalised
        row["nonrigidity"] = np.nan if track.nonrigidity is None else track.nonrigidity
        row["rotation"] = np.nan if track.rotation is None else track.rotation
        if record.T_world_camera is not None:
            row["has_pose"], row["T_world_camera"] = True, record.T_world_camera
        # A file's name may hold bytes that are no UTF-8.
        texts = [
            text.encode("utf-8", "surrogateescape") for text in (record.name, track.status, track.reason, track.cause)
        ]
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
        raise InputError(f"no frame of {path} could be used: {reason}")


def _record(row: np.void, texts: bytes) -> FrameRecord:
    ends = (row["text"] + np.cumsum([0, *row["sizes"]])).tolist()
    name, status, reason, cause = (texts[a:b].decode("utf-8", "surrogateescape") for a, b in pairwise(ends))
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
        rotation=None if np.isnan(row["rotation"]).any() else row["rotation"].copy(),
        cause=LossCause(cause),
        relocalised=bool(row["relocalised"]),
    )
    pose = row["T_world_camera"] if row["has_pose"] else None
    scale, share = float(row["depth_scale"]), float(row["warped_share"])
    return FrameRecord(track.index, float(row["time_s"]), name, track, pose, scale, share)


def records_of(number: int, submaps: list[Submap], records: list[FrameRecord]) -> list[FrameRecord]:
    """Return the records of the submap with this number, with corrected poses and scales.

    Submap 0 is the result: its records are those of all frames, lost ones and those of other submaps included. Any
    other has the records of its own frames.
    """
    submap = submaps[number]
    map_of = {index: number for number, submap in enumerate(submaps) for index in submap.frames}
    out, maps = list[FrameRecord](), set[int]()
    for record in records:
        track, found_in = record.track, map_of.get(record.index)
        if found_in == number:
            if track.status == "initial" and maps:
                reason = track.reason if track.map in maps else "first frame of a merged map"
                record = replace(record, track=replace(track, status="ok", reason=reason))
            out.append(replace(_corrected(submap, record), map=number))
            maps.add(track.map)
        elif number == 0 and record.T_world_camera is not None:
            where = "a submap too small to be saved" if found_in is None else f"maps/{found_in}"
            track = replace(track, status=OTHER_MAP, reason=f"tracked in {where}")
            out.append(replace(record, track=track, T_world_camera=None, map=found_in))
        elif number == 0:
            out.append(record)
    causes = causes_of_loss([record.track for record in out])
    return _with_rotations([replace(record, cause=cause) for record, cause in zip(out, causes, strict=True)])


def _with_rotations(records: list[FrameRecord]) -> list[FrameRecord]:
    """Return the records of a submap, in order, where lost ones whose rotation was followed from it have it, so marked.

    Only where a wall filled the picture: elsewhere it may be fluid or an instrument that was followed. The rotation is
    relative to the last frame that was tracked, and turns with that.
    """
    out, T_world_last = list[FrameRecord](), None
    for is_lost, segment in groupby(records, lambda record: record.track.status == "lost"):
        group = list(segment)
        if not is_lost:
            T_world_last = group[-1].T_world_camera
        elif T_world_last is not None and any(record.track.cause is LossCause.CONTACT for record in group):
            group = [_rotated(record, T_world_last) for record in group]
        out += group
    return out


def _rotated(record: FrameRecord, T_world_last: np.ndarray) -> FrameRecord:
    if record.track.rotation is None:
        return record
    orientation = T_world_last[:3, :3] @ record.track.rotation
    return replace(record, track=replace(record.track, status=ROTATION_ONLY), orientation=orientation)


def _corrected(submap: Submap, record: FrameRecord) -> FrameRecord:
    if submap.correction is None or record.T_world_camera is None:
        return record
    pose = submap.correction.pose(record.index, record.T_world_camera)
    scale = record.depth_scale * submap.correction.depth_factor(record.index)
    return replace(record, T_world_camera=pose, depth_scale=scale)
