"""Poses by frame: tracked against the keyframe, depth refined with the motion known (MAPIS), keyframes adjusted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.depth.mapis import DenseCorrespondence, Mapis, RefinedDepth
from scopemap.engine.faults import StageFaults
from scopemap.engine.frame import Frame
from scopemap.engine.mapping.correction import KeyframeStep
from scopemap.engine.mapping.local_adjustment import LocalAdjustment
from scopemap.engine.mapping.mapper import Mapper
from scopemap.engine.notices import Notice
from scopemap.engine.preprocessing import PreprocessedFrame, with_depth, with_unknown_depth, without_depth
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.relocalisation import RotationFollower
from scopemap.engine.tracking.smoothing import Wema
from scopemap.engine.tracking.track import FrameTracker, ResumableTracker, Track, motion_between


@dataclass(frozen=True)
class Step:
    """All results for a frame: refined depth (at the network's size) and, unless lost, pose as tracked.

    skipped : whether nothing was estimated of it. measured : whether its depth is measured, not predicted. moved : of a
    keyframe that was adjusted as it came, by how much; None elsewhere.
    """

    frame: Frame
    track: Track
    raw_mm: np.ndarray
    refined: RefinedDepth
    skipped: bool = False
    measured: bool = False
    moved: KeyframeStep | None = None

    @property
    def row(self) -> dict[str, Any]:
        """The frame's row of a `FrameTable`, as tracked."""
        frame, refined = self.frame, self.refined
        pose = np.nan if frame.T_world_camera is None else frame.T_world_camera
        some_mm = refined.depth_mm[::4, ::4]
        depth = {"depth_scale": refined.scale, "warped_share": refined.warped_share}
        depth["median_depth_mm"] = float(np.nanmedian(some_mm)) if np.isfinite(some_mm).any() else np.nan
        return self.track.row | depth | {"time_s": frame.time_s, "name": frame.name, "T_world_camera": pose}


class Odometry:
    """Tracks frames, in order, each once, and hands keyframes to the mapper.

    local : adjusts keyframes of predicted depth as they come; None: they are as tracked.
    """

    _last_track: Track | None = None
    _previous: tuple[Frame, Track] | None = None  # tracked, no keyframe; the tracker may still promote it

    def __init__(
        self, config: Config, tracker: FrameTracker, mapper: Mapper, local: LocalAdjustment | None = None
    ) -> None:
        self._config, self._tracker, self.mapper, self._local = config, tracker, mapper, local
        self._mapis = Mapis(config.mapis)
        self._smooth = Wema(config.smoothing)
        self._rotation = RotationFollower()
        self.faults = StageFaults("tracking")

    def track(self, preprocessed: PreprocessedFrame) -> Step:
        """Track a frame, refine its depth, make it a keyframe where one is due; one with which that fails is lost."""
        self.faults.frames += 1
        try:
            step = self._track(preprocessed)
        except Exception as error:
            step = self._lost(preprocessed, self.faults.noted(preprocessed.frame.index, error))
        motion, quality, fault = _motion(preprocessed.correspondence), preprocessed.frame.quality, preprocessed.fault
        track = replace(step.track, motion=motion, quality=quality)
        if fault is not None and track.status == "lost":
            track = replace(track, cause=fault.cause, reason=fault.reason)
        track = self._rotation.follow(track, preprocessed.small, preprocessed.correspondence)
        step = replace(step, track=track)
        self.mapper.observe(step.track)
        self._last_track = step.track
        return step

    def _track(self, preprocessed: PreprocessedFrame) -> Step:
        refined = self._refine(preprocessed, None) if self._config.mapis.order == "refine-first" else None
        track, last = self._tracker.track(preprocessed.frame), self._last_track
        if track.decision.promotes_previous:
            self._promote_previous()
        if preprocessed.skipped and track.status == "lost":
            return self._without_pose(preprocessed, track)
        if track.status == "lost" or (last is not None and last.map != track.map):
            self._reset()
        if track.status == "initial" and refined is None:
            self._mapis.rescale(1.0)  # drift of the maps before is none of a new one
        if np.isfinite(track.depth_ratio):
            self._mapis.rescale(track.depth_ratio)
        refined = refined or self._refine(preprocessed, motion_between(last, track))
        frame = with_depth(preprocessed.frame, refined.depth_mm, refined.sigma_mm)
        frame = replace(frame, nonrigidity=track.nonrigidity)
        if preprocessed.kind == "depth":  # disparity has a scale of its own in every frame
            frame = replace(frame, depth_scale=refined.scale)
        moved = None
        if track.status != "lost":
            track, frame, moved = self._handed_on(track, frame, preprocessed)
        if track.status == "lost":
            self._reset()
        else:
            frame = replace(frame, T_world_camera=self._smooth(track.T_world_camera))
        raw_mm, measured = np.asarray(preprocessed.frame.depth_mm), preprocessed.kind == "measured"
        return Step(frame, track, raw_mm, refined, measured=measured, moved=moved)

    def _lost(self, preprocessed: PreprocessedFrame, reason: str) -> Step:
        """Return the step of a frame that could not be tracked, without depth."""
        frame, last = preprocessed.frame, self._last_track
        if last is None:
            track = Track(frame.index, "lost", reason, np.eye(4), frame.index, cause=LossCause.OTHER)
        else:
            track = Track(frame.index, "lost", reason, last.T_world_camera, last.keyframe, map=last.map)
            track = replace(track, cause=LossCause.OTHER)
        return self._without_pose(replace(preprocessed, frame=without_depth(frame)), track)

    def _without_pose(self, preprocessed: PreprocessedFrame, track: Track) -> Step:
        """Return the step of a lost frame whose depth is unknown."""
        self._reset()
        unknown_mm = np.asarray(with_unknown_depth(preprocessed.small).depth_mm)
        refined, frame = RefinedDepth(unknown_mm, 1.0, 0.0, unknown_mm), preprocessed.frame
        return Step(frame, track, np.asarray(frame.depth_mm), refined, preprocessed.skipped)

    def record(self) -> dict[str, Any]:
        """Return what does not follow from the steps, for `resume`, as JSON holds it."""
        return {"faults": self.faults.record(), "local": None if self._local is None else self._local.record()}

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record; `replay` takes the steps until then, and `resume_after` the last of them."""
        self.faults.resume(record["faults"])
        if self._local is not None:
            self._local.resume(record["local"])

    def replay(self, step: Step) -> None:
        """Take a step as it was made before the run was resumed, in order: nothing is estimated, tracked or adjusted.

        Its frame is as handed on, `step.moved` without `before`. The tracker is a `ResumableTracker`.
        """
        track, last = step.track, self._last_track
        frame = replace(step.frame, T_world_camera=track.T_world_camera)
        assert isinstance(self._tracker, ResumableTracker)
        if not step.skipped:
            self._mapis.rescale(step.refined.scale)
        self._tracker.replay(frame, track)
        if track.decision.promotes_previous:
            self._promote_previous()
        if track.status == "lost" or (last is not None and last.map != track.map):
            self._reset()
        if track.status != "lost":
            self._replay_handing_on(track, frame, step)
            self._smooth(track.T_world_camera)
        self.mapper.observe(track)
        self._last_track = track

    def undone(self, step: Step) -> Frame:
        """Return the frame of a step with its depth as refined, before keyframes were adjusted."""
        if self._local is None or step.measured or step.track.status == "lost":
            return step.frame
        return self._local.undone(step.frame, step.track.keyframe)

    def resume_after(self, track: Track, small: Frame) -> None:
        """Go on after the last step; small : its frame at the size of the depth estimate, with depth as refined."""
        depth_mm = np.asarray(small.depth_mm)
        self._rotation.resume_after(track, np.where(small.valid, depth_mm, np.nan))
        if track.status != "lost":
            self._mapis.resume_after(depth_mm, small.depth_sigma_mm)
        if self._local is not None:
            self._local.resume_window()

    def _replay_handing_on(self, track: Track, frame: Frame, step: Step) -> None:
        decision = track.decision
        if step.measured and decision.kind == "none":
            return
        measured = step.measured and not self._mapis.needs_previous("measured")
        can_use = self._tracker.update(frame, decision, measured=measured)
        if step.measured:
            return
        if decision.kind == "none":
            self._previous = (frame, track) if can_use else self._previous
            return
        moved = step.moved
        if self._local is not None and moved is not None:
            moved = self._local.replay(frame, track.keyframe, moved)
        if can_use:
            self.mapper.add_keyframe(frame, track, step=moved)
            self.mapper.settle()  # else the keyframes that wait for the mapper fill memory

    def notices(self, map_number: int) -> list[Notice]:
        """Return what was adjusted of a map as it came; [] where nothing was."""
        return [] if self._local is None else self._local.notices(map_number)

    def _refine(self, preprocessed: PreprocessedFrame, T_current_previous: np.ndarray | None) -> RefinedDepth:
        raw = preprocessed.small
        if preprocessed.anchored:
            self._mapis.rescale(1.0)  # a metric depth starts a new chain of scales
        return self._mapis.refine(
            np.asarray(raw.depth_mm),
            preprocessed.kind,
            raw.camera,
            preprocessed.correspondence,
            T_current_previous,
            sigma_mm=raw.depth_sigma_mm,
        )

    def _reset(self) -> None:
        """Forget earlier frames: their relative pose is unknown."""
        self._mapis.reset()
        self._smooth.reset()

    def _promote_previous(self) -> None:
        """Hand on the frame that was tracked before: it has become a keyframe since."""
        if self._previous is not None:
            frame, track = self._previous
            self.mapper.add_keyframe(frame, track)
            if self._local is not None:
                self._local.take_over(frame.index, track.keyframe)
            self._previous = None

    def _handed_on(
        self, track: Track, frame: Frame, preprocessed: PreprocessedFrame
    ) -> tuple[Track, Frame, KeyframeStep | None]:
        """Hand a tracked frame on as its track decided; return both, adjusted where keyframes are, and how.

        The first frame of a map that is refused as a keyframe is lost.
        """
        posed = replace(frame, T_world_camera=track.T_world_camera)
        hand_on = self._hand_on_measured if preprocessed.kind == "measured" else self._hand_on_predicted
        posed, is_refused, step = hand_on(track, posed)
        track, frame = replace(track, T_world_camera=_pose(posed)), replace(posed, T_world_camera=None)
        if track.status == "initial" and is_refused:
            unknown = preprocessed.depth_note or "too little of its depth is known to start from (black or constant?)"
            track = replace(track, status="lost", reason=unknown, cause=LossCause.OTHER)
        return track, frame, step

    def _hand_on_measured(self, track: Track, posed: Frame) -> tuple[Frame, bool, None]:
        """Hand on a frame of measured depth, and return whether it is refused as a keyframe.

        Only the tracker takes it, and only keyframes: with measured depth tracking alone is better.
        """
        if track.decision.kind == "none":
            return posed, False, None
        is_measured = not self._mapis.needs_previous("measured")  # else MAPIS has changed it
        return posed, not self._tracker.update(posed, track.decision, measured=is_measured), None

    def _hand_on_predicted(self, track: Track, posed: Frame) -> tuple[Frame, bool, KeyframeStep | None]:
        """Hand on a frame of predicted depth; return it, whether it is refused as a keyframe, and its step."""
        decision, local, matches, step = track.decision, self._local, None, None
        if decision.kind == "none":
            posed = posed if local is None else local.corrected(posed, track.keyframe)
            if self._tracker.update(posed, decision, measured=False):
                self._previous = posed, track
            return posed, False, None
        if local is not None:
            posed, matches, step = local.adjusted(posed, track.keyframe, track.map)
        if not self._tracker.update(posed, decision, measured=False):
            return posed, True, step
        self.mapper.add_keyframe(posed, replace(track, T_world_camera=_pose(posed)), matches, step)
        return posed, False, step


def _pose(frame: Frame) -> np.ndarray:
    assert frame.T_world_camera is not None
    return frame.T_world_camera


def _motion(correspondence: DenseCorrespondence | None) -> float:
    """Return the median flow since the frame before, share of the width."""
    if correspondence is None:
        return float("nan")
    flow = correspondence.to_previous[::4, ::4]
    return float(np.median(np.hypot(flow[..., 0], flow[..., 1]))) / correspondence.to_previous.shape[1]
