"""The pipeline: frames, in order, to poses, depth and a surface. No files, clocks or printing: see `runner/run.py`.

Each frame:

    estimate    mask -> raw metric depth, and instruments, which are left out of all that follows
    match       correspondence with the previous frame
    track       track against the keyframe -> refine depth with the motion known (MAPIS) -> new keyframe
                -> smooth (WEMA)
    fuse        store, or fuse (TSDF)

After the last frame:

    adjust      track lost frames backwards -> adjust all keyframes, close loops, merge maps: submaps, and segments
    surface     of each segment: triangulate keyframes -> find free space -> correct, carve and choose frames
                -> fuse (TSDF) -> finish the mesh -> check it

A frame is tracked by the keyframe's corners, or by RTDL. The preset `paper` refines before it tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

from scopemap.engine.backwards import BackwardTracker, MapMerge
from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config
from scopemap.engine.estimators import Estimators
from scopemap.engine.faults import notices_of_faults
from scopemap.engine.finishing import Execution, SegmentFinishing, SegmentSurface
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.frame_store import FrameStore, SpreadFrames
from scopemap.engine.fusion.surface_fusion import SurfaceFusion
from scopemap.engine.mapping.local_adjustment import LocalAdjustment
from scopemap.engine.mapping.mapper import Mapper
from scopemap.engine.mapping.segments import Segment, Submap
from scopemap.engine.notices import Notice
from scopemap.engine.odometry import Odometry, Step
from scopemap.engine.preprocessing import Matching, PreprocessedFrame, Preprocessing
from scopemap.engine.tracking.track import FrameTracker, Track, TrackedFrames
from scopemap.engine.tracking.tracker import Tracker


@dataclass(frozen=True)
class Adjusted:
    """What is known after the last frame.

    backwards : tracks of frames that were lost before, and maps that lead back to earlier ones, in the order in which
    they were found. submaps : most frames first. notices : about these.
    """

    backwards: list[Track | MapMerge]
    submaps: list[Submap]
    notices: list[Notice]


class Pipeline:
    """One run over one sequence: `steps` and `fuse` of each frame, in order; then `adjust`, and `surface` per segment.

    Each stage has its own state, so each may run in a thread of its own. store : for frames that are fused after the
    last one. tracker : replaces the one of `config.tracking` (baselines); it does not track backwards.
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
        self._new_tracker = partial(Tracker, config.tracking, estimators.corner_flow, estimators.features)
        self._has_own_tracker = tracker is None and estimators.tracker is None
        if tracker is None:
            tracker = self._new_tracker() if estimators.tracker is None else estimators.tracker()
        mapping, features, anchored = config.mapping, estimators.features, config.depth.is_anchored
        mapper = Mapper(mapping, estimators.keyframe_flow, store.table, features, anchored)
        local = mapping.local_window and estimators.keyframe_flow.name != "none"
        # In the tracker's thread, so with its flow: that between keyframes is the back end's.
        adjustment = LocalAdjustment(mapping, estimators.corner_flow) if local else None
        self.odometry = Odometry(config, tracker, mapper, adjustment)
        self.fusion = SurfaceFusion(config.fusion, store, corrected=mapping.global_adjustment)

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

    @property
    def steps(self) -> dict[str, Callable[[Any], Any]]:
        """What is done with each frame before `fuse`, in order, by the stages that do it.

        The first takes a frame; each takes what the one before returns, and the last returns a `Step`.
        """
        return {"preprocess": self.estimate, "match": self.match, "track": self.track}

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

    def adjust(self, tracked: TrackedFrames, execution: Execution) -> Adjusted:
        """Track lost frames backwards, and adjust all keyframes; tracked : all frames, after the last one."""
        found: list[Track | MapMerge] = []
        if self._tracks_backwards:
            most_lost, store = self.config.tracking.new_map_after, self.fusion.store
            tracker = BackwardTracker(tracked, store, self._new_tracker, most_lost)
            found = execution.timed("track backwards", tracker.found, self.mapper)
        submaps, notices = execution.timed("back end", self.mapper.submaps)
        return Adjusted(found, submaps, notices)

    def surface(
        self,
        submap: Submap,
        segment: Segment,
        tracked: TrackedFrames,
        camera: PinholeCamera,
        execution: Execution,
        checked: SpreadFrames | None = None,
    ) -> SegmentSurface:
        """Return the surface of a segment of a submap.

        tracked : all frames of the run, with what was tracked backwards. camera : of all frames. checked : frames at
        which a surface that was fused at once is checked; those of stored frames are added.
        """
        adjusted = self.odometry.notices(submap.main) if segment.correction is None else segment.correction.notices
        finishing = SegmentFinishing(self.fusion, self.estimators, submap, segment, tracked, checked)
        with closing(finishing):
            if self.config.mapping.triangulate_depth and (execution.keeps_depth or self.config.fusion.enabled):
                finishing.triangulate(camera)
            execution.timed("free space", finishing.find_free_space)
            final = execution.final(execution.in_thread(finishing.corrected(), "correct"))
            chosen = execution.in_thread(finishing.chosen(final), "write")
            with closing(chosen):
                fused = execution.timed("fuse", finishing.fuse, chosen)
        fused = execution.timed("finish mesh", finishing.finish, fused)
        surface: SegmentSurface = execution.timed("check surface", finishing.check, fused, adjusted)
        return surface

    @property
    def _tracks_backwards(self) -> bool:
        """Whether lost frames are tracked backwards: by scopemap's tracker, where lost cameras are looked for.

        Poses must not be smoothed, and a back end must adjust stored frames and merge maps.
        """
        config = self.config
        relocalises = config.tracking.relocalisation_keyframes > 0 and config.smoothing.method == "none"
        merges = self.fusion.at_end and self.mapper.has_keyframes and config.mapping.min_loop_inliers > 0
        return self._has_own_tracker and relocalises and merges
