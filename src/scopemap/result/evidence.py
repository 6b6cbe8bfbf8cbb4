"""What the verdict rests on: the figures that a run measured about its result, read from `provenance.json` and tables.

The keys of `provenance.json` that the verdict needs are known here alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from scopemap.engine.notices import KINDS, Level, Notice
from scopemap.engine.tracking.causes import LossCause
from scopemap.result.frame_table import ELSEWHERE, NOT_USED, FrameTable
from scopemap.result.input_part import part_of_input
from scopemap.result.losses import losses, main_cause
from scopemap.result.result import Result
from scopemap.result.submap_summaries import SubmapSummary, submaps_in_time
from scopemap.result.surface_segments import SurfaceSegment
from scopemap.result.wording import text_of

LEAST_SUBMAP_S = 3.0
"""Least length of a submap that stands for its part of the video."""


@dataclass(frozen=True)
class Evidence:
    """What is known of a result, or of a segment of one, which has the first group of figures only.

    Shares are of 1. None : not measured, or it does not apply.

    frames_in_result : number of its frames. faces : triangles of its surface. coverage_mean, coverage_least : share of
    what a frame sees that the surface covers, of all checked frames and of the worst. depth_error : median relative
    difference between the surface's depth and that of its frames. within_10_percent_mean, within_10_percent_least :
    share of the picture in which they differ by less, of all checked frames and of the worst. notices : each once; what
    the user states takes the place of what a data set states.

    frames_used : frames of the video that were used. frames_usable : frames in the result, without those of segments
    that are not usable. frames_in_usable_submaps : frames in other submaps that last 3 s and are usable. longest_gap :
    successive frames that are in none of these. frames_elsewhere : frames that are tracked in another submap.
    frames_lost : frames without a pose; frames_rotation_only : those among them with a rotation. loss_cause : of most
    lost frames. interrupted_at_frame : number of the last frame of a run that was stopped. chosen_frames : which part
    of the input was used, in words; "" is all of it.

    submaps : in the order of time, with the inlier shares. submap_levels : the verdicts on the other submaps, most
    frames first. segments : in the order of time. loose_segments : how many of them are joined by tracking alone.

    keyframes : keyframes whose depth was triangulated, or tried to be; triangulated : those in which several views
    measured it. keyframes_without_observations : keyframes, where they have no common observations. moving_share :
    share of the frames in which tissue moves on its own; None where the camera is stated to be at rest, since each
    frame then has a surface of its own.

    lens_origin : "assumed", "calibrated", "stated", "estimated" or "". scale_known : whether sizes were measured, or
    anchored to a range; scale_stated : to a range that the user gave; scale_source : what the scale comes from.
    """

    frames_in_result: int
    faces: int
    coverage_mean: float | None
    coverage_least: float | None
    depth_error: float | None
    within_10_percent_mean: float | None
    within_10_percent_least: float | None
    notices: tuple[Notice, ...]

    frames_used: int = 0
    frames_usable: int = 0
    frames_in_usable_submaps: int = 0
    longest_gap: int = 0
    frames_elsewhere: int = 0
    frames_lost: int = 0
    frames_rotation_only: int = 0
    loss_cause: LossCause = LossCause.NONE
    interrupted_at_frame: int | None = None
    chosen_frames: str = ""

    submaps: tuple[SubmapSummary, ...] = ()
    submap_levels: tuple[Level, ...] = ()
    segments: tuple[SurfaceSegment, ...] = ()
    loose_segments: int = 0

    keyframes: int | None = None
    triangulated: int | None = None
    keyframes_without_observations: int | None = None
    moving_share: float | None = None

    lens_origin: str = ""
    scale_known: bool = False
    scale_stated: bool = False
    scale_source: str = "unknown"

    @property
    def codes(self) -> frozenset[str]:
        """The codes of its notices."""
        return frozenset(notice.code for notice in self.notices)

    @property
    def usable_share(self) -> float | None:
        """Share of the frames that are in usable segments of the result or in usable submaps; None without frames."""
        return (self.frames_usable + self.frames_in_usable_submaps) / self.frames_used if self.frames_used else None

    @property
    def triangulated_share(self) -> float | None:
        """Share of the keyframes in which several views measured depth."""
        if self.triangulated is None or self.keyframes is None:
            return None
        return self.triangulated / self.keyframes if self.keyframes else 0.0

    @property
    def known_inlier_shares(self) -> int:
        """Number of submaps, the result among them, whose inlier share is known."""
        return sum(not np.isnan(submap.inlier_share) for submap in self.submaps)

    @property
    def segment_count(self) -> int:
        """Number of segments."""
        return len(self.segments)

    @property
    def lens_is_assumed(self) -> bool:
        """Whether the lens is a guess."""
        return self.lens_origin == "assumed"


def evidence_of(result: Result, submap_levels: Sequence[Level]) -> Evidence:
    """Return what is known of a result; submap_levels : the verdicts on its other submaps, in their order."""
    facts, frames, segments = result.provenance, result.frames, result.segments
    camera, scale = facts.get("camera") or {}, facts.get("scale") or {}
    in_result, used = frames_in_result(frames)
    usable, in_submaps = _usable_frames(frames, segments, submap_levels)
    submap, counts, notices = frames.submap, frames.counts, _notices_that_hold(facts)
    return Evidence(
        in_result,
        len(result.mesh.faces),
        **_of_surface(facts.get("surface") or {}),
        notices=notices,
        frames_used=used,
        frames_usable=int((usable & ~in_submaps).sum()),
        frames_in_usable_submaps=int(in_submaps.sum()),
        longest_gap=_longest_run(~usable),
        frames_elsewhere=int(np.sum((submap > 0) | (submap == ELSEWHERE))),
        frames_lost=counts["lost"],
        frames_rotation_only=counts["rotation_only"],
        loss_cause=main_cause(losses(frames)),
        interrupted_at_frame=facts.get("interrupted_at_frame"),
        chosen_frames=part_of_input(facts),
        submaps=tuple(submaps_in_time(frames)),
        submap_levels=tuple(submap_levels),
        segments=tuple(segments),
        loose_segments=sum(not segment.get("joined", True) for segment in facts.get("segments", [])),
        keyframes=_value(notices, "depth-triangulated", "keyframes"),
        triangulated=_value(notices, "depth-triangulated", "triangulated"),
        keyframes_without_observations=_value(notices, "mapping-without-observations", "keyframes"),
        moving_share=_moving_share(notices),
        lens_origin=camera.get("origin", ""),
        scale_known=bool(scale.get("known")),
        scale_stated=bool(scale.get("stated")),
        scale_source=scale_source(facts),
    )


def evidence_of_segment(facts: Mapping[str, Any]) -> Evidence:
    """Return what is known of a segment by itself; facts : as `segments` of `provenance.json` has them."""
    found = _of_surface(facts["surface"])
    return Evidence(facts["frames"], facts["faces"], **found, notices=_notices_that_hold(facts))


def notices_of(provenance: Mapping[str, Any]) -> list[Notice]:
    """Return the notices in the provenance of a run, or in what it has of a segment, each once.

    Those of another version that this one does not know are left out, and so are values that it does not know.
    """
    found = list[Notice]()
    for one in provenance.get("notices", []):
        with suppress(KeyError):
            code, values = one["code"], one["values"]
            found.append(Notice(code, {name: values[name] for name in KINDS[code].values}))
    return list({(notice.code, text_of(notice)): notice for notice in found}.values())


def frames_in_result(frames: FrameTable) -> tuple[int, int]:
    """Return how many frames are in the result, and of how many that were used."""
    return int(np.sum(frames.submap == 0)), int(np.sum(frames.submap != NOT_USED))


def scale_source(provenance: Mapping[str, Any]) -> str:
    """Return what the scale comes from, in words."""
    return str((provenance.get("scale") or {}).get("source", "unknown"))


def _of_surface(surface: Mapping[str, float]) -> dict[str, Any]:
    """Return the fields of `Evidence` about how a surface agrees with its frames."""
    names = ("coverage_mean", "coverage_least", "depth_error", "within_10_percent_mean", "within_10_percent_least")
    return {name: surface.get(name) for name in names}


def _notices_that_hold(facts: Mapping[str, Any]) -> tuple[Notice, ...]:
    """Return the notices, without what a data set states of the camera where the user states it."""
    found = notices_of(facts)
    is_stated = any(notice.code == "camera-at-rest-stated" for notice in found)
    return tuple(notice for notice in found if not (is_stated and notice.code == "camera-at-rest"))


def _value(notices: Sequence[Notice], code: str, name: str) -> Any:
    """Return a value of the notice of this code; None where there is none."""
    return next((notice.values[name] for notice in notices if notice.code == code), None)


def _moving_share(notices: Sequence[Notice]) -> float | None:
    frames, measured = (_value(notices, "tissue-moves", name) for name in ("frames", "measured"))
    if frames is None or any(notice.code == "camera-at-rest-stated" for notice in notices):
        return None
    return float(frames / measured)


def _usable_frames(
    frames: FrameTable, segments: Sequence[SurfaceSegment], submap_levels: Sequence[Level]
) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the frames that were used are usable, and which of these are in other submaps: both (N,) bool.

    Frames of segments that are not usable are left out unless no segment is usable, which is a reason of its own.
    """
    used = frames.only(frames.submap != NOT_USED)
    submap = used.submap
    in_submaps = np.isin(submap, _usable_submaps(frames, submap_levels))
    bad = [segment.segment for segment in segments if segment.level == "bad"]
    left_out = np.isin(used["segment"], bad) if len(bad) < len(segments) else False
    return in_submaps | ((submap == 0) & ~np.asarray(left_out)), in_submaps


def _usable_submaps(frames: FrameTable, submap_levels: Sequence[Level]) -> list[int]:
    """Return the numbers of the other submaps that stand for their part of the video."""
    times_s = frames["time_s"]
    period_s = np.median(np.diff(times_s)) if len(times_s) > 1 else np.nan
    usable = (number for number, level in enumerate(submap_levels, 1) if level != "bad")
    return [number for number in usable if (frames.submap == number).sum() * period_s >= LEAST_SUBMAP_S]


def _longest_run(outside: np.ndarray) -> int:
    """Return the length of the longest run of True in (N,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], outside.astype(np.int8), [0]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))
