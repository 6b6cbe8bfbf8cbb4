"""The pipeline: frames, in order, to poses, depth and a surface. No files, clocks or printing: see `runner/run.py`.

    estimate    mask -> raw metric depth, and instruments, which are left out of all that follows
    match       correspondence with the previous frame
    track       track against the keyframe -> refine depth with the motion known (MAPIS) -> new keyframe
                -> smooth (WEMA)
    fuse        store, or fuse (TSDF)
    mapper.submaps    after the last frame: adjust all keyframes, close loops, merge maps
    finishing.py      of each submap: correct, triangulate, carve, fuse (TSDF), check

A frame is tracked by the keyframe's corners, or by RTDL. The preset `paper` refines before it tracks.
"""

from __future__ import annotations

from scopemap.engine.config import Config
from scopemap.engine.estimators import Estimators
from scopemap.engine.faults import notices_of_faults
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import FrameStore
from scopemap.engine.fusion.surface_fusion import SurfaceFusion
from scopemap.engine.mapping.local_adjustment import LocalAdjustment
from scopemap.engine.mapping.mapper import Mapper
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Odometry, Step
from scopemap.engine.preprocessing import Matching, PreprocessedFrame, Preprocessing
from scopemap.engine.tracking.track import FrameTracker
from scopemap.engine.tracking.tracker import Tracker


class Pipeline:
    """One run over one sequence; frames go through `estimate`, `match`, `track` and `fuse` in order, each once.

    Each stage has its own state, so each may run in a thread of its own. store : for frames that are fused after the
    last one. tracker : replaces the one of `config.tracking` (baselines).
    """

    def __init__(
        self,
        config: Config,
        estimators: Estimators,
        store: FrameStore | None = None,
        tracker: FrameTracker | None = None,
    ) -> None:
        self.config = config
        store = FrameStore() if store is None else store
        self.preprocessing, self.matching = Preprocessing(config, estimators), Matching(config, estimators)
        if tracker is None and estimators.tracker is not None:
            tracker = estimators.tracker()
        tracker = tracker or Tracker(config.tracking, estimators.corner_flow, estimators.features)
        mapping, features, anchored = config.mapping, estimators.features, config.depth.is_anchored
        mapper = Mapper(mapping, estimators.keyframe_flow, store.table, features, anchored)
        local = mapping.local_window and estimators.keyframe_flow.name != "none"
        # In the tracker's thread, so with its flow: that between keyframes is the back end's.
        adjustment = LocalAdjustment(mapping, estimators.corner_flow) if local else None
        self.odometry = Odometry(config, tracker, mapper, adjustment)
        self.fusion = SurfaceFusion(config.fusion, store, corrected=mapping.at_end)

    @property
    def stages(self) -> dict[str, Preprocessing | Matching | Odometry]:
        """The stages by their names, each in a thread of its own and with what it keeps; that of `fuse` is `fusion`."""
        return {"preprocess": self.preprocessing, "match": self.matching, "track": self.odometry}

    @property
    def estimators(self) -> Estimators:
        """The interchangeable parts that look at images."""
        return self.preprocessing.estimators

    @property
    def mapper(self) -> Mapper:
        """Where keyframes go, and submaps come from."""
        return self.odometry.mapper

    @property
    def notices(self) -> list[Notice]:
        """What was not, or could not be, processed so far."""
        return self.preprocessing.notices + notices_of_faults([stage.faults for stage in self.stages.values()])

    def estimate(self, frame: Frame) -> PreprocessedFrame:
        """Mask a frame and estimate its raw depth; a frame with which that fails has no usable pixel, and is lost."""
        return self.preprocessing.estimate(frame)

    def match(self, estimated: PreprocessedFrame) -> PreprocessedFrame:
        """Add the correspondence of a frame with the one before, where its depth is to be refined with it."""
        return self.matching.match(estimated)

    def track(self, preprocessed: PreprocessedFrame) -> Step:
        """Track a frame, refine its depth, make it a keyframe where one is due; one with which that fails is lost."""
        return self.odometry.track(preprocessed)

    def fuse(self, step: Step) -> None:
        """Fuse a tracked frame, store it until the last one, or both; of one that was skipped nothing is kept."""
        if not step.skipped:
            self.fusion.put(step.frame, step.track.map)

    def preprocess(self, frame: Frame) -> PreprocessedFrame:
        """Estimate and match: all that needs no motion."""
        return self.match(self.estimate(frame))

    def step(self, preprocessed: PreprocessedFrame) -> Step:
        """Track and fuse."""
        step = self.track(preprocessed)
        self.fuse(step)
        return step
