"""One pass over a data set that keeps figures of every frame and no image: what `checking` judges."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import ScopemapError
from scopemap.io.datasets.pose_depth import Agreement, PoseDepthTest
from scopemap.io.sequence import Sequence
from scopemap.io.video_format.redundant_frames import is_repeat
from scopemap.trajectory.trajectory import path_length_mm

RIGID_TOLERANCE = 1e-2
_MOST_PIXELS = 200_000
_T = TypeVar("_T")


@dataclass(frozen=True)
class DepthRecord:
    """Figures of one frame's depth, lengths in mm; NaN where nothing is known.

    known_share : of the pixels. impossible_share : infinite, zero or negative. distinct : number of different values.
    looked_at : number of known pixels that `distinct` was counted in.
    """

    known_share: float
    impossible_share: float
    nearest_mm: float
    median_mm: float
    farthest_mm: float
    distinct: int
    looked_at: int

    @property
    def is_constant(self) -> bool:
        """Whether all known pixels are at one distance."""
        return self.farthest_mm - self.nearest_mm <= 1e-6 * abs(self.farthest_mm)


@dataclass(frozen=True)
class FrameRecord:
    """Figures of one frame.

    brightest : level, of 255, that 1 % of the pixels exceed. spread : largest standard deviation of a channel.
    repeats : whether it shows what the frame before it shows, but for lossy coding. T_world_camera : as the source has
    it, or None.
    """

    index: int
    time_s: float
    name: str
    brightest: float
    spread: float
    repeats: bool
    T_world_camera: np.ndarray | None
    depth: DepthRecord | None


@dataclass(frozen=True)
class Survey:
    """What one pass over a data set found.

    Attributes
    ----------
    dataset : name of the reader. camera : as pinhole, of the images' size. calibrated : whether it is known.
    camera_source : how. pixel_aspect : width of a pixel over its height.
    announced : numbers of the frames that should be there, None where only reading on tells.
    frames : what could be read.
    agreements : of poses and depth, by growing lag; empty where there are no two frames with both.
    off : relative error of a frame's depth against that of one about 10 before it, moved by the poses, by frame number.
    stopped : the error that ended the reading, or "". truth_faults : errors in reading poses and depth, each with the
    first frame that it concerns.
    notes, warnings : the source's.
    """

    dataset: str
    camera: PinholeCamera
    calibrated: bool
    camera_source: str
    pixel_aspect: float
    announced: tuple[int, ...] | None
    frames: tuple[FrameRecord, ...]
    agreements: tuple[Agreement, ...]
    off: dict[int, float]
    stopped: str
    truth_faults: tuple[str, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def posed(self) -> list[FrameRecord]:
        """Frames with a pose."""
        return [frame for frame in self.frames if frame.T_world_camera is not None]

    @property
    def rigid(self) -> list[FrameRecord]:
        """Frames with a pose that is a rigid motion."""
        return [frame for frame in self.posed if is_rigid(frame.T_world_camera)]

    @property
    def deep(self) -> list[FrameRecord]:
        """Frames with depth."""
        return [frame for frame in self.frames if frame.depth is not None]

    @property
    def figures(self) -> dict[str, Any]:
        """Figures of the whole, lengths in mm; those of what is not there are left out."""
        numbers = [frame.index for frame in self.frames]
        times_s = [frame.time_s for frame in self.frames]
        camera = self.camera
        found: dict[str, Any] = {"dataset": self.dataset, "frames": len(numbers)}
        if numbers:
            found |= {"first_number": min(numbers), "last_number": max(numbers), "span_s": max(times_s) - min(times_s)}
        found |= {"width": camera.width, "height": camera.height, "camera": self.camera_source}
        found |= {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")}
        found |= {"with_pose": len(self.posed), "with_depth": len(self.deep)}
        if self.rigid:
            positions_mm = positions_of(self.rigid)
            found |= {"path_mm": path_length_mm(positions_mm), "extent_mm": extent_mm(positions_mm)}
        depths = [frame.depth for frame in self.deep if frame.depth is not None and frame.depth.looked_at]
        if depths:
            names = ("nearest_mm", "median_mm", "farthest_mm", "known_share")
            found |= {f"depth_{name}": float(np.median([getattr(depth, name) for depth in depths])) for name in names}
        if self.agreements:
            found["pose_depth_error"] = self.agreements[0].given
        return found


def deviation(T: np.ndarray) -> float:
    """Return by how much R^T R and the last row of `T` (4, 4) are off those of a rigid motion; NaN if it holds NaN."""
    R = T[:3, :3]
    return float(max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max()))


def is_rigid(T: np.ndarray | None) -> bool:
    """Whether `T` (4, 4) is a rotation and a translation."""
    return T is not None and bool(np.isfinite(T).all() and deviation(T) <= RIGID_TOLERANCE and np.linalg.det(T) > 0)


def positions_of(frames: list[FrameRecord]) -> np.ndarray:
    """Return the camera centres (N, 3), mm, of frames with a pose."""
    return np.array([frame.T_world_camera[:3, 3] for frame in frames if frame.T_world_camera is not None])


def extent_mm(positions_mm: np.ndarray) -> float:
    """Return the diagonal of the box around positions (N, 3)."""
    return float(np.linalg.norm(np.ptp(positions_mm, axis=0)))


def survey(sequence: Sequence, listener: Callable[[int, int | None], None] | None = None) -> Survey:
    """Read the sequence once, frame by frame, calling `listener(frames read, frames in all or None)` after each.

    What cannot be read is part of what was found: no `ScopemapError` leaves.
    """
    source, camera = sequence.source, sequence.rectifier.source.central
    stamps = source.stamps(sequence.selection)
    faults: dict[str, int] = {}
    records: list[FrameRecord] = []
    test, compared = PoseDepthTest(sequence.camera), list[int]()
    stopped = ""
    try:
        for record in _records(sequence, test, compared, faults):
            records.append(record)
            if listener is not None:
                listener(len(records), sequence.count)
    except ScopemapError as error:
        stopped = str(error)
    return Survey(
        dataset=source.name,
        camera=camera,
        calibrated=sequence.calibrated,
        camera_source=sequence.camera_source,
        pixel_aspect=source.pixel_aspect,
        announced=None if stamps is None else tuple(index for index, _ in stamps),
        frames=tuple(records),
        agreements=test.agreements,
        off=dict(zip(compared[1:], test.near_errors, strict=True)),
        stopped=stopped,
        truth_faults=tuple(f"frame {index}: {fault}" for fault, index in faults.items()),
        notes=tuple(sequence.notes),
        warnings=tuple(sequence.warnings),
    )


def _records(
    sequence: Sequence, test: PoseDepthTest, compared: list[int], faults: dict[str, int]
) -> Iterator[FrameRecord]:
    before: np.ndarray | None = None
    for frame in sequence.source.frames(sequence.selection):
        T_world_camera, depth_mm = _truth(sequence, frame.index, faults)
        depth = None if depth_mm is None else _depth_record(depth_mm)
        if depth_mm is not None and depth is not None and depth.looked_at and not depth.is_constant:
            working_mm = _attempt(partial(sequence.depth_rectifier.nearest, depth_mm), frame.index, faults)
            if working_mm is not None and T_world_camera is not None and is_rigid(T_world_camera):
                test.add(working_mm, T_world_camera)
                compared.append(frame.index)
        sample = _thinned(frame.rgb)
        yield FrameRecord(
            frame.index,
            frame.time_s,
            frame.name,
            brightest=float(np.percentile(sample, 99)),
            spread=float(sample.std(axis=(0, 1)).max()),
            repeats=before is not None and before.shape == sample.shape and is_repeat(sample, before),
            T_world_camera=T_world_camera,
            depth=depth,
        )
        before = sample


def _truth(sequence: Sequence, index: int, faults: dict[str, int]) -> tuple[np.ndarray | None, np.ndarray | None]:
    truth = _attempt(partial(sequence.source.truth, index), index, faults)
    if truth is not None:
        return truth.T_world_camera, truth.depth_mm
    # Depth that cannot be read does not take the pose with it.
    return _attempt(partial(sequence.source.pose, index), index, faults), None


def _attempt(read: Callable[[], _T], index: int, faults: dict[str, int]) -> _T | None:
    try:
        return read()
    except ScopemapError as error:
        faults.setdefault(str(error), index)
    return None


def _depth_record(depth_mm: np.ndarray) -> DepthRecord:
    sample = _thinned(depth_mm)
    stated = sample[~np.isnan(sample)]
    known = stated[np.isfinite(stated) & (stated > 0)]
    nearest, median, farthest = np.percentile(known, (0, 50, 100)) if known.size else (np.nan,) * 3
    return DepthRecord(
        known_share=known.size / max(sample.size, 1),
        impossible_share=(stated.size - known.size) / max(sample.size, 1),
        nearest_mm=float(nearest),
        median_mm=float(median),
        farthest_mm=float(farthest),
        distinct=np.unique(known).size,
        looked_at=known.size,
    )


def _thinned(image: np.ndarray) -> np.ndarray:
    step = max(1, int(np.ceil(np.sqrt(image.shape[0] * image.shape[1] / _MOST_PIXELS))))
    return image[::step, ::step]
