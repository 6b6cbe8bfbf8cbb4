"""The pipeline: frames, in order, to poses, depth and a surface. No files, clocks or printing: see `runner.py`.

    preprocess  mask -> raw metric depth -> correspondence with the previous frame
    step        track against the keyframe (RTDL) -> refine depth with the motion known (MAPIS) -> new keyframe
                -> smooth (WEMA) -> store, or fuse (TSDF)
    mapper.submaps    after the last frame: adjust all keyframes, close loops, merge maps
    fusion.fuse       fuse the stored frames of a submap, corrected (TSDF)

`preprocess` needs no motion, so it may run a frame ahead of `step`. The preset `paper` refines before it tracks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.config import Config
from scopemap.depth.anchor import AnchoredDepth
from scopemap.depth.correspondence import DenseCorrespondence, DenseMatcher
from scopemap.depth.estimate import DepthEstimator, DepthKind, PerceptualDistance
from scopemap.depth.mapis import Mapis, RefinedDepth
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Frame
from scopemap.fusion.frame_store import FrameStore
from scopemap.fusion.volume import SurfaceFusion
from scopemap.mapping.submaps import Mapper
from scopemap.masking.masker import Masker, StoredMasks
from scopemap.tracking.smoothing import create_smoother
from scopemap.tracking.track import FrameTracker, Track, motion_between
from scopemap.tracking.tracker import Tracker


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


@dataclass(frozen=True)
class PreprocessedFrame:
    """Results that need no motion: `frame` is masked, with raw depth of `kind`; `anchored`: fixed the scale.

    depth_note : that most of its depth is beyond the limit; else "".
    """

    frame: Frame
    kind: DepthKind
    correspondence: DenseCorrespondence | None
    anchored: bool
    depth_note: str = ""


@dataclass(frozen=True)
class Step:
    """All results for a frame; `frame` has refined depth and, unless it is lost, its pose as tracked."""

    frame: Frame
    track: Track
    raw_mm: np.ndarray
    refined: RefinedDepth


class Pipeline:
    """One run over one sequence; frames go through `preprocess` and `step` in order, each once.

    store : for frames that are fused after the last one. tracker : replaces the one of `config.tracking` (baselines).
    """

    def __init__(
        self,
        config: Config,
        estimators: Estimators,
        store: FrameStore | None = None,
        tracker: FrameTracker | None = None,
    ) -> None:
        self.config, self.estimators = config, estimators
        self.fusion = SurfaceFusion(config.fusion, store or FrameStore(), corrected=config.mapping.method == "full")
        # Frames that are fused at once cannot be sorted into submaps.
        tracking = config.tracking.model_copy(update={"new_map_after": 0} if self.fusion.at_once else {})
        self._masker = Masker(config.mask, estimators.masks)
        self._matcher = DenseMatcher(config.mapis, estimators.flow, estimators.perceptual)
        self._tracker = tracker or Tracker(tracking, estimators.corner_flow)
        self._mapis = Mapis(config.mapis)
        self._smooth = create_smoother(config.smoothing)
        self.mapper = Mapper(config.mapping, estimators.keyframe_flow)
        self._last_track: Track | None = None

    def preprocess(self, frame: Frame) -> PreprocessedFrame:
        """Mask a frame, estimate its raw depth and its correspondence with the previous frame."""
        frame = self._masker(frame)
        # A frame that the tracker refuses must not fix the scale of depth.
        usable = frame.valid.mean() >= self.config.tracking.min_valid_share
        shown = frame if usable else replace(frame, valid=np.zeros_like(frame.valid))
        estimate = self.estimators.depth.estimate(shown)
        raw = self.estimators.anchor.metric(estimate, shown)
        correspondence = self._matcher.match(frame.rgb, frame.valid, wanted=self._mapis.needs_previous(estimate.kind))
        frame = replace(frame, depth_mm=raw.depth_mm, depth_sigma_mm=raw.sigma_mm)
        anchored = self.estimators.anchor.just_fitted
        return PreprocessedFrame(frame, estimate.kind, correspondence, anchored, raw.limit_note)

    def step(self, preprocessed: PreprocessedFrame) -> Step:
        """Track a frame, refine its depth, make it a keyframe where one is due, store or fuse it."""
        refined = self._refine(preprocessed, None) if self.config.mapis.paper.order == "refine-first" else None
        track, last = self._tracker.track(preprocessed.frame), self._last_track
        if track.status == "lost" or (last is not None and last.map != track.map):
            self._reset()
        refined = refined or self._refine(preprocessed, motion_between(last, track))
        frame = replace(preprocessed.frame, depth_mm=refined.depth_mm, depth_sigma_mm=refined.sigma_mm)
        track = self._with_keyframe(track, frame, preprocessed)
        if track.status == "lost":
            self._reset()
        else:
            frame = replace(frame, T_world_camera=self._smooth(track.T_world_camera))
        self.mapper.observe(track)
        self.fusion.put(frame)
        self._last_track = track
        return Step(frame, track, np.asarray(preprocessed.frame.depth_mm), refined)

    def _refine(self, preprocessed: PreprocessedFrame, T_current_previous: np.ndarray | None) -> RefinedDepth:
        raw = preprocessed.frame
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

    def _with_keyframe(self, track: Track, frame: Frame, preprocessed: PreprocessedFrame) -> Track:
        """Make a frame the keyframe where one is due; the first one of a map that cannot be one is lost."""
        if track.status == "lost" or not self._tracker.needs_keyframe():
            return track
        keyframe, kind = replace(frame, T_world_camera=track.T_world_camera), preprocessed.kind
        measured = kind == "measured" and not self._mapis.needs_previous(kind)  # not after MAPIS changed it
        inserted = self._tracker.insert_keyframe(keyframe, measured=measured)
        if inserted and kind != "measured":  # with measured depth tracking alone is better
            self.mapper.add_keyframe(keyframe, track)
        if track.status == "initial" and not inserted:
            unknown = preprocessed.depth_note or "too little of its depth is known to start from"
            return replace(track, status="lost", reason=unknown)
        return track
