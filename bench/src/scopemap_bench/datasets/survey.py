"""One pass over a data set that keeps figures of every frame and no image: what `checking` judges.

`PoseDepthTest` moves the depth of a frame by the poses and compares it with that of a later one, and does the same with
the motion that other conventions would give: a wrong convention shows by fitting far better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import ScopemapError
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.input.picture_difference import is_repeat
from scopemap.input.sequence import Sequence
from scopemap.input.trajectory.trajectory import path_length_mm

LAGS = (10, 30, 90)
LEAST_OVERLAP = 0.2
_KEPT_EVERY = 5
_MOST_POINTS = 20_000
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LEFT_HANDED = np.diag([1.0, -1.0, 1.0, 1.0])
RIGID_TOLERANCE = 1e-2
_MOST_PIXELS = 200_000


@dataclass(frozen=True)
class Convention:
    """One way to read a pair of poses, and T_b_a, the motion (4, 4) from camera a to b of stored poses (T_a, T_b)."""

    code: str
    looks_like: str
    T_b_a: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _motion(T_world_a: np.ndarray, T_world_b: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """Return the motion of camera-to-world poses, its translation times `factor`."""
    T_b_a = inverse(T_world_b) @ T_world_a
    T_b_a[:3, 3] *= factor
    return T_b_a


def _in_axes(axes: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda T_world_a, T_world_b: axes @ _motion(T_world_a, T_world_b) @ axes


OTHERS = (
    Convention("poses-inverted", "world-to-camera", lambda a, b: b @ inverse(a)),
    Convention("poses-opengl", "those of a camera with y up and z to the back (OpenGL)", _in_axes(_OPENGL)),
    Convention("poses-mirrored", "left-handed (y up, as in Unity)", _in_axes(_LEFT_HANDED)),
    Convention("pose-depth-unit", "metres (or the depth like micrometres)", lambda a, b: _motion(a, b, 1e3)),
    Convention("pose-depth-unit", "micrometres (or the depth like metres)", lambda a, b: _motion(a, b, 1e-3)),
)


@dataclass(frozen=True)
class Agreement:
    """How well depth fits depth through the poses, over `pairs` of frames that are about `lag` frames apart.

    given : median over pairs of the median relative error with the poses as given; infinite where they see no surface
    in common. at_rest : the same as if nothing moved. others : the same for each of `OTHERS`.
    """

    lag: int
    pairs: int
    given: float
    at_rest: float
    others: tuple[float, ...]


class PoseDepthTest:
    """Takes frames in order and compares the depth of each with some before it; a bounded number of them is held."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._step = max(1, int(np.ceil(np.sqrt(camera.width * camera.height / _MOST_POINTS))))
        self._rays = camera.rays[:: self._step, :: self._step].astype(np.float64)
        self._kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._errors: dict[int, list[list[float]]] = {lag: [] for lag in LAGS}
        self._count = 0

    def add(self, depth_mm: np.ndarray, T_world_camera: np.ndarray) -> None:
        """Take the depth (H, W), mm, NaN = unknown, and the rigid pose (4, 4) of the next frame."""
        now = self._count
        keep = now % _KEPT_EVERY == 0
        for lag in LAGS:
            # A slow camera needs the long lags; few pairs of these suffice.
            if now and (lag == LAGS[0] or (keep and now >= lag)):
                depth_a_mm, T_world_a = self._kept[max(now - lag, 0) // _KEPT_EVERY * _KEPT_EVERY]
                points = self._rays * depth_a_mm[:: self._step, :: self._step, None]
                motions = [_motion(T_world_a, T_world_camera), np.eye(4)]
                motions += [convention.T_b_a(T_world_a, T_world_camera) for convention in OTHERS]
                self._errors[lag].append([self._error(transform(T_b_a, points), depth_mm) for T_b_a in motions])
        if keep:
            self._kept[now] = (depth_mm, T_world_camera)
            self._kept.pop(now - max(LAGS), None)
        self._count += 1

    @property
    def near_errors(self) -> list[float]:
        """Error as given of each frame but the first against one about 10 before it, as in `Agreement`."""
        return [errors[0] for errors in self._errors[LAGS[0]]]

    @property
    def agreements(self) -> tuple[Agreement, ...]:
        """What was found so far, by lag; nothing of lags that no pair has."""
        medians = {lag: np.median(errors, axis=0).tolist() for lag, errors in self._errors.items() if errors}
        return tuple(Agreement(lag, len(self._errors[lag]), m[0], m[1], tuple(m[2:])) for lag, m in medians.items())

    def _error(self, points: np.ndarray, depth_mm: np.ndarray) -> float:
        """Return the median relative error along the axis of points (h, w, 3), infinite without enough overlap."""
        u, v = np.moveaxis(self._camera.project(points), -1, 0)
        # OpenCV's fixed-point coordinates hold neither NaN nor what is far outside.
        u, v = (np.clip(np.nan_to_num(w, nan=-9.0), -9.0, 16_000.0).astype(np.float32) for w in (u, v))
        there_mm = cv2.remap(depth_mm, u, v, cv2.INTER_LINEAR, borderValue=float("nan"))
        seen = (there_mm > 0) & np.isfinite(there_mm) & (points[..., 2] > 0)
        if seen.sum() < LEAST_OVERLAP * max(np.isfinite(points[..., 2]).sum(), 1):
            return float("inf")
        return float(np.median(np.abs(points[..., 2][seen] / there_mm[seen] - 1)))


@dataclass(frozen=True)
class DepthFigures:
    """Figures of one frame's depth, lengths in mm; NaN where nothing is known.

    known_share, impossible_share : of the pixels; impossible: infinite, zero or negative. distinct : number of
    different values among the `known_count` pixels.
    """

    known_share: float
    impossible_share: float
    nearest_mm: float
    median_mm: float
    farthest_mm: float
    distinct: int
    known_count: int

    @property
    def is_constant(self) -> bool:
        """Whether all known pixels are at one distance."""
        return self.farthest_mm - self.nearest_mm <= 1e-6 * abs(self.farthest_mm)


@dataclass(frozen=True)
class FrameFigures:
    """Figures of one frame.

    brightest : level, of 255, that 1 % of the pixels exceed. spread : largest standard deviation of a channel.
    is_repeat : whether it shows what the frame before it shows. T_world_camera : as the source has it, or None.
    """

    index: int
    time_s: float
    name: str
    brightest: float
    spread: float
    is_repeat: bool
    T_world_camera: np.ndarray | None
    depth: DepthFigures | None


@dataclass(frozen=True)
class Survey:
    """Result of one pass over a data set: what could be read of its frames.

    agreements : of poses and depth, by growing lag. depth_errors : relative error of a frame's depth against that of
    one about 10 before it, moved by the poses, by frame number. stopped : the error that ended the reading, or "".
    truth_faults : errors in reading poses and depth, each with the first frame that it concerns.
    """

    sequence: Sequence
    frames: tuple[FrameFigures, ...]
    agreements: tuple[Agreement, ...] = ()
    depth_errors: dict[int, float] = field(default_factory=dict)
    stopped: str = ""
    truth_faults: tuple[str, ...] = ()

    @property
    def announced(self) -> list[int] | None:
        """Numbers of the frames that should be there, None where only reading on tells."""
        stamps = self.sequence.source.stamps(self.sequence.selection)
        return None if stamps is None else [index for index, _ in stamps]

    @property
    def rigid(self) -> list[FrameFigures]:
        """Frames with a pose that is a rigid motion."""
        return [frame for frame in self.frames if is_rigid(frame.T_world_camera)]

    @property
    def figures(self) -> dict[str, Any]:
        """Figures of the whole, lengths in mm; those of what is not there are left out."""
        numbers, times_s = [frame.index for frame in self.frames], [frame.time_s for frame in self.frames]
        camera = self.sequence.rectifier.source.central
        found: dict[str, Any] = {"dataset": self.sequence.source.name, "frames": len(numbers)}
        if numbers:
            found |= {"first_number": min(numbers), "last_number": max(numbers), "span_s": max(times_s) - min(times_s)}
        found |= {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        found["camera"] = self.sequence.camera_source
        found["with_pose"] = sum(frame.T_world_camera is not None for frame in self.frames)
        found["with_depth"] = sum(frame.depth is not None for frame in self.frames)
        if self.rigid:
            positions_mm = positions_of(self.rigid)
            found |= {"path_mm": path_length_mm(positions_mm), "extent_mm": extent_mm(positions_mm)}
        depths = [frame.depth for frame in self.frames if frame.depth is not None and frame.depth.known_count]
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
    """Return whether `T` (4, 4) is a rotation and a translation."""
    return T is not None and bool(np.isfinite(T).all() and deviation(T) <= RIGID_TOLERANCE and np.linalg.det(T) > 0)


def positions_of(frames: list[FrameFigures]) -> np.ndarray:
    """Return the camera centres (N, 3), mm, of frames with a pose."""
    return np.array([frame.T_world_camera[:3, 3] for frame in frames if frame.T_world_camera is not None])


def extent_mm(positions_mm: np.ndarray) -> float:
    """Return the diagonal of the box around positions (N, 3)."""
    return float(np.linalg.norm(np.ptp(positions_mm, axis=0)))


def survey(sequence: Sequence, listener: Callable[[int, int | None], None] | None = None) -> Survey:
    """Read the sequence once; `listener(frames read, frames in all or None)` follows each frame. Errors are kept."""
    faults, compared, frames, stopped = dict[str, int](), list[int](), list[FrameFigures](), ""
    test = PoseDepthTest(sequence.camera)
    try:
        for frame in _figures(sequence, test, compared, faults):
            frames.append(frame)
            if listener is not None:
                listener(len(frames), sequence.count)
    except ScopemapError as error:
        stopped = str(error)
    errors = dict(zip(compared[1:], test.near_errors, strict=True))
    truth_faults = tuple(f"frame {index}: {fault}" for fault, index in faults.items())
    return Survey(sequence, tuple(frames), test.agreements, errors, stopped, truth_faults)


def _figures(
    sequence: Sequence, test: PoseDepthTest, compared: list[int], faults: dict[str, int]
) -> Iterator[FrameFigures]:
    before: np.ndarray | None = None
    source = sequence.source
    for frame in source.frames(sequence.selection):
        T_world_camera, depth = None, None
        try:
            truth = source.truth(frame.index)
            T_world_camera = None if truth is None else truth.T_world_camera
            if truth is not None and truth.depth_mm is not None:
                depth = _depth_figures(truth.depth_mm)
                varied = depth.known_count > 0 and not depth.is_constant
                if varied and T_world_camera is not None and is_rigid(T_world_camera):
                    test.add(sequence.depth_rectifier.nearest(truth.depth_mm), T_world_camera)
                    compared.append(frame.index)
        except ScopemapError as error:
            faults.setdefault(str(error), frame.index)
            with suppress(ScopemapError):  # the pose is known where only the depth cannot be read
                T_world_camera = source.pose(frame.index)
        sample = _subsampled(frame.rgb)
        yield FrameFigures(
            frame.index,
            frame.time_s,
            frame.name,
            brightest=float(np.percentile(sample, 99)),
            spread=float(sample.std(axis=(0, 1)).max()),
            is_repeat=before is not None and before.shape == sample.shape and is_repeat(sample, before),
            T_world_camera=T_world_camera,
            depth=depth,
        )
        before = sample


def _depth_figures(depth_mm: np.ndarray) -> DepthFigures:
    sample = _subsampled(depth_mm)
    stated = sample[~np.isnan(sample)]
    known = stated[np.isfinite(stated) & (stated > 0)]
    nearest, median, farthest = np.percentile(known, (0, 50, 100)).tolist() if known.size else (np.nan,) * 3
    size = max(sample.size, 1)
    impossible = (stated.size - known.size) / size
    return DepthFigures(known.size / size, impossible, nearest, median, farthest, np.unique(known).size, known.size)


def _subsampled(image: np.ndarray) -> np.ndarray:
    step = max(1, int(np.ceil(np.sqrt(image.shape[0] * image.shape[1] / _MOST_PIXELS))))
    return image[::step, ::step]
