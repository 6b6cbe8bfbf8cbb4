"""Submaps: the frames that share a world, sorted, adjusted and merged by loop closures after the last frame."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame, Rows, RowTable, rows_in_memory
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.kept import Kept
from scopemap.engine.mapping.backend import Backend
from scopemap.engine.mapping.feature_tracks import KeyframeMatches
from scopemap.engine.mapping.frame_correction import FrameCorrection, KeyframeStep, TrackedPose
from scopemap.engine.mapping.lens import LensKinds
from scopemap.engine.mapping.map_merging import Part
from scopemap.engine.mapping.segments import Segment
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.features import FeatureDetector
from scopemap.engine.tracking.track import Track

TriangulatedDepths = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray] | None]
"""Returns a frame's triangulated depth, sigma of its ln, and ln of its factor, by number and depth; None: unknown."""

_TRACKED = np.dtype(
    [
        ("index", np.int64),
        ("map", np.int64),
        ("keyframe", np.int64),
        ("T_world_camera", np.float64, (4, 4)),
        ("segment", np.int64),
    ]
)
"""Number of a frame, and its `TrackedPose`."""

LEAST_FRAMES = 10  # by hand
"""Tracked frames that a submap needs to be a result beside the largest."""


@dataclass(frozen=True)
class Submap:
    """Frames that share a world after the last frame.

    Attributes
    ----------
    main : number of its map with most frames. maps : numbers of all maps merged into it.
    frames : numbers of the frames tracked in these. main_frames : of those tracked in the main map. segments : parts of
    its time, in order; one surface fits the frames of each.
    """

    main: int
    maps: tuple[int, ...]
    frames: frozenset[int]
    main_frames: frozenset[int]
    segments: tuple[Segment, ...]

    def depth_factor(self, index: int) -> float:
        """Return the factor of the whole depth of the frame with this number."""
        correction = self.correction(index)
        return 1.0 if correction is None else correction.depth_factor(index)

    def correction(self, index: int) -> FrameCorrection | None:
        """Return the correction of the frame with this number; None: it is as tracked."""
        return self.segments[self.segment_of(index)].correction

    def segment_of(self, index: int) -> int:
        """Return the number of the segment that a frame of this number is in."""
        return min(bisect_left(self._lasts, index), len(self.segments) - 1)

    @cached_property
    def _lasts(self) -> list[int]:
        return [segment.last for segment in self.segments]


class Mapper:
    """Takes every track and every keyframe, and returns the submaps after the last frame.

    flow : between keyframes, for the thread of the back end alone; "none" leaves all frames as tracked. table : where
    poses and observations are kept until the last frame. features : of keyframes, for loop closure; None: SIFT.
    anchored : as `scale_by_network` takes it.
    """

    _backend: Kept[Backend | None]
    _rows: Kept[Rows]
    _last: Kept[tuple[int, TrackedPose] | None] = None
    _lost_frames: Kept[int] = 0
    _relocalised: Kept[set[tuple[Part, Part]]]

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
        self._relocalised = set()
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
            self._relocalised.add(((part.map, part.segment), (found_in.map, found_in.segment)))

    @property
    def adjusts(self) -> bool:
        """Whether keyframes are adjusted after the last frame."""
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

        def part(number: int, segment: int) -> Part:
            return (earlier.map if number == own else number), segment

        pairs = [((earlier.map, earlier.segment), (own, after.segment)), *self._relocalised]
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
        not_first = self._split_maps() | self._extended
        frames = Counter(pose.map for pose in self._tracked.values())
        found: list[Submap] = []
        while frames:
            main = max(frames, key=lambda number: frames[number])
            submap = self._submap(main, frames, not_first)
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
            return maps.get((pose.map, pose.segment), maps.get((aligned_to.map, aligned_to.segment), pose.map))

        before = {pose.map for pose in self._tracked.values()}
        self._tracked = {index: pose._replace(map=number(pose)) for index, pose in self._tracked.items()}
        return {pose.map for pose in self._tracked.values()} - before

    def _submap(self, main: int, among: Collection[int], not_first: Collection[int]) -> Submap:
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
        for segment in self._from_first_frame(adjusted, min(frames), not_first):
            own = frozenset(index for index in frames if before < index <= segment.last)
            segments.append(replace(segment, frames=own))
            before = segment.last
        return Submap(main, maps, frames, self._frames_of((main,)), tuple(segments))

    def _from_first_frame(self, segments: Sequence[Segment], first: int, not_first: Collection[int]) -> list[Segment]:
        """Return the segments in the world of the first frame: that of maps that begin elsewhere is another one."""
        tracked = self._tracked[first]
        if tracked.map not in not_first:
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
            numbers = (found[name].tolist() for name in ("index", "map", "keyframe", "segment"))
            self._read = {
                index: TrackedPose(number, keyframe, T, segment)
                for index, number, keyframe, segment, T in zip(*numbers, found["T_world_camera"], strict=True)
            }
        return self._read | self._changed

    def _pose(self, track: Track) -> TrackedPose:
        return TrackedPose(track.map, track.keyframe, track.T_world_camera, self._lost_frames)


