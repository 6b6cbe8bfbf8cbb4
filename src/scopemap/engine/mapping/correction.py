"""Correction: what corrects depth while frames are tracked, and poses and depth of all frames after the last one.

KeyframeCorrection   while frames are tracked: the depth of a keyframe as adjusted in its window, and of the frames that
                     are tracked against it
FrameCorrection      after the last frame: poses and depth of all frames, interpolated between the adjusted keyframes
FinalFrames          the stored frames with that, and with triangulated depth where there is one
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.align import Similarity
from scopemap.engine.geometry.se3 import inverse, mean_near, rotation_angle_rad
from scopemap.engine.mapping.depth_correction import DepthCorrectionField
from scopemap.engine.mapping.judge import LensTest, ShapeTest
from scopemap.engine.notices import Notice

_AT_REST = 1e-6  # guard: rad

TriangulatedDepths = Callable[[int, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray] | None]
"""Returns a frame's triangulated depth, sigma of its ln, and ln of its factor, by number and depth; None: unknown."""


class TrackedPose(NamedTuple):
    """A frame's pose as tracked.

    map : number of its map. keyframe : number of the frame that it was aligned to. T_world_camera : (4, 4), in that
    map's world. lost_before : how many frames were lost before it: the same between two losses.
    """

    map: int
    keyframe: int
    T_world_camera: np.ndarray
    lost_before: int = 0


class KeyframeCorrection(NamedTuple):
    """Correction of a keyframe's depth: ln of the factor of all of it, and of that of each pixel (None: 1)."""

    log_scale: float = 0.0
    field: DepthCorrectionField | None = None

    def corrected(self, frame: Frame) -> Frame:
        """Return a frame with its depth, and the standard deviation of that, corrected."""
        log = np.float32(self.log_scale) + self.log_factor(np.asarray(frame.depth_mm))
        return _with_depth_times(frame, np.exp(log, dtype=np.float32))

    def undone(self, frame: Frame) -> Frame:
        """Return a corrected frame with its depth, and the standard deviation of that, as estimated."""
        log = np.float32(self.log_scale) + self.log_factor_before(np.asarray(frame.depth_mm))
        return _with_depth_times(frame, np.exp(-log, dtype=np.float32))

    def log_factor_before(self, corrected_mm: np.ndarray) -> np.ndarray | np.float32:
        """Return ln of the field's factor (H, W) by which depth (H, W) mm was corrected; 0 without a field."""
        if self.field is None:
            return np.float32(0)
        return self.field.log_factor_before(corrected_mm * np.exp(np.float32(-self.log_scale)))

    def log_factor(self, depth_mm: np.ndarray) -> np.ndarray | np.float32:
        """Return ln of the field's factor (H, W) of depth (H, W) mm as estimated; 0 without a field."""
        return np.float32(0) if self.field is None else self.field.log_factor(depth_mm)


class KeyframeStep(NamedTuple):
    """By how much a keyframe was moved as it came; the frames before it, tracked against an earlier one, were not.

    T_camera_arrived : (4, 4), pose as aligned, in the camera as moved. before, after : correction of the depth of the
    frames before it, and its own.
    """

    T_camera_arrived: np.ndarray = np.eye(4)
    before: KeyframeCorrection = KeyframeCorrection()
    after: KeyframeCorrection = KeyframeCorrection()

    @property
    def log_scale(self) -> float:
        """Ln of the factor of its depth, less that of the frames before it."""
        return self.after.log_scale - self.before.log_scale

    def log_factor(self, depth_mm: np.ndarray) -> np.ndarray | np.float32:
        """Return ln of the factor (H, W) of depth (H, W) mm, corrected by `before`, from its field to that of `after`.

        0 where there is no field. A field takes depth as estimated, so that of `before` is inverted.
        """
        if self.before.field is None and self.after.field is None:
            return np.float32(0)
        log = self.before.log_factor_before(depth_mm)
        estimated_mm = depth_mm * np.exp(np.float32(-self.before.log_scale))
        return self.after.log_factor(estimated_mm * np.exp(-log)) - log


