"""Open3D's odometries, frame to frame: two on colour and depth, two on point clouds. MIT licence, extra `baselines`.

Steinbruecker: photometric only (Steinbruecker, Sturm and Cremers, "Real-time visual odometry from dense RGB-D images",
ICCV Workshops 2011). Park: photometric and geometric term (Park, Zhou and Koltun, "Colored point cloud registration
revisited", ICCV 2017). Point-to-point (Besl and McKay, 1992) and point-to-plane ICP (Chen and Medioni, 1992).

Open3D's own defaults hold wherever they can. They are made for rooms in metres, so one of its units is 100 mm here:
the depths of two pixels that correspond may then differ by 0.03 units = 3 mm. Every frame is aligned to the last one
that was tracked, from no motion. Open3D calls it a success, with no motion, where no pixels correspond or its linear
system is singular; here the frame is lost then, and the reason says so.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from scopemap.errors import SettingsError
from scopemap.frame import Frame
from scopemap.tracking import FrameTracker, Track

UNIT_MM = 100.0
"""Length of one of Open3D's units, mm."""

_DEPTH_MAX_UNITS = 5.0
_VOXEL_MM = 1.0
_ICP_REACH_MM = 3.0
_LEAST_SHARE = 0.1  # of the image with known depth, as our own tracker asks by default


class _Motion(NamedTuple):
    """What Open3D found: motion (4, 4) in mm from the current frame to the reference, or what was wrong."""

    T_reference_current: np.ndarray
    trouble: str = ""


class _Prepared(NamedTuple):
    """A frame in Open3D's terms, with what it was made from."""

    frame: Frame
    data: Any


class _RgbdAligner:
    """Aligns colour and depth; `term` names the class of the Jacobian in `open3d.pipelines.odometry`."""

    def __init__(self, open3d: Any, term: str) -> None:
        self._open3d = open3d
        self._term = getattr(open3d.pipelines.odometry, term)()

    def prepare(self, frame: Frame) -> Any:
        image, depth = self._open3d.geometry.Image(np.ascontiguousarray(frame.rgb)), _depth_image(self._open3d, frame)
        return self._open3d.geometry.RGBDImage.create_from_color_and_depth(
            image, depth, depth_scale=UNIT_MM, depth_trunc=_DEPTH_MAX_UNITS, convert_rgb_to_intensity=True
        )

    def align(self, current: _Prepared, reference: _Prepared) -> _Motion:
        odometry = self._open3d.pipelines.odometry
        success, T, information = odometry.compute_rgbd_odometry(
            current.data,
            reference.data,
            _intrinsics(self._open3d, current.frame),
            np.eye(4),
            self._term,
            odometry.OdometryOption(depth_max=_DEPTH_MAX_UNITS),
        )
        if not success:
            return _Motion(np.eye(4), "Open3D found no solution")
        if not np.trace(information) > 0:
            return _Motion(np.eye(4), "Open3D found no pixels that correspond")
        if _is_identity(T) and not np.array_equal(current.frame.rgb, reference.frame.rgb):
            return _Motion(np.eye(4), "Open3D's linear system is singular: it took no step")
        return _Motion(_in_mm(T))


class _IcpAligner:
    """Aligns point clouds; `estimation` names the class in `open3d.pipelines.registration`."""

    def __init__(self, open3d: Any, estimation: str) -> None:
        self._open3d, self._estimation_name = open3d, estimation
        self._estimation = getattr(open3d.pipelines.registration, estimation)()

    def prepare(self, frame: Frame) -> Any:
        cloud = self._open3d.geometry.PointCloud.create_from_depth_image(
            _depth_image(self._open3d, frame),
            _intrinsics(self._open3d, frame),
            depth_scale=UNIT_MM,
            depth_trunc=_DEPTH_MAX_UNITS,
        ).voxel_down_sample(_VOXEL_MM / UNIT_MM)
        if self._estimation_name == "TransformationEstimationPointToPlane":
            cloud.estimate_normals()
        return cloud

    def align(self, current: _Prepared, reference: _Prepared) -> _Motion:
        found = self._open3d.pipelines.registration.registration_icp(
            current.data, reference.data, _ICP_REACH_MM / UNIT_MM, np.eye(4), self._estimation
        )
        if not found.fitness > 0:
            return _Motion(np.eye(4), f"no points of the two clouds lie within {_ICP_REACH_MM:g} mm")
        if _is_identity(found.transformation) and found.inlier_rmse > 0:
            return _Motion(np.eye(4), "Open3D's linear system is singular: it took no step")
        return _Motion(_in_mm(found.transformation))


