"""Mapper: takes every track and every keyframe while frames are tracked, and returns the submaps after the last one.

`Backend` collects the keyframes, and has the hypotheses tried that explain them. `Mapper` sorts the frames by maps.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame, RowTable, rows_in_memory
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.mapping.correction import KeyframeStep, TrackedPose
from scopemap.engine.mapping.depth_correction import depth_grid
from scopemap.engine.mapping.feature_tracks import FeatureTracks, KeyframeMatches
from scopemap.engine.mapping.hypotheses import explain
from scopemap.engine.mapping.keyframes import Keyframes
from scopemap.engine.mapping.lens import LensKinds
from scopemap.engine.mapping.loop_closure import LOOP, Loop, LoopFinder
from scopemap.engine.mapping.pose_graph import Part
from scopemap.engine.mapping.segments import Segment, Submap
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.features import FeatureDetector
from scopemap.engine.tracking.track import Track

_TRACKED = np.dtype(
    [
        ("index", np.int64),
        ("map", np.int64),
        ("keyframe", np.int64),
        ("T_world_camera", np.float64, (4, 4)),
        ("lost_before", np.int64),
    ]
)
"""Number of a frame, and its `TrackedPose`."""

LEAST_FRAMES = 10  # by hand
"""Tracked frames that a submap needs to be a result beside the largest."""
# Those of about 300 keyframes: with more, memory and time of the adjustment would grow without any use to the poses.
MOST_OBSERVATIONS = 1_000_000  # by hand
"""Of an adjustment, unless memory is limited."""


class Backend:
    """Takes keyframes one by one, and returns the correction of all frames.

    Feature tracks and loop closures are computed in another thread; no other one may use `flow` meanwhile. table : of
    observations until the last keyframe. anchored : as `scale_by_network` takes it.
    """

    _grid_shape: tuple[int, int] = (0, 0)
    _camera: PinholeCamera | None = None

    def __init__(
        self,
        settings: MappingSettings,
        flow: FlowEstimator,
        table: RowTable = rows_in_memory,
        features: FeatureDetector | None = None,
        anchored: bool = False,
    ) -> None:
        self._settings, self._anchored = settings, anchored
        self._frames, self._tracked = list[int](), list[TrackedPose]()
        self._steps, self._log_scales = list[KeyframeStep](), list[float]()
        self._depths_mm, self._loops = table("depth_grids", np.dtype(np.float32)), table("loops", LOOP)
        self._tracks = FeatureTracks(flow, table)
        self._finder = LoopFinder(settings, table, features) if settings.min_loop_inliers > 0 else None
        self._all_weighed = False
        self.most_observations = MOST_OBSERVATIONS
        """About so many are adjusted."""
        self.lenses = LensKinds()
        """What the lens may be."""
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="backend")
        self._pending: deque[Future[None]] = deque()

    @property
    def keyframe_count(self) -> int:
        """Number of keyframes of all maps."""
        return len(self._frames)

    def keyframes(self, map_number: int = 0) -> int:
        """Return the number of keyframes of a map."""
        return sum(pose.map == map_number for pose in self._tracked)

    def add(
        self,
        keyframe: Frame,
        tracked: TrackedPose | None = None,
        matches: KeyframeMatches | None = None,
        step: KeyframeStep | None = None,
    ) -> None:
        """Take a keyframe with depth and pose, later than those before; poses of one map share a world.

        tracked : pose as tracked; None: in map 0, from the keyframe before. matches : what is known of its feature
        tracks. step : by how much it was moved as it came; None: not at all. Raises an error of an earlier keyframe's
        feature tracks, and ValueError without a pose or a depth.
        """
        if keyframe.T_world_camera is None or keyframe.depth_mm is None:
            raise ValueError("a keyframe needs a pose and a depth")
        if tracked is None:
            reference = self._frames[-1] if self._frames else keyframe.index
            tracked = TrackedPose(0, reference, keyframe.T_world_camera)
        self._frames.append(keyframe.index)
        self._tracked.append(tracked)
        self._steps.append(step or KeyframeStep())
        self._log_scales.append(math.log(keyframe.depth_scale))
        grid = depth_grid(keyframe.depth_mm, keyframe.valid)
        self._depths_mm.append(grid.ravel())
        self._grid_shape = grid.shape
        while self._pending and self._pending[0].done():
            self._pending.popleft().result()
        self._pending.append(self._worker.submit(self._observe, keyframe, tracked.map, matches))

    def replace_tracked(self, change: Callable[[TrackedPose], TrackedPose]) -> None:
        """Change the poses as tracked of all keyframes, after the last one."""
        self._tracked = [change(pose) for pose in self._tracked]

    def split(self, relocalised: Collection[tuple[Part, Part]]) -> dict[Part, int]:
        """Split maps after the last keyframe, where nothing supports a motion across a loss: see `split_maps`."""
        self.settle()
        maps = {} if self._camera is None else self._collected(self._camera).split(relocalised)
        if maps:
            self._tracked = [pose._replace(map=maps[pose.map, pose.lost_before]) for pose in self._tracked]
        return maps

    def settle(self) -> None:
        """Wait for the features of all keyframes so far."""
        while self._pending:
            self._pending.popleft().result()

    def adjust(
        self,
        map_number: int = 0,
        tracked: Mapping[int, TrackedPose] | None = None,
        among: Collection[int] | None = None,
    ) -> list[Segment]:
        """Return the segments of a map and of the maps merged with it, after the last keyframe: one where one scene
        explains all of it.

        tracked : poses as tracked by number of the frame; needed for several maps. among : numbers of the maps that may
        be merged; None: all. Where an adjustment is refused, keyframes stay as tracked, and only their steps are spread
        over the frames that lead to them. Raises ValueError where the map has no keyframe.
        """
        if not self.keyframes(map_number):
            raise ValueError("nothing to adjust: no keyframe was added")
        self.settle()
        self._worker.shutdown()
        if self._finder is not None and not self._all_weighed:
            self._take(self._finder.between([pose.map for pose in self._tracked]))
            self._all_weighed = True
        allowed = {pose.map for pose in self._tracked} if among is None else set(among)
        assert self._camera is not None
        return explain(self._collected(self._camera), map_number, allowed, tracked or {}, self.lenses)

    def _collected(self, camera: PinholeCamera) -> Keyframes:
        return Keyframes(
            self._frames,
            self._tracked,
            self._steps,
            np.array(self._log_scales),
            self._depths_mm,
            self._grid_shape,
            self._tracks,
            self._loops,
            camera,
            self._settings,
            self._anchored,
            self.most_observations,
        )

    def _observe(self, keyframe: Frame, map_number: int, matches: KeyframeMatches | None) -> None:
        """Add a keyframe's feature tracks and loop closures."""
        self._camera = keyframe.camera
        self._tracks.add(keyframe, map_number, matches)
        if self._finder is not None:
            self._take(self._finder.add(keyframe, map_number))

    def _take(self, loops: Sequence[Loop]) -> None:
        for loop in loops:
            self._tracks.add_loop(loop)
            self._loops.append(loop.row())


