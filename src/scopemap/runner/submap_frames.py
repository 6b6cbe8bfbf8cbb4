"""The tables of a result's submaps, from the table of all frames as tracked."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

import numpy as np

from scopemap.engine.backwards import MapMerge
from scopemap.engine.errors import InputError
from scopemap.engine.mapping.segments import Submap
from scopemap.engine.masking.masker import StoredMasks
from scopemap.engine.tracking.causes import LossCause, causes_of_loss
from scopemap.engine.tracking.track import Track, TrackedFrames
from scopemap.input.trajectory.trajectory import OTHER_MAP, ROTATION_ONLY
from scopemap.result.frame_table import FrameTable
from scopemap.result.wording import in_words


def check_tracked(frames: FrameTable, path: Path, masks: StoredMasks | None) -> None:
    """Raise `InputError` where no frame of the input at a path was tracked; it says where masks hide nearly all."""
    if not frames.tracked.any():
        reason = frames["reason"][0] if len(frames) else "interrupted before the first"
        large = next((one for one in masks.notices if one.code == "masks-large"), None) if masks is not None else None
        hidden = "" if large is None else f". {in_words(large)}"
        raise InputError(f"no frame of {path} could be used: {reason}{hidden}")


def tracked_frames(frames: FrameTable) -> TrackedFrames:
    """Return the table of all frames, as tracked, as the engine takes it."""
    same = (frames[name] for name in ("map", "T_world_camera", "median_depth_mm", "motion", "quality"))
    return TrackedFrames(frames["index"], frames["status"] == "lost", *same)


def put_backwards(frames: FrameTable, found: Iterable[Track | MapMerge]) -> None:
    """Put what was tracked backwards into the table of all frames, as tracked; found : in order."""
    row_of = {index: row for row, index in enumerate(frames["index"].tolist())}
    for one in found:
        if isinstance(one, Track):
            frames.put(row_of[one.index], one.row)
            continue
        for row in np.flatnonzero(frames.tracked & (frames["map"] == one.map)):
            T_world_camera = one.T_earlier_own @ frames["T_world_camera"][row]
            frames.put(int(row), {"map": one.earlier_map, "T_world_camera": T_world_camera})
        frames.put(row_of[one.start], {"status": "ok", "reason": "relocalised", "relocalised": True})


def frames_of_submap(number: int, submaps: list[Submap], frames: FrameTable) -> FrameTable:
    """Return the table of the submap with this number, with corrected poses and scales.

    frames : all, as tracked. Submap 0 is the result: its table has all frames, lost ones and those of other submaps
    included. That of any other has its own frames.
    """
    map_of = {index: number for number, submap in enumerate(submaps) for index in submap.frames}
    found_in = np.array([map_of.get(index, -1) for index in frames["index"].tolist()], np.int64)
    if number:
        frames, found_in = frames.only(found_in == number), found_in[found_in == number]
    rows, tracked = frames.rows.copy(), frames.tracked
    _correct(rows, np.flatnonzero(found_in == number), submaps[number])
    for place in np.flatnonzero(tracked & (found_in != number)):
        where = "a submap too small to be saved" if found_in[place] < 0 else f"maps/{found_in[place]}"
        rows["reason"][place] = f"tracked in {where}"
        rows["status"][place], rows["T_world_camera"][place] = OTHER_MAP, np.nan
    rows["map"] = found_in
    rows["cause"] = causes_of_loss(rows["status"], rows["cause"], rows["motion"])
    _rotate(rows)
    return FrameTable(rows)


def _correct(rows: np.ndarray, places: np.ndarray, submap: Submap) -> None:
    """Correct poses and scales of a submap's rows, which are at these places; its first frame alone is initial."""
    maps = set[int]()
    for place in places:
        row = rows[place]
        if row["status"] == "initial" and maps:
            row["status"] = "ok"
            row["reason"] = row["reason"] if row["map"] in maps else "first frame of a merged map"
        maps.add(int(row["map"]))
        index = int(row["index"])
        row["segment"] = submap.segment_of(index)
        if (correction := submap.correction(index)) is not None:
            row["T_world_camera"] = correction.pose(index, row["T_world_camera"])
            row["depth_scale"] *= correction.depth_factor(index)


def _rotate(rows: np.ndarray) -> None:
    """Give lost frames whose rotation was followed from the submap that rotation, and mark them.

    Only where a wall filled the picture: elsewhere it may be fluid or an instrument that was followed. The rotation is
    relative to the last frame that was tracked, and turns with that.
    """
    R_world_last = np.full((3, 3), np.nan)
    for is_lost, segment in groupby(range(len(rows)), lambda place: rows["status"][place] == "lost"):
        places = list(segment)
        if not is_lost:
            R_world_last = rows["T_world_camera"][places[-1], :3, :3].copy()
        elif not np.isnan(R_world_last).any() and (rows["cause"][places] == LossCause.CONTACT).any():
            for place in places:
                if not np.isnan(rows["rotation"][place]).any():
                    rows["T_world_camera"][place, :3, :3] = R_world_last @ rows["rotation"][place]
                    rows["status"][place] = ROTATION_ONLY