class FinalFrames:
    """Frames of a segment, in order, with poses and depth corrected by the back end.

    Attributes
    ----------
    T_world_camera : corrected poses (4, 4) by number. keyframes : numbers of those whose depth can be triangulated:
    none where no rigid scene explains the observations.
    """

    def __init__(
        self, correction: FrameCorrection | None, T_world_camera: Mapping[int, np.ndarray], read: Callable[[int], Frame]
    ) -> None:
        """Take poses as tracked by number, and what returns a stored frame by its number, from any thread."""
        self._stored, self._correction = read, correction
        correct = correction.pose if correction is not None else lambda _, pose: pose
        self.T_world_camera = {index: correct(index, pose) for index, pose in sorted(T_world_camera.items())}
        adjusted = correction.index.tolist() if correction is not None and not correction.refused else []
        self.keyframes = [index for index in adjusted if index in self.T_world_camera]

    def frames(
        self,
        triangulated: TriangulatedDepths | None,
        without: Callable[[Frame], Frame] = lambda frame: frame,
        among: Iterable[int] | None = None,
    ) -> Iterator[Frame]:
        """Yield the frames, with triangulated depth where there is one.

        without : returns a frame without the pixels that show no tissue. among : numbers of the frames; None: all.
        """
        for index in self.T_world_camera if among is None else among:
            frame = self._corrected(index)
            found = None if triangulated is None else triangulated(index, _usable_depth_mm(frame))
            frame = without(frame)
            if found is not None:
                # The factor, not the depth: pixels that are masked keep a depth, too.
                _, sigma, log_factor = found
                depth_mm = np.asarray(frame.depth_mm) * np.exp(log_factor)
                frame = replace(frame, depth_mm=depth_mm, depth_sigma_mm=sigma * depth_mm)
            yield frame

    def _corrected(self, index: int) -> Frame:
        frame = replace(self._stored(index), T_world_camera=self.T_world_camera[index])
        return frame if self._correction is None else _with_depth(frame, self._correction)

    def view(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return picture (H, W, 3) and corrected usable depth (H, W) mm of a frame, from any thread."""
        frame = self._corrected(index)
        return frame.rgb, _usable_depth_mm(frame)


def _with_depth(frame: Frame, correction: FrameCorrection) -> Frame:
    """Return a frame with its depth and the standard deviation of that corrected."""
    assert frame.depth_mm is not None
    factors = correction.depth_factors(frame.index, frame.depth_mm)
    sigma_mm = None if frame.depth_sigma_mm is None else frame.depth_sigma_mm * factors
    return replace(frame, depth_mm=frame.depth_mm * factors, depth_sigma_mm=sigma_mm)


def _usable_depth_mm(frame: Frame) -> np.ndarray:
    depth_mm = np.asarray(frame.depth_mm)
    return np.where(frame.valid & (depth_mm > 0), depth_mm, np.float32(np.nan))