class Mapper:
    """Takes every track and every keyframe, and returns the submaps after the last frame.

    flow : between keyframes, for the thread of the back end alone; "none" leaves all frames as tracked. table : where
    poses and observations are kept until the last frame. features : of keyframes, for loop closure; None: SIFT.
    anchored : as `scale_by_network` takes it.
    """

    _last: tuple[int, TrackedPose] | None = None

    def __init__(
        self,
        settings: MappingSettings,
        flow: FlowEstimator,
        table: RowTable = rows_in_memory,
        features: FeatureDetector | None = None,
        anchored: bool = False,
    ) -> None:
        links = settings.global_adjustment and flow.name != "none"
        self._backend = Backend(settings, flow, table, features, anchored) if links else None
        self._rows = table("tracked_poses", _TRACKED)
        self._tracked: dict[int, TrackedPose] = {}
        self._relocalised, self._lost_frames = set[tuple[Part, Part]](), 0
        # What follows changes after the last frame.
        self._changed: dict[int, TrackedPose] = {}
        self._extended: set[int] = set()
        self._read: dict[int, TrackedPose] | None = None  # what the rows hold; None: not read since they changed

    def observe(self, track: Track) -> None:
        """Note where a frame was tracked, or that it was lost."""
        if track.status == "lost":
            self._lost_frames += 1
            return
        part = self._pose(track)
        self._last = track.index, part
        self._rows.append(np.array([(track.index, *part)], _TRACKED))
        self._read = None
        if track.relocalised and (found_in := self._poses().get(track.keyframe)) is not None:
            self._relocalised.add(((part.map, part.lost_before), (found_in.map, found_in.lost_before)))

    @property
    def has_keyframes(self) -> bool:
        """Whether there are keyframes to adjust after the last frame."""
        return self._backend is not None and bool(self._backend.keyframe_count)

    def add_found(self, track: Track) -> None:
        """Note where a frame was tracked after all, after the last frame: it moves with its keyframe."""
        self._changed[track.index] = self._poses()[track.keyframe]._replace(
            keyframe=track.keyframe, T_world_camera=track.T_world_camera
        )
        self._extended.add(track.map)

    def join(self, start: int, last: int, T_earlier_own: np.ndarray) -> None:
        """Make the map of frame `start` part of that of an earlier frame `last`; T_earlier_own : (4, 4), of worlds."""
        poses = self._poses()
        earlier, after = poses[last], poses[start]
        own = after.map

        def joined(pose: TrackedPose) -> TrackedPose:
            moved = pose._replace(map=earlier.map, T_world_camera=T_earlier_own @ pose.T_world_camera)
            return moved if pose.map == own else pose

        self._changed |= {index: joined(pose) for index, pose in poses.items() if pose.map == own}

        def part(number: int, lost_before: int) -> Part:
            return (earlier.map if number == own else number), lost_before

        pairs = [((earlier.map, earlier.lost_before), (own, after.lost_before)), *self._relocalised]
        self._relocalised = {(part(*one), part(*other)) for one, other in pairs}
        if self._backend is not None:
            self._backend.replace_tracked(joined)

    def limit(self, observations: int) -> None:
        """Have at most about so many observations adjusted."""
        if self._backend is not None:
            self._backend.most_observations = observations

    def try_lenses(self, lenses: LensKinds) -> None:
        """Have the adjustment after the last frame tell which of these lenses the camera has."""
        if self._backend is not None:
            self._backend.lenses = lenses

    def stay_as_tracked(self) -> None:
        """Adjust nothing after the last frame; any thread may call it."""
        self._backend = None

    def settle(self) -> None:
        """Wait for what was begun in other threads."""
        if self._backend is not None:
            self._backend.settle()

    def forget(self, indices: Collection[int]) -> None:
        """Forget where these frames were tracked: they are in no submap."""
        self._rows.keep(~np.isin(self._rows.read()["index"], list(indices)))
        self._read = None

    def add_keyframe(
        self,
        keyframe: Frame,
        track: Track,
        matches: KeyframeMatches | None = None,
        step: KeyframeStep | None = None,
    ) -> None:
        """Take a keyframe with refined depth and pose, to be adjusted with the others; it may be observed already.

        matches : what is known of its feature tracks. step : by how much it was moved as it came.
        """
        backend = self._backend  # another thread may have the frames stay as tracked
        if backend is not None:
            observed = self._last is not None and self._last[0] == track.index
            tracked = self._last[1] if self._last and observed else self._pose(track)
            backend.add(keyframe, tracked, matches, step)

    def submaps(self) -> tuple[list[Submap], list[Notice]]:
        """Return the submaps, most frames first, and a notice of frames that are not in the first.

        All keyframes are adjusted together here: poses and depths that were handed on before need the submap's
        correction. Small submaps, but for the first, are left out.
        """
        self._tracked = self._poses()
        begins_elsewhere = self._split_maps() | self._extended
        frames = Counter(pose.map for pose in self._tracked.values())
        found: list[Submap] = []
        while frames:
            main = max(frames, key=lambda number: frames[number])
            submap = self._submap(main, frames, begins_elsewhere)
            found.append(submap)
            for number in submap.maps:
                del frames[number]
        found.sort(key=lambda submap: -len(submap.frames))
        kept = found[:1] + [submap for submap in found[1:] if len(submap.frames) >= LEAST_FRAMES]
        if len(found) < 2:
            return kept, []
        counts = {"submaps": len(found), "frames": len(kept[0].frames), "tracked": len(self._tracked)}
        return kept, [Notice("submaps-apart", counts | {"saved": len(kept) - 1, "least": LEAST_FRAMES})]

    def _split_maps(self) -> set[int]:
        """Give parts of maps that nothing ties to the others numbers of their own; return these."""
        maps = {} if self._backend is None else self._backend.split(self._relocalised)

        def number(pose: TrackedPose) -> int:
            # A part without a keyframe is in the map that it was aligned to.
            aligned_to = self._tracked.get(pose.keyframe, pose)
            return maps.get((pose.map, pose.lost_before), maps.get((aligned_to.map, aligned_to.lost_before), pose.map))

        before = {pose.map for pose in self._tracked.values()}
        self._tracked = {index: pose._replace(map=number(pose)) for index, pose in self._tracked.items()}
        return {pose.map for pose in self._tracked.values()} - before

    def _submap(self, main: int, among: Collection[int], begins_elsewhere: Collection[int]) -> Submap:
        """Return the submap of a map and of those among others that are merged with it, adjusted."""
        if self._backend is None or not self._backend.keyframes(main):
            frames = self._frames_of((main,))
            return Submap(main, (main,), frames, frames, (Segment(max(frames), frames=frames),))
        adjusted = self._backend.adjust(main, self._tracked, among=among)
        assert adjusted[0].correction is not None
        maps = tuple(sorted(adjusted[0].correction.S_common_map))
        frames = self._frames_of(maps)
        adjusted[-1] = replace(adjusted[-1], last=max(frames))
        before, segments = -1, []
        for segment in self._from_first_frame(adjusted, min(frames), begins_elsewhere):
            own = frozenset(index for index in frames if before < index <= segment.last)
            segments.append(replace(segment, frames=own))
            before = segment.last
        return Submap(main, maps, frames, self._frames_of((main,)), tuple(segments))

    def _from_first_frame(
        self, segments: Sequence[Segment], first: int, begins_elsewhere: Collection[int]
    ) -> list[Segment]:
        """Return the segments in the world of the first frame: that of maps that begin elsewhere is another one."""
        tracked = self._tracked[first]
        if tracked.map not in begins_elsewhere:
            return [*segments]
        assert segments[0].correction is not None
        T_first_world = inverse(segments[0].correction.pose(first, tracked.T_world_camera))
        return [replace(one, correction=one.correction and one.correction.in_world(T_first_world)) for one in segments]

    def _frames_of(self, maps: tuple[int, ...]) -> frozenset[int]:
        return frozenset(index for index, pose in self._tracked.items() if pose.map in maps)

    def _poses(self) -> dict[int, TrackedPose]:
        """Return the poses of all tracked frames by their numbers; after the last frame they are read once."""
        if self._read is None:
            found = self._rows.read()
            numbers = (found[name].tolist() for name in ("index", "map", "keyframe", "lost_before"))
            self._read = {
                index: TrackedPose(number, keyframe, T, lost_before)
                for index, number, keyframe, lost_before, T in zip(*numbers, found["T_world_camera"], strict=True)
            }
        return self._read | self._changed

    def _pose(self, track: Track) -> TrackedPose:
        return TrackedPose(track.map, track.keyframe, track.T_world_camera, self._lost_frames)
