"""Locates the frames of another video in the map of a result: features of keyframes, PnP in RANSAC, all matches."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from scopemap.engine.errors import InputError, reporting
from scopemap.engine.flow.corners import Correspondences2D3D, KeyframeMatcher
from scopemap.engine.flow.dis import DisFlow
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, rotation_angle_rad, transform
from scopemap.engine.masking.masker import Masker
from scopemap.engine.tracking.alike import AlikeFeatures
from scopemap.engine.tracking.corner_pose import pose_from_correspondences
from scopemap.engine.tracking.features import FeatureDetector, Features, relative_pose_pnp, similarities
from scopemap.input.mask_files import masks_of
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence as FrameSequence
from scopemap.result.result import Result, opened
from scopemap.runner.reread_frames import reread_frames

_CANDIDATES = 8  # keyframes whose matches are verified
_STRONGEST = 128  # descriptors by which they are ranked
# Of the best keyframe, where chance gives up to 26 on phantoms, and of another one whose matches are used.
_LEAST_INLIERS = 30
_LEAST_SUPPORT = 10
_AGREE_DEPTH = 0.1  # of the poses by two keyframes
_AGREE_RAD = 0.1
_LEAST_SPREAD = 0.08  # standard deviation of the inliers, over the picture's width and height
_DEPTH_SIGMA = 0.05
_FLOW_KEYFRAMES = 3  # keyframes whose corners flow finds
_FLOW_ROUNDS = 2  # how often, each time from a better pose
NOT_FOUND = "not found"


@dataclass(frozen=True)
class LocatedFrame:
    """Where a frame of a video is in the map of a result.

    status : "found", or "not found". map : number of the submap, 0 for the result; -1 where it is not found.
    keyframe : number of the result's frame that has most in common with it, or -1. inliers : matched features that
    agree with the pose. T_world_camera : (4, 4), mm of the result, in the world of that submap; NaN where not found.
    points_mm, pixels : (inliers, 3) of that world and (inliers, 2) of the frame, what was matched.
    """

    index: int
    time_s: float
    status: str = NOT_FOUND
    map: int = -1
    keyframe: int = -1
    inliers: int = 0
    T_world_camera: np.ndarray = field(default_factory=lambda: np.full((4, 4), np.nan))
    points_mm: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


class _Place(NamedTuple):
    """A keyframe of a result: its submap, picture, pose (4, 4), features with depth, and strongest descriptors."""

    map: int
    frame: Frame
    T_world_camera: np.ndarray
    features: Features
    strongest: np.ndarray


class _Match(NamedTuple):
    """A keyframe whose features place a frame: the pose (4, 4), and the matched points, world mm, and pixels."""

    place: _Place
    T_world_camera: np.ndarray
    points_mm: np.ndarray
    pixels: np.ndarray


class PlaceMap:
    """The keyframes of a result and of its submaps, in which frames are located.

    The result's input is at its `input_path`; else it is looked for. Raises `InputError` where the result kept no
    depth, or its input is gone.
    """

    def __init__(self, run: Result, detector: FeatureDetector | None = None) -> None:
        if not run.depth.present:
            raise InputError(f"the run {run.folder} kept no depth maps")
        self._detector, self._flow, self._depth = detector or AlikeFeatures(), DisFlow(), run.depth
        self._places: list[_Place] = []
        poses: dict[int, tuple[int, np.ndarray]] = {}
        for number, submap in enumerate(run.submaps):
            tracked = submap.frames.only(submap.frames.tracked)
            pose_of = dict(zip(tracked["index"].tolist(), tracked["T_world_camera"], strict=True))
            known = pose_of.keys() & (set(tracked["keyframe"].tolist()) or pose_of.keys())
            poses |= {index: (number, pose_of[index]) for index in known}
        for frame in reread_frames(run.folder, set(poses), run.input_path):
            depth_mm = run.depth.read(frame.index)
            if depth_mm is not None:
                features = self._detector.detect(replace(frame, depth_mm=depth_mm))
                number, T_world_camera = poses[frame.index]
                self._places.append(_Place(number, frame, T_world_camera, features, features.descriptors[:_STRONGEST]))

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._places)

    def locate(self, frame: Frame) -> LocatedFrame:
        """Return where a frame is, masked as those of a run."""
        found, missing = self._matches(frame), LocatedFrame(frame.index, frame.time_s)
        if not found:
            return missing
        best = max(found, key=lambda match: len(match.pixels))
        spread = best.pixels.std(0) / [frame.camera.width, frame.camera.height]
        if len(best.pixels) < _LEAST_INLIERS or spread.min() < _LEAST_SPREAD:
            return missing
        agreeing = [match for match in found if _agree(match, best, frame)]
        points_mm, pixels = (np.concatenate([match[n] for match in agreeing]) for n in (2, 3))
        pose, place = _by_all(frame, best.T_world_camera, points_mm, pixels), best.place
        agreeing.sort(key=lambda match: -len(match.pixels))
        pose = self._by_flow(frame, [match.place for match in agreeing[:_FLOW_KEYFRAMES]], pose)
        return LocatedFrame(
            frame.index, frame.time_s, "found", place.map, place.frame.index, len(pixels), pose, points_mm, pixels
        )

    def _by_flow(self, frame: Frame, places: Sequence[_Place], T_world_camera: np.ndarray) -> np.ndarray:
        """Return the pose by corners of keyframes, where flow from a pose (4, 4) finds them.

        They are more than the features that match, and more exact, all the more so far from the keyframes.
        """
        matchers = [KeyframeMatcher(self._flow) for _ in places]
        keyframes = [replace(place.frame, depth_mm=self._depth.read(place.frame.index)) for place in places]
        for _ in range(_FLOW_ROUNDS):
            points_mm, pixels = [], []
            for matcher, keyframe, place in zip(matchers, keyframes, places, strict=True):
                T_frame_keyframe = inverse(T_world_camera) @ place.T_world_camera
                # Flow back begins at the keyframe's depth, too: the frame has none.
                matcher.set_keyframe(keyframe, replace(frame, depth_mm=keyframe.depth_mm), T_frame_keyframe)
                if found := matcher.match(frame):
                    points_mm.append(transform(place.T_world_camera, found.points_mm))
                    pixels.append(found.pixels)
            if points_mm:
                T_world_camera = _by_all(frame, T_world_camera, np.concatenate(points_mm), np.concatenate(pixels))
        return T_world_camera

    def _matches(self, frame: Frame) -> list[_Match]:
        """Return the poses by the most similar keyframes."""
        current = self._detector.detect(replace(frame, depth_mm=None))
        strongest = current.descriptors[:_STRONGEST]
        alike = similarities(strongest, [place.strongest for place in self._places])
        found = []
        for number in np.argsort(-alike, kind="stable")[:_CANDIDATES]:
            place = self._places[number]
            relative = relative_pose_pnp(place.features, current, frame.camera, _LEAST_SUPPORT)
            if alike[number] > 0 and relative is not None:
                own, new = relative.pairs.T
                points_mm = transform(place.T_world_camera, place.features.points_mm[own])
                T_world_camera = place.T_world_camera @ inverse(relative.T_current_reference)
                found.append(_Match(place, T_world_camera, points_mm, current.pixels[new]))
        return found


def open_other(
    run: Result,
    path: Path | str,
    camera: Path | str | None = None,
    dataset: str | None = None,
    frames: slice | str | None = None,
    camera_fit: str | None = None,
) -> FrameSequence:
    """Return the frames of another video; without a calibration of its own it has the camera of a result's input.

    The settings of the input, and the parameters, are those of `open_sequence`, which see for what is raised.
    camera_fit : that of the settings' `input`, for this video.
    """
    kept, settings = run.source_camera_file, run.config.input.model_copy(update={"frames": ""})
    if camera_fit is not None:
        settings = settings.model_copy(update={"camera_fit": camera_fit})
    sequence = open_sequence(path, camera=camera, dataset=dataset, frames=frames, settings=settings)
    if sequence.calibrated or kept is None:
        return sequence
    resized = settings.model_copy(update={"camera_fit": camera_fit or "scale"})
    return open_sequence(path, camera=kept, dataset=dataset, frames=frames, settings=resized)


def locate(result: Result | Path | str, sequence: FrameSequence | Path | str) -> Iterator[LocatedFrame]:
    """Yield where each frame of another video is in the map of a result.

    Each has its `status`, "found" or "not found", `T_world_camera` and `inliers`. Frames are masked by the result's
    settings. result : opened, its own input at `input_path`, or its folder. sequence : from `open_sequence`; or a path
    of a video, which has the camera of the result's input where it has no calibration of its own (docs/locate.md).
    Raises `InputError` where the result has no finished run, kept no depth, or its input is gone.
    """
    run = opened(result)
    sequence = open_other(run, sequence) if isinstance(sequence, Path | str) else sequence
    places, settings = PlaceMap(run), run.config.mask.model_copy(update={"files": ""})
    mask = Masker(settings, masks_of(settings, sequence))
    return (places.locate(mask(frame)) for frame in sequence.frames())


def write_located(frames: Sequence[LocatedFrame], file: Path) -> None:
    """Write a table with a line for each frame; raises `InputError` where the file cannot be written."""
    names = ["index", "time_s", "status", "map", "keyframe", "inliers", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]
    with reporting(f"cannot write {file}"), file.open("w", newline="", encoding="utf-8") as table:
        rows = csv.writer(table)
        rows.writerow(names)
        for one in frames:
            known = one.status != NOT_FOUND
            T = one.T_world_camera
            pose = [f"{x:.6f}" for x in (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())] if known else [""] * 7
            place = [one.map, one.keyframe] if known else ["", ""]
            rows.writerow([one.index, f"{one.time_s:.6f}", one.status, *place, one.inliers, *pose])


def _agree(match: _Match, best: _Match, frame: Frame) -> bool:
    """Whether another keyframe of the same submap has a frame in about the same pose as the best one."""
    if match.place.map != best.place.map:
        return False
    T = inverse(best.T_world_camera) @ match.T_world_camera
    depth_mm = float(np.median(transform(inverse(best.T_world_camera), best.points_mm)[:, 2]))
    near = np.linalg.norm(T[:3, 3]) <= _AGREE_DEPTH * depth_mm
    return bool(near and rotation_angle_rad(T[:3, :3]) <= _AGREE_RAD)


def _by_all(frame: Frame, T_world_camera: np.ndarray, points_mm: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4), near a known one, by all matches: points (N, 3), world, and pixels (N, 2)."""
    matches = Correspondences2D3D(transform(inverse(T_world_camera), points_mm), pixels, 1.0, frame.index)
    T = pose_from_correspondences(matches, frame.camera, np.eye(4), _DEPTH_SIGMA)
    return T_world_camera if T is None else T_world_camera @ inverse(T)