@dataclass(frozen=True)
class FrameCorrection:
    """Correction of every frame's pose and depth, interpolated between adjusted keyframes.

    Of frames A, K and B in this order, of which K is the keyframe: K moves by `T_adjusted_tracked`, and its depth by
    `log_scale` and its field. B was tracked against K, and moves with it by the same. A was tracked before K was moved
    as it came, by its step: it moves by `T_adjusted_arriving`, and its depth by the step's factor, too. A frame between
    two keyframes takes a weighted mean of what both say, but where a loss, or another reference, parts it from one.

    index : (K,) int, numbers of the keyframes' frames, increasing. T_adjusted_tracked : (K, 4, 4), from the common
    world as tracked, near a keyframe, to the adjusted one. log_scale : (K,) ln of the factor of a keyframe's depth.
    T_adjusted_arriving : as `T_adjusted_tracked`, for the frames before the keyframe, which its own window did not
    move; None: there is none. steps : (K,) of the keyframes; (): none was moved as it came. sigma_px : robust standard
    deviation of the reprojection errors; NaN without observations. refused : why no adjustment is kept, so that
    keyframes stay as tracked, or as the pose graph merges maps; None: one is kept. loop_frames : the two
    frames of each accepted loop closure. depth_fields : (K,) further factors of each pixel's depth; (): none.
    S_common_map : by number of each merged map, Sim(3) from its world to the common one. tracked : poses as tracked by
    number of the frame, where known. depth_mm : typical depth, the unit of translations beside rad. lens : what
    left-out tracks tell of it. shape : what other starts of the adjustment tell of it. S_world_adjusted : Sim(3) from
    the adjusted world to that of the submap, which joins a segment to the one before.
    """

    index: np.ndarray
    T_adjusted_tracked: np.ndarray
    log_scale: np.ndarray
    sigma_px: float = float("nan")
    T_adjusted_arriving: np.ndarray | None = None
    steps: Sequence[KeyframeStep] = ()
    refused: Notice | None = None
    loop_frames: Sequence[Sequence[int]] = ()
    depth_fields: tuple[DepthCorrectionField, ...] = ()
    S_common_map: Mapping[int, Similarity] = field(default_factory=dict)
    tracked: Mapping[int, TrackedPose] = field(default_factory=dict)
    depth_mm: float = 1.0
    lens: LensTest = field(default_factory=LensTest)
    shape: ShapeTest = field(default_factory=ShapeTest)
    S_world_adjusted: Similarity = field(default_factory=Similarity.identity)

    @property
    def notices(self) -> list[Notice]:
        """What was adjusted and how well it fits, or why nothing was; what determines the shape; another lens."""
        said = self.refused and self.refused.code == "mapping-not-determined"
        tested = [] if said else self.shape.notices
        return [self.notice, *tested, *self.lens.notices]

    @property
    def notice(self) -> Notice:
        """What was adjusted and how well it fits, or why nothing was."""
        if self.refused:
            return self.refused
        rotation_deg = np.degrees(rotation_angle_rad(self.T_adjusted_tracked[:, :3, :3]).max())
        changes = [np.abs(depth_field.values).mean() for depth_field in self.depth_fields]
        facts: dict[str, float] = {"keyframes": len(self.index), "loops": len(self.loop_frames)}
        facts["maps"] = max(len(self.S_common_map), 1)
        facts |= {"rotation_deg": float(rotation_deg), "sigma_px": float(self.sigma_px)}
        return Notice("mapping-adjusted", facts | {"depth_change": float(np.expm1(np.median(changes or [0.0])))})

    def with_steps(
        self, poses: Sequence[TrackedPose], steps: Sequence[KeyframeStep], S_common_map: Mapping[int, Similarity]
    ) -> FrameCorrection:
        """Return it with the step of each keyframe spread over the frames that lead to it.

        poses, steps : of the K keyframes. S_common_map : by number of each map, Sim(3) to the common world.
        """
        places = [(S_common_map[pose.map], pose.T_world_camera, step) for pose, step in zip(poses, steps, strict=True)]
        tracked = np.stack([S.transform_poses(T) for S, T, _ in places])
        arrived = [S.transform_poses(T @ step.T_camera_arrived) for S, T, step in places]
        return replace(
            self,
            T_adjusted_arriving=self.T_adjusted_tracked @ tracked @ inverse(np.stack(arrived)),
            steps=steps,
        )

    def in_world(self, T_new_world: np.ndarray) -> FrameCorrection:
        """Return the correction to another common world; `T_new_world` (4, 4) takes points of this one to it."""
        moved = Similarity(1.0, T_new_world[:3, :3], T_new_world[:3, 3])
        before = self.T_adjusted_arriving
        return replace(
            self,
            T_adjusted_tracked=T_new_world @ self.T_adjusted_tracked @ inverse(T_new_world),
            T_adjusted_arriving=None if before is None else T_new_world @ before @ inverse(T_new_world),
            S_common_map={number: moved.after(S) for number, S in self.S_common_map.items()},
            S_world_adjusted=moved.after(self.S_world_adjusted).after(moved.inverse()),
        )

    def pose(self, index: int, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the corrected pose (4, 4) of the frame with this number."""
        before, after, share = self._between(index)
        T_world_camera = self._world(index).transform_poses(T_world_camera)
        poses = [self._moved_with(k, index, T_world_camera) for k in (before, after)]
        return self.S_world_adjusted.transform_poses(mean_near(poses[0], [poses[1]], [share]))

    def depth_factor(self, index: int) -> float:
        """Return the factor of the whole depth of the frame with this number, without its depth correction field."""
        return self._factor(index, *self._between(index))

    def depth_factors(self, index: int, depth_mm: np.ndarray) -> np.ndarray:
        """Return the factors (H, W) float32 of depth (H, W) mm; NaN where depth is unknown."""
        before, after, share = self._between(index)
        factor = np.float32(self._factor(index, before, after, share))
        log = self._log_field(before, index, depth_mm)
        if after != before:
            log = (1 - share) * log + share * self._log_field(after, index, depth_mm)
        return np.where(np.isfinite(depth_mm), factor * np.exp(log), np.nan).astype(np.float32)

    def _log_field(self, k: int, index: int, depth_mm: np.ndarray) -> np.ndarray | np.float32:
        """Return ln of the factor of each pixel's depth (H, W) mm by what is known at keyframe k, near which it is."""
        step = self._step(k, index)
        log = step.log_factor(depth_mm)
        if not self.depth_fields:
            return log
        own_mm = depth_mm * np.exp(np.float32(step.log_scale) + log)  # as that of the keyframe, which the field is of
        return log + self.depth_fields[k].log_factor(own_mm * np.float32(self._world(index).scale))

    def _factor(self, index: int, before: int, after: int, share: float) -> float:
        log_scale = (1 - share) * self._log_scale(before, index) + share * self._log_scale(after, index)
        return float(np.exp(log_scale)) * self._world(index).scale * self.S_world_adjusted.scale

    def _moved_with(self, k: int, index: int, T_world_camera: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) of a frame that moves with keyframe k.

        Tracking measures translation in units of the depth of the keyframe that the frame was aligned to. So the
        translation from keyframe k is scaled as that depth is.

        T_world_camera : (4, 4), as tracked, in the common world.
        """
        T: np.ndarray = self._T_adjusted_tracked(k, index) @ T_world_camera
        reference, number = self._reference(index), int(self.index[k])
        if reference is not None and number in self.tracked:
            keyframe = self._world(number).transform_poses(self.tracked[number].T_world_camera)
            centre = (self.T_adjusted_tracked[k] @ keyframe)[:3, 3]
            T[:3, 3] = centre + np.exp(self.log_scale[reference]) * (T[:3, 3] - centre)
        return T

    def _T_adjusted_tracked(self, k: int, index: int) -> np.ndarray:
        """Return the correction (4, 4) of a frame near keyframe k, which it follows or leads to."""
        leads = index < self.index[k] and self.T_adjusted_arriving is not None
        corrections = self.T_adjusted_arriving if leads else self.T_adjusted_tracked
        T: np.ndarray = np.asarray(corrections)[k]
        return T

    def _log_scale(self, k: int, index: int) -> float:
        return float(self.log_scale[k]) + self._step(k, index).log_scale

    def _step(self, k: int, index: int) -> KeyframeStep:
        """Return the step from a frame to keyframe k, to which it leads; none where it follows, or is, the keyframe."""
        return self.steps[k] if self.steps and index < self.index[k] else KeyframeStep()

    def _world(self, index: int) -> Similarity:
        """Sim(3) from the world of a frame's map to the common one."""
        tracked = self.tracked.get(index)
        return self.S_common_map.get(0 if tracked is None else tracked.map, Similarity.identity())

    def _between(self, index: int) -> tuple[int, int, float]:
        """Two keyframes whose corrections a frame interpolates, and the weight of the second."""
        after = int(np.searchsorted(self.index, index))
        if after < len(self.index) and self.index[after] == index:
            return after, after, 0.0
        reference = self._reference(index)
        if reference is not None:
            follows = after < len(self.index) and self._reference(int(self.index[after])) == reference
            if not follows or self._lost_between(index, int(self.index[after])):
                return reference, reference, 0.0
            if reference != after - 1 or self._lost_between(int(self.index[reference]), index):
                return after, after, 0.0
        if after == 0 or after == len(self.index):
            nearest = min(after, len(self.index) - 1)
            return nearest, nearest, 0.0
        return after - 1, after, self._weight(index, after - 1, after)

    def _weight(self, index: int, before: int, after: int) -> float:
        """Weight of the second of two keyframes: share of the motion between them; of the time where unknown."""
        frames = (int(self.index[before]), index, int(self.index[after]))
        if all(frame in self.tracked for frame in frames):
            first, own, last = (self._world(f).transform_poses(self.tracked[f].T_world_camera) for f in frames)
            T_arrived_adjusted = inverse(self._T_adjusted_tracked(after, index))
            last = T_arrived_adjusted @ self.T_adjusted_tracked[after] @ last
            motion_before, motion_after = self._motion(first, own), self._motion(own, last)
            if motion_before + motion_after > _AT_REST:
                return motion_before / (motion_before + motion_after)
        return (index - frames[0]) / (frames[2] - frames[0])

    def _motion(self, T_world_one: np.ndarray, T_world_other: np.ndarray) -> float:
        T = inverse(T_world_one) @ T_world_other
        return float(np.hypot(rotation_angle_rad(T[:3, :3]), np.linalg.norm(T[:3, 3]) / self.depth_mm))

    def _lost_between(self, one: int, other: int) -> bool:
        losses = {self.tracked[frame].lost_before for frame in (one, other) if frame in self.tracked}
        return len(losses) > 1

    def _reference(self, index: int) -> int | None:
        """Place in `index` of the keyframe that a frame was aligned to; None where that is unknown."""
        tracked = self.tracked.get(index)
        place = 0 if tracked is None else int(np.searchsorted(self.index, tracked.keyframe))
        known = tracked is not None and place < len(self.index) and self.index[place] == tracked.keyframe
        return place if known else None


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
        if self._correction is None:
            return frame
        return _with_depth_times(frame, self._correction.depth_factors(index, np.asarray(frame.depth_mm)))

    def view(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return picture (H, W, 3) and corrected usable depth (H, W) mm of a frame, from any thread."""
        frame = self._corrected(index)
        return frame.rgb, _usable_depth_mm(frame)


def _with_depth_times(frame: Frame, factor: np.ndarray | np.float32) -> Frame:
    """Return a frame with its depth, and the standard deviation of that, times a factor of each pixel or of all."""
    depth_mm, sigma_mm = np.asarray(frame.depth_mm), frame.depth_sigma_mm
    return replace(frame, depth_mm=depth_mm * factor, depth_sigma_mm=None if sigma_mm is None else sigma_mm * factor)


def _usable_depth_mm(frame: Frame) -> np.ndarray:
    depth_mm = np.asarray(frame.depth_mm)
    return np.where(frame.valid & (depth_mm > 0), depth_mm, np.float32(np.nan))