class Open3dTracker:
    """A `FrameTracker` that aligns each frame to the last tracked one by an odometry of Open3D.

    Masked pixels and those of unknown depth have depth 0, which Open3D leaves out. A lost frame is no reference: the
    next one is aligned to the one before it. Nothing is random, but Open3D's threads sum
    in any order: two runs agree to rounding, not to the last bit.

    method : a key of `OPEN3D_METHODS`. Raises `SettingsError` where Open3D cannot be imported.
    """

    def __init__(self, method: str) -> None:
        self._open3d = load_open3d()
        aligner, name = _ALIGNERS[method]
        self._aligner = aligner(self._open3d, name)
        self._reference: _Prepared | None = None
        self._current: _Prepared | None = None
        self._T_world_last = np.eye(4)

    def track(self, frame: Frame) -> Track:
        """Return the pose of a frame with depth, or say why there is none; the first with enough depth is initial."""
        reference = self._reference.frame.index if self._reference else frame.index
        known = float(_known(frame).mean())
        if known < _LEAST_SHARE:
            return Track(frame.index, "lost", f"only {known:.0%} of the image is usable", self._T_world_last, reference)
        self._current = self._prepared(frame)
        if self._reference is None:
            return Track(frame.index, "initial", "fixes the world", np.eye(4), frame.index)
        motion = self._aligned(self._current, self._reference)
        if motion.trouble:
            return Track(frame.index, "lost", motion.trouble, self._T_world_last, reference)
        assert self._reference.frame.T_world_camera is not None
        self._T_world_last = self._reference.frame.T_world_camera @ motion.T_reference_current
        return Track(frame.index, "ok", "", self._T_world_last, reference)

    def wants_keyframe(self) -> bool:
        """Return True: the odometry goes from frame to frame."""
        return True

    def adopt(self, frame: Frame, *, measured: bool) -> bool:
        """Make a tracked frame the reference; False where too little of its depth is known.

        `measured` makes no difference. Raises `ValueError` for a frame without pose.
        """
        if frame.T_world_camera is None:
            raise ValueError("a reference needs a pose")
        if _known(frame).mean() < _LEAST_SHARE:
            return False
        tracked = self._current
        same = tracked is not None and tracked.frame.index == frame.index and _same_input(tracked.frame, frame)
        # Preparing twice what did not change would be charged to the method's time.
        self._reference = _Prepared(frame, tracked.data) if same and tracked else self._prepared(frame)
        return True

    def _prepared(self, frame: Frame) -> _Prepared:
        with self._quiet():
            return _Prepared(frame, self._aligner.prepare(frame))

    def _aligned(self, current: _Prepared, reference: _Prepared) -> _Motion:
        try:
            with self._quiet():
                motion = self._aligner.align(current, reference)
        except RuntimeError as error:
            return _Motion(np.eye(4), f"Open3D refused: {_plain(str(error))}")
        if not np.isfinite(motion.T_reference_current).all():
            return _Motion(np.eye(4), "the alignment diverged")
        return motion

    def _quiet(self) -> Any:
        """Context in which Open3D prints nothing; what it would warn of is found in its results."""
        utility = self._open3d.utility
        return utility.VerbosityContextManager(utility.VerbosityLevel.Error)


def load_open3d() -> Any:
    """Return the module `open3d`; raises `SettingsError`, with what to install, where it cannot be imported."""
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise SettingsError(
            f"running an odometry of Open3D: it cannot be imported ({_plain(str(error))}); pip install "
            "'scopemap[baselines]', and on Debian apt install libusb-1.0-0 libgl1 libx11-6 libegl1"
        ) from None


def _known(frame: Frame) -> np.ndarray:
    """Return usable pixels of known depth, (H, W) bool."""
    if frame.depth_mm is None:
        raise ValueError("an RGB-D odometry needs frames with depth")
    return frame.valid & np.isfinite(frame.depth_mm)


def _same_input(one: Frame, other: Frame) -> bool:
    assert one.depth_mm is not None
    assert other.depth_mm is not None
    same_depth = np.array_equal(one.depth_mm, other.depth_mm, equal_nan=True)
    return same_depth and np.array_equal(one.valid, other.valid) and np.array_equal(one.rgb, other.rgb)


def _depth_image(open3d: Any, frame: Frame) -> Any:
    assert frame.depth_mm is not None
    return open3d.geometry.Image(np.where(_known(frame), frame.depth_mm, 0).astype(np.float32))


def _intrinsics(open3d: Any, frame: Frame) -> Any:
    camera = frame.camera
    return open3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def _in_mm(T: np.ndarray) -> np.ndarray:
    T_mm = np.array(T, dtype=np.float64)
    T_mm[:3, 3] *= UNIT_MM
    return T_mm


def _is_identity(T: np.ndarray) -> bool:
    return bool((np.asarray(T) == np.eye(4)).all())


def _plain(message: str) -> str:
    """Return the last line of a message, without colours of a terminal."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", message).strip().splitlines()
    return lines[-1].strip() if lines else "no reason given"


_ALIGNERS: dict[str, tuple[Callable[[Any, str], _RgbdAligner | _IcpAligner], str]] = {
    "Steinbruecker (Open3D)": (_RgbdAligner, "RGBDOdometryJacobianFromColorTerm"),
    "Park (Open3D)": (_RgbdAligner, "RGBDOdometryJacobianFromHybridTerm"),
    "Point-to-point ICP (Open3D)": (_IcpAligner, "TransformationEstimationPointToPoint"),
    "Point-to-plane ICP (Open3D)": (_IcpAligner, "TransformationEstimationPointToPlane"),
}


def _factory(method: str) -> Callable[[], FrameTracker]:
    return lambda: Open3dTracker(method)


OPEN3D_METHODS: dict[str, Callable[[], FrameTracker]] = {method: _factory(method) for method in _ALIGNERS}
"""Makers of the four odometries by their titles in tables; each raises `SettingsError` where Open3D is missing."""
