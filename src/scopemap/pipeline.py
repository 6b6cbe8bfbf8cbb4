"""The pipeline: frames, in order, to poses, depth and a surface. No files, clocks or printing: see `runner/run.py`.

    estimate    mask -> raw metric depth, and instruments, which are left out of all that follows
    match       correspondence with the previous frame
    track       track against the keyframe (RTDL) -> refine depth with the motion known (MAPIS) -> new keyframe
                -> smooth (WEMA)
    fuse        store, or fuse (TSDF)
    mapper.submaps    after the last frame: adjust all keyframes, close loops, merge maps
    fusion.fuse       fuse the stored frames of a submap, corrected (TSDF)

Each stage has its own state, so each may run in a thread of its own, frames in order. The preset `paper` refines before
it tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from scopemap.config import Config
from scopemap.depth.anchor import AnchoredDepth, depth_downscale
from scopemap.depth.correspondence import DenseCorrespondence, DenseMatcher
from scopemap.depth.estimate import DepthEstimator, DepthKind, PerceptualDistance
from scopemap.depth.mapis import Mapis, RefinedDepth
from scopemap.errors import ScopemapError
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Frame
from scopemap.fusion.frame_store import FrameStore
from scopemap.fusion.volume import SurfaceFusion
from scopemap.geometry.warp import resampled
from scopemap.mapping.submaps import Mapper
from scopemap.masking.masker import Masker, StoredMasks, without_instruments
from scopemap.notices import Notice
from scopemap.tracking.features import FeatureDetector, SiftFeatures
from scopemap.tracking.relocalisation import RotationFollower
from scopemap.tracking.sharpness import PictureQuality
from scopemap.tracking.smoothing import create_smoother
from scopemap.tracking.track import FrameTracker, LossCause, Track, TrackingLoss, motion_between
from scopemap.tracking.tracker import Tracker

_MOST_FAULTS, _MOST_FAULTS_SHARE = 3, 0.05  # frames that may fail; more are no accident


@dataclass(frozen=True)
class Estimators:
    """The interchangeable parts that look at images; a flow is not thread-safe, so each thread has its own."""

    depth: DepthEstimator
    anchor: AnchoredDepth
    flow: FlowEstimator  # between successive frames
    corner_flow: FlowEstimator  # of the keyframe's corners, in tracking
    keyframe_flow: FlowEstimator  # between keyframes, in mapping
    perceptual: PerceptualDistance
    masks: StoredMasks | None = None
    features: FeatureDetector = field(default_factory=SiftFeatures)
    tracker: Callable[[], FrameTracker] | None = None  # makes what tracks in place of `Tracker`


@dataclass(frozen=True)
class PreprocessedFrame:
    """Results that need no motion: `frame` is masked, with raw depth of `kind`; `anchored`: fixed the scale.

    small : the frame at the size of the depth estimate and of `correspondence`, that of `frame` over `depth.downscale`.
    depth_note : that most of its depth is beyond the limit; else "". fault : why it could not be processed.
    """

    frame: Frame
    small: Frame
    kind: DepthKind
    correspondence: DenseCorrespondence | None
    anchored: bool
    depth_note: str = ""
    fault: TrackingLoss | None = None


@dataclass(frozen=True)
class Step:
    """All results for a frame; `frame` has refined depth and, unless it is lost, its pose as tracked.

    raw_mm : of the frame's size. refined : of the size of the depth estimate.
    """

    frame: Frame
    track: Track
    raw_mm: np.ndarray
    refined: RefinedDepth


class Pipeline:
    """One run over one sequence; frames go through `estimate`, `match`, `track` and `fuse` in order, each once.

    store : for frames that are fused after the last one. tracker : replaces the one of `config.tracking` (baselines).
    """

    STATES: ClassVar = {
        "preprocess": ("_masker", "_quality", "estimators", "_depth_faults"),
        "match": ("_matcher", "_flow_faults"),
        "track": (
            "_tracker",
            "_mapis",
            "_smooth",
            "mapper",
            "_last_track",
            "_last_frame",
            "_tracking_faults",
            "_rotation",
        ),
    }
    """The attributes that each stage changes, by its name; those of `fuse` are in `fusion`."""

    def __init__(
        self,
        config: Config,
        estimators: Estimators,
        store: FrameStore | None = None,
        tracker: FrameTracker | None = None,
    ) -> None:
        self.config, self.estimators = config, estimators
        # An empty store counts as false.
        store = FrameStore() if store is None else store
        self.fusion = SurfaceFusion(config.fusion, store, corrected=config.mapping.method == "full")
        self._masker, self._quality = Masker(config.mask, estimators.masks), PictureQuality()
        self._matcher = DenseMatcher(config.mapis, estimators.flow, estimators.perceptual)
        self._tracker = tracker or (estimators.tracker or self._own_tracker)()
        self._mapis = Mapis(config.mapis)
        self._smooth = create_smoother(config.smoothing)
        at_rest = {"method": "none"} if config.tracking.camera_at_rest else {}  # there is nothing to adjust
        mapping = config.mapping.model_copy(update=at_rest)
        self.mapper = Mapper(mapping, estimators.keyframe_flow, store.table, estimators.features)
        self._rotation = RotationFollower()
        self._last_track: Track | None = None
        self._last_frame: tuple[Frame, Track] | None = None
        self._depth_faults, self._flow_faults, self._tracking_faults = map(_Faults, ("depth", "flow", "tracking"))

    @property
    def notices(self) -> list[Notice]:
        """What could not be processed so far."""
        return _notices((self._depth_faults, self._flow_faults, self._tracking_faults))

    def estimate(self, frame: Frame) -> PreprocessedFrame:
        """Mask a frame and estimate its raw depth; a frame with which that fails has no usable pixel, and is lost."""
        try:
            return self._estimate(frame)
        except Exception as error:
            fault = TrackingLoss(LossCause.OTHER, self._depth_faults.noted(frame.index, error))
            blind = _blind(frame)
            small = _blind(blind.downscaled(depth_downscale(self.config.depth, max(frame.valid.shape))))
            return PreprocessedFrame(blind, small, "measured", None, False, fault=fault)

    def _estimate(self, frame: Frame) -> PreprocessedFrame:
        self._depth_faults.frames += 1
        frame = self._masker(frame)
        frame = replace(frame, quality=self._quality(frame.rgb, frame.valid))
        # A frame that the tracker refuses must not fix the scale of depth.
        usable = frame.valid.mean() >= self.config.tracking.min_valid_share
        small = frame.downscaled(depth_downscale(self.config.depth, max(frame.valid.shape)))
        shown = small if usable else replace(small, valid=np.zeros_like(small.valid))
        estimate = self.estimators.depth.estimate(shown)
        if usable and estimate.kind != "measured" and not np.isfinite(estimate.values).any():
            self._depth_faults.has_no_depth(frame.index)
        fault, instruments = None, self._masker.instruments(estimate.instruments)
        if instruments is not None:
            # An instrument's depth is of no use, and what is behind it is not known.
            unknown = np.where(instruments, np.float32(np.nan), np.float32(1))
            sigma = None if estimate.sigma is None else estimate.sigma * unknown
            estimate = replace(estimate, values=estimate.values * unknown, sigma=sigma)
            frame, small, shown = (without_instruments(seen, instruments) for seen in (frame, small, shown))
            if usable and frame.valid.mean() < self.config.tracking.min_valid_share:
                left = f"only {frame.valid.mean():.0%} of the image is usable"
                fault = TrackingLoss(LossCause.VIEW_COVERED, f"{left}: instruments cover {instruments.mean():.0%}")
        raw = self.estimators.anchor.metric(estimate, shown)
        small = replace(small, depth_mm=raw.depth_mm, depth_sigma_mm=raw.sigma_mm)
        frame, fitted = _with_depth(frame, raw.depth_mm, raw.sigma_mm), self.estimators.anchor.just_fitted
        return PreprocessedFrame(frame, small, estimate.kind, None, fitted, raw.limit_note, fault)

    def match(self, estimated: PreprocessedFrame) -> PreprocessedFrame:
        """Add the correspondence of a frame with the one before, where its depth is to be refined with it."""
        frame, wanted = estimated.small, self._mapis.needs_previous(estimated.kind)
        self._flow_faults.frames += 1
        try:
            return replace(estimated, correspondence=self._matcher.match(frame.rgb, frame.valid, wanted=wanted))
        except Exception as error:
            fault = TrackingLoss(LossCause.OTHER, self._flow_faults.noted(frame.index, error))
            return replace(estimated, fault=fault)

    def preprocess(self, frame: Frame) -> PreprocessedFrame:
        """Estimate and match: all that needs no motion."""
        return self.match(self.estimate(frame))

    def track(self, preprocessed: PreprocessedFrame) -> Step:
        """Track a frame, refine its depth, make it a keyframe where one is due; one with which that fails is lost."""
        self._tracking_faults.frames += 1
        try:
            step = self._track(preprocessed)
        except Exception as error:
            step = self._lost(preprocessed, self._tracking_faults.noted(preprocessed.frame.index, error))
        motion, quality = _motion(preprocessed.correspondence), preprocessed.frame.quality
        track = replace(step.track, motion=motion, quality=quality)
        if isinstance(self._tracker, Tracker):
            track = self._rotation.follow(track, preprocessed.small, preprocessed.correspondence)
        step = replace(step, track=track)
        self.mapper.observe(step.track)
        self._last_track = step.track
        return step

    def _track(self, preprocessed: PreprocessedFrame) -> Step:
        refined = self._refine(preprocessed, None) if self.config.mapis.paper.order == "refine-first" else None
        track, last = self._tracker.track(preprocessed.frame), self._last_track
        if track.status == "lost" or (last is not None and last.map != track.map):
            self._reset()
        if np.isfinite(track.depth_ratio):
            self._mapis.rescale(track.depth_ratio)
        refined = refined or self._refine(preprocessed, motion_between(last, track))
        frame = _with_depth(preprocessed.frame, refined.depth_mm, refined.sigma_mm)
        frame = replace(frame, nonrigidity=track.nonrigidity)
        if preprocessed.kind == "depth":  # disparity has a scale of its own in every frame
            frame = replace(frame, depth_scale=refined.scale)
        self._add_last_keyframe(track)
        track = self._with_keyframe(track, frame, preprocessed)
        if track.status == "lost":
            self._reset()
        else:
            frame = replace(frame, T_world_camera=self._smooth(track.T_world_camera))
        if preprocessed.fault and track.status == "lost":
            track = replace(track, cause=preprocessed.fault.cause, reason=preprocessed.fault.reason)
        return Step(frame, track, np.asarray(preprocessed.frame.depth_mm), refined)

    def _lost(self, preprocessed: PreprocessedFrame, reason: str) -> Step:
        """Return the step of a frame that could not be tracked, without depth."""
        self._reset()
        frame, last = preprocessed.frame, self._last_track
        if last is None:
            track = Track(frame.index, "lost", reason, np.eye(4), frame.index, cause=LossCause.OTHER)
        else:
            track = Track(frame.index, "lost", reason, last.T_world_camera, last.keyframe, map=last.map)
            track = replace(track, cause=LossCause.OTHER)
        blind, unknown_mm = _blind(frame), np.asarray(_blind(preprocessed.small).depth_mm)
        return Step(blind, track, np.asarray(blind.depth_mm), RefinedDepth(unknown_mm, 1.0, 0.0, unknown_mm))

    def new_tracker(self) -> Tracker | None:
        """Return a tracker that has seen no frame, to track lost frames anew; None where the caller's own tracks."""
        return self._own_tracker() if isinstance(self._tracker, Tracker) else None

    def _own_tracker(self) -> Tracker:
        return Tracker(self.config.tracking, self.estimators.corner_flow, self.estimators.features)

    def fuse(self, step: Step) -> None:
        """Fuse a tracked frame, or store it until the last one."""
        self.fusion.put(step.frame, step.track.map)

    def step(self, preprocessed: PreprocessedFrame) -> Step:
        """Track and fuse."""
        step = self.track(preprocessed)
        self.fuse(step)
        return step

    def _refine(self, preprocessed: PreprocessedFrame, T_current_previous: np.ndarray | None) -> RefinedDepth:
        raw = preprocessed.small
        return self._mapis.refine(
            np.asarray(raw.depth_mm),
            preprocessed.kind,
            raw.camera,
            preprocessed.correspondence,
            T_current_previous,
            sigma_mm=raw.depth_sigma_mm,
            anchored=preprocessed.anchored,
        )

    def _reset(self) -> None:
        """Forget earlier frames: their relative pose is unknown."""
        self._mapis.reset()
        self._smooth.reset()

    def _add_last_keyframe(self, track: Track) -> None:
        """Hand on the frame that was tracked last where the tracker made it the keyframe of this one."""
        if track.status == "ok" and self._last_frame is not None and self._last_frame[1].index == track.keyframe:
            self.mapper.add_keyframe(*self._last_frame)
            self._last_frame = None

    def _with_keyframe(self, track: Track, frame: Frame, preprocessed: PreprocessedFrame) -> Track:
        """Make a frame the keyframe where one is due; the first one of a map that cannot be one is lost."""
        if track.status == "lost":
            return track
        keyframe, kind = replace(frame, T_world_camera=track.T_world_camera), preprocessed.kind
        if not self._tracker.needs_keyframe():
            if kind != "measured" and isinstance(self._tracker, Tracker):
                self._tracker.remember(keyframe)
                self._last_frame = keyframe, track
            return track
        measured = kind == "measured" and not self._mapis.needs_previous(kind)  # not after MAPIS changed it
        inserted = self._tracker.insert_keyframe(keyframe, measured=measured)
        if inserted and kind != "measured":  # with measured depth tracking alone is better
            self.mapper.add_keyframe(keyframe, track)
        if track.status == "initial" and not inserted:
            unknown = preprocessed.depth_note or "too little of its depth is known to start from (black or constant?)"
            return replace(track, status="lost", reason=unknown, cause=LossCause.OTHER)
        return track


