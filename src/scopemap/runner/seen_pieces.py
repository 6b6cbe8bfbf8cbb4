"""What is shown of the surface while a run goes on: points and path of the frames so far, in pieces.

A piece is what was tracked without a break. Where the pieces lie beside each other is not known before the end, so each
begins where the camera was shown last.
"""

from __future__ import annotations

import numpy as np

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.result.run_view import SeenMap

_POINTS_OF_A_FRAME = 600  # by hand: every 18th pixel or so of the working size in each direction
_MOST_POINTS = 15_000
"""Points that are shown. Without a graphics card Chromium takes .12 s of a core to draw a page of 1280 x 800 px without
any, .16 s with 10,000, .36 s with 40,000 (2026-11)."""
_MOST_POSES = 2_000


class SeenPieces:
    """Poses of tracked frames, and points of some of them, as they are shown; a frame that comes again replaces itself.

    count : points that were taken so far; fewer are shown, the more there are. keyframes : their numbers.
    """

    _T_shown_world: np.ndarray | None = None
    _last: np.ndarray | None = None

    def __init__(self) -> None:
        self.count, self._every, self._earlier = 0, 1, SeenBefore()
        self.keyframes, self._poses = set[int](), dict[int, np.ndarray]()
        self._points = dict[int, tuple[np.ndarray, np.ndarray]]()

    @property
    def is_sparse(self) -> bool:
        """Whether there is room for the points of more frames without leaving any out."""
        return self._size < _MOST_POINTS // 2

    def begin(self) -> None:
        """Begin a piece: what comes next is in another world."""
        self._earlier.put(self._poses, {index: points for index, (points, _) in self._points.items()})
        self._poses, self._points, self._T_shown_world = {}, {}, None

    def has_points(self, index: int) -> bool:
        """Return whether points of a frame are shown."""
        return index in self._points or index in self._earlier.points

    def put(self, frame: Frame, *, with_points: bool) -> None:
        """Add a frame that has a pose."""
        assert frame.T_world_camera is not None
        before = self._earlier.take(frame.index)
        if self._T_shown_world is None:
            start = self._last if before is None else before
            is_first = start is None
            self._T_shown_world = np.eye(4) if is_first else np.asarray(start) @ inverse(frame.T_world_camera)
        self._last = self._T_shown_world @ frame.T_world_camera
        self._poses[frame.index] = self._last.astype(np.float32)
        if len(self._poses) > _MOST_POSES:
            self._poses = {index: self._poses[index] for index in list(self._poses)[::2]}
        if with_points and frame.depth_mm is not None:
            points, colours = points_of(frame, self._last)
            self.count += len(points)
            self._points[frame.index] = points[:: self._every], colours[:: self._every]
            if self._size > _MOST_POINTS:
                self._thin()

    def map(self, frame: Frame) -> SeenMap | None:
        """Return what is shown; None: nothing. frame : any of its camera."""
        if not self._poses:
            return None
        index, camera = np.fromiter(self._poses, int, len(self._poses)), frame.camera
        clouds, colours = zip(*self._points.values(), strict=True) if self._points else ((), ())
        return SeenMap(
            index=index,
            T_world_camera=np.stack(list(self._poses.values())),
            keyframe=np.isin(index, list(self.keyframes)),
            points=np.concatenate([np.zeros((0, 3), np.float32), *clouds]),
            colours=np.concatenate([np.zeros((0, 3), np.uint8), *colours]),
            earlier=np.concatenate([np.zeros((0, 3), np.float32), *self._earlier.points.values()]),
            fov_rad=float(2 * np.arctan(camera.height / (2 * camera.fy))),
            aspect=camera.width / camera.height,
        )

    @property
    def _size(self) -> int:
        return sum(map(len, self._earlier.points.values())) + sum(len(points) for points, _ in self._points.values())

    def _thin(self) -> None:
        """Leave out every second point: each frame keeps some, so that no part of the surface goes."""
        self._every *= 2
        self._points = {index: (points[::2], rgb[::2]) for index, (points, rgb) in self._points.items()}
        self._earlier.points = {index: points[::2] for index, points in self._earlier.points.items()}


class SeenBefore:
    """Poses and points, as they are shown, of frames in pieces that have ended."""

    def __init__(self) -> None:
        self.points, self._poses = dict[int, np.ndarray](), dict[int, np.ndarray]()

    def put(self, poses: dict[int, np.ndarray], points: dict[int, np.ndarray]) -> None:
        """Add those of a piece."""
        self._poses |= poses
        self.points |= points

    def take(self, index: int) -> np.ndarray | None:
        """Forget a frame; return its pose, None where it was not shown."""
        self.points.pop(index, None)
        return self._poses.pop(index, None)


def points_of(frame: Frame, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) float32, mm, and colours (n, 3) uint8 of usable pixels on a coarse grid, from a pose."""
    assert frame.depth_mm is not None
    step_px = max(1, int(np.ceil(np.sqrt(frame.valid.size / _POINTS_OF_A_FRAME))))
    row, column = (
        side.ravel() for side in np.mgrid[: frame.valid.shape[0] : step_px, : frame.valid.shape[1] : step_px]
    )
    depth_mm = frame.depth_mm[row, column]
    known = frame.valid[row, column] & np.isfinite(depth_mm)
    row, column, depth_mm = row[known], column[known], depth_mm[known]
    rays = frame.camera.unproject(np.column_stack([column, row]).astype(float))
    return transform(pose, rays * depth_mm[:, None]).astype(np.float32), frame.rgb[row, column]