def _motion(correspondence: DenseCorrespondence | None) -> float:
    """Return the median flow since the frame before, share of the width."""
    if correspondence is None:
        return float("nan")
    flow = correspondence.to_previous[::4, ::4]
    return float(np.median(np.hypot(flow[..., 0], flow[..., 1]))) / correspondence.to_previous.shape[1]


def _blind(frame: Frame) -> Frame:
    """Return a frame without a usable pixel, and with unknown depth."""
    nowhere, unknown_mm = np.zeros_like(frame.valid), np.full(frame.valid.shape, np.nan, np.float32)
    return replace(frame, valid=nowhere, depth_mm=unknown_mm, depth_sigma_mm=None)


class _Faults:
    """Frames that a stage could not process: each stage has its own, as a part of the state that it alone changes."""

    def __init__(self, stage: str) -> None:
        self._stage = stage
        self.frames = self.failed = self.without_depth = 0
        self.first, self.first_without_depth = (-1, ""), -1

    def has_no_depth(self, index: int) -> None:
        """Note a frame to which the network gave no depth."""
        self.first_without_depth = index if not self.without_depth else self.first_without_depth
        self.without_depth += 1

    def noted(self, index: int, error: Exception) -> str:
        """Note the error of a frame and return it in words. Raises it where it is no frame's own, or one of many."""
        if isinstance(error, ScopemapError):
            raise error
        reason = f"{self._stage} failed: {' '.join(str(error).split())[:200] or type(error).__name__}"
        self.first = self.first if self.failed else (index, reason)
        self.failed += 1
        if self.failed > _MOST_FAULTS and self.failed > _MOST_FAULTS_SHARE * self.frames:
            first = "frame {}, {}".format(*self.first)
            error.add_note(f"the run ends at frame {index}: {self.failed} frames failed, first {first}")
            raise error
        return reason


def _notices(stages: tuple[_Faults, ...]) -> list[Notice]:
    """Return what the stages could not process."""
    failed, blind, found = sum(faults.failed for faults in stages), sum(faults.without_depth for faults in stages), []
    if failed:
        index, reason = min(faults.first for faults in stages if faults.failed)
        found.append(Notice("frames-failed", {"frames": failed, "first": index, "reason": reason}))
    if blind:
        first_blind = next(faults.first_without_depth for faults in stages if faults.without_depth)
        found.append(Notice("frames-without-depth", {"frames": blind, "first": first_blind}))
    return found


def _with_depth(frame: Frame, depth_mm: np.ndarray, sigma_mm: np.ndarray | None) -> Frame:
    """Return a frame with depth, and its standard deviation where there is one, from any size to the frame's."""
    sigma_mm = None if sigma_mm is None else resampled(sigma_mm, frame.camera)
    return replace(frame, depth_mm=resampled(depth_mm, frame.camera), depth_sigma_mm=sigma_mm)
