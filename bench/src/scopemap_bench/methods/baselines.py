"""The baselines' trackers: Open3D's odometries (MIT, extra `baselines`), Endo-Depth-and-Motion, standing still.

Open3D, from frame to frame. steinbruecker: photometric term (Steinbruecker, Sturm and Cremers, ICCV Workshops 2011).
park: photometric and geometric term (Park, Zhou and Koltun, ICCV 2017). point-to-point ICP (Besl and McKay, 1992),
point-to-plane (Chen and Medioni, 1992). Its defaults are made for rooms in metres, so one of its units is 100 mm here.
A frame is lost where no pixels correspond or the linear system is singular.

Endo-Depth-and-Motion (Recasens, Lamarca, Facil, Montiel and Civera, RA-L 2021, arXiv 2103.16525), re-derived: our
tracker with the parts taken off that it does not have, by arXiv 2508.11282, which grew out of it:
Gauss-Newton on the residual lifted with the keyframe's depth, rotation before the whole motion, a keyframe every 2
frames, two scales, a robust error. No code of that project was used. Ours to choose: Huber's threshold (1.345 robust
standard deviations), no motion as the start, 30 steps per scale, half the working size for the rotation. A frame is
lost only where the image or its overlap with the keyframe is nearly empty, or the result is not finite.
"""

from __future__ import annotations

import importlib
import re
from typing import Any, NamedTuple

import numpy as np

from scopemap.engine.config.tracking import TrackingSettings
from scopemap.engine.errors import SettingsError
from scopemap.engine.frame import Frame
from scopemap.engine.tracking.track import FrameTracker, KeyframeDecision, Track
from scopemap.engine.tracking.tracker import Tracker

UNIT_MM = 100.0
"""Length of one Open3D unit, mm."""

_DEPTH_MAX_UNITS = 5.0
_VOXEL_MM = 1.0
_ICP_MAX_DISTANCE_MM = 3.0
_MIN_KNOWN_SHARE = 0.1  # of the image with known depth, the default of our own tracker
_SINGULAR = "Open3D's linear system is singular: it took no step"

RGBD_METHODS = {"steinbruecker": "RGBDOdometryJacobianFromColorTerm", "park": "RGBDOdometryJacobianFromHybridTerm"}
ICP_METHODS = {
    "point-to-point": "TransformationEstimationPointToPoint",
    "point-to-plane": "TransformationEstimationPointToPlane",
}
"""Open3D's classes by the name of the method."""
OPEN3D_METHODS = (*RGBD_METHODS, *ICP_METHODS)
INSTALL_OPEN3D = (
    "pip install -c constraints.txt -e './bench[baselines]', and on Debian apt install libusb-1.0-0 libgl1 libx11-6 "
    "libegl1"
)

SETTINGS = TrackingSettings(
    keyframe_every=2,
    relocalisation_keyframes=0,
    new_map_after=0,
    corner_depth_sigma=0.0,
    min_keyframe_agreement=0.0,
    levels=2,
    finest_level=0,
    huber=1.345,
    checks="none",
    solver="gauss-newton",
    rotation_first=True,
    photometric="paper",
)
"""Settings of our tracker for this method; all others have no effect or only detect empty images."""
_MIN_USABLE_SHARE = 0.1  # of the image, the default of our own tracker
_EVERY_FRAME = KeyframeDecision("new", "every frame is the reference of the next one")


class _NoMotion(Exception):
    """Open3D found no motion; the message is the reason."""


class _Prepared(NamedTuple):
    """A frame and its RGBDImage or PointCloud."""

    frame: Frame
    data: Any


class Open3dTracker(FrameTracker):
    """Aligns each frame to the last tracked one by `method`; two runs agree to rounding, as threads sum in any order.

    Raises `SettingsError` where Open3D cannot be imported.
    """

    def __init__(self, method: str) -> None:
        self._open3d, self._method = load_open3d(), method
        self._reference: _Prepared | None = None
        self._current: _Prepared | None = None
        self._T_world_last = np.eye(4)

    def track(self, frame: Frame) -> Track:
        """Return the pose of a frame with depth, or why it is lost; the first frame with enough depth is "initial"."""
        reference = self._reference
        index = reference.frame.index if reference else frame.index
        known = float((_known_depth_mm(frame) > 0).mean())
        if known < _MIN_KNOWN_SHARE:
            return Track(frame.index, "lost", f"only {known:.0%} of the image is usable", self._T_world_last, index)
        self._current = self._prepared(frame)
        if reference is None:
            return Track(frame.index, "initial", "fixes the world", np.eye(4), index, decision=_EVERY_FRAME)
        try:
            T_reference_current = self._motion(self._current, reference)
        except _NoMotion as reason:
            return Track(frame.index, "lost", str(reason), self._T_world_last, index)
        assert reference.frame.T_world_camera is not None
        self._T_world_last = reference.frame.T_world_camera @ T_reference_current
        return Track(frame.index, "ok", "", self._T_world_last, index, decision=_EVERY_FRAME)

    def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        """Make a tracked frame the reference; False where too little depth is known, `ValueError` without a pose."""
        if frame.T_world_camera is None:
            raise ValueError("a reference needs a pose")
        if (_known_depth_mm(frame) > 0).mean() < _MIN_KNOWN_SHARE:
            return False
        self._reference = self._prepared(frame)
        return True

    def _prepared(self, frame: Frame) -> _Prepared:
        """Return the frame as Open3D takes it, in its units; pixels of depth 0 are left out."""
        current, depth_mm = self._current, _known_depth_mm(frame)
        # Depth that was not refined is not prepared a second time.
        same = current is not None and current.frame.index == frame.index
        if current is not None and same and np.array_equal(depth_mm, _known_depth_mm(current.frame)):
            return _Prepared(frame, current.data)
        geometry, limits = self._open3d.geometry, {"depth_scale": UNIT_MM, "depth_trunc": _DEPTH_MAX_UNITS}
        with self._silent():
            depth = geometry.Image(depth_mm)
            if self._method in RGBD_METHODS:
                image, create = geometry.Image(np.ascontiguousarray(frame.rgb)), geometry.RGBDImage
                return _Prepared(frame, create.create_from_color_and_depth(image, depth, **limits))
            cloud = geometry.PointCloud.create_from_depth_image(depth, self._intrinsics(frame), **limits)
            cloud = cloud.voxel_down_sample(_VOXEL_MM / UNIT_MM)
            if self._method == "point-to-plane":
                cloud.estimate_normals()
            return _Prepared(frame, cloud)

    def _motion(self, current: _Prepared, reference: _Prepared) -> np.ndarray:
        """Return `T_reference_current` (4, 4) in mm; raises `_NoMotion`."""
        try:
            with self._silent():
                T = (self._rgbd_motion if self._method in RGBD_METHODS else self._icp_motion)(current, reference)
        except RuntimeError as error:
            raise _NoMotion(f"Open3D failed: {_last_line(str(error))}") from None
        if not np.isfinite(T).all():
            raise _NoMotion("the alignment diverged")
        T[:3, 3] *= UNIT_MM
        return T

    def _rgbd_motion(self, current: _Prepared, reference: _Prepared) -> np.ndarray:
        odometry = self._open3d.pipelines.odometry
        term = getattr(odometry, RGBD_METHODS[self._method])()
        option = odometry.OdometryOption(depth_max=_DEPTH_MAX_UNITS)
        success, T, information = odometry.compute_rgbd_odometry(
            current.data, reference.data, self._intrinsics(current.frame), np.eye(4), term, option
        )
        if not success or not np.trace(information) > 0:
            raise _NoMotion("Open3D found no pixels that correspond")
        if np.array_equal(T, np.eye(4)) and not np.array_equal(current.frame.rgb, reference.frame.rgb):
            raise _NoMotion(_SINGULAR)
        return np.array(T)

    def _icp_motion(self, current: _Prepared, reference: _Prepared) -> np.ndarray:
        registration = self._open3d.pipelines.registration
        estimation = getattr(registration, ICP_METHODS[self._method])()
        found = registration.registration_icp(
            current.data, reference.data, _ICP_MAX_DISTANCE_MM / UNIT_MM, np.eye(4), estimation
        )
        if not found.fitness > 0:
            raise _NoMotion(f"no points of the two clouds are within {_ICP_MAX_DISTANCE_MM:g} mm of each other")
        if np.array_equal(found.transformation, np.eye(4)) and found.inlier_rmse > 0:
            raise _NoMotion(_SINGULAR)
        return np.array(found.transformation)

    def _intrinsics(self, frame: Frame) -> Any:
        c = frame.camera
        return self._open3d.camera.PinholeCameraIntrinsic(c.width, c.height, c.fx, c.fy, c.cx, c.cy)

    def _silent(self) -> Any:
        """Context in which Open3D prints nothing."""
        utility = self._open3d.utility
        return utility.VerbosityContextManager(utility.VerbosityLevel.Error)


def load_open3d() -> Any:
    """Return the module `open3d`; raises `SettingsError`, with what to install, where it cannot be imported."""
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise SettingsError(
            f"an odometry of Open3D cannot run: Open3D cannot be imported ({_last_line(str(error))}); {INSTALL_OPEN3D}"
        ) from None


def _known_depth_mm(frame: Frame) -> np.ndarray:
    """Return depth (H, W) float32, mm, 0 where it is unknown or the pixel is not usable."""
    if frame.depth_mm is None:
        raise ValueError("an RGB-D odometry needs frames with depth")
    return np.where(frame.valid & np.isfinite(frame.depth_mm), frame.depth_mm, 0).astype(np.float32)


def _last_line(message: str) -> str:
    """Return the last line of a message, without terminal colours."""
    lines = re.sub(r"\x1b\[[0-9;]*m", "", message).strip().splitlines()
    return lines[-1].strip() if lines else "no reason given"


def create_endo_depth_and_motion() -> FrameTracker:
    """Return a tracker after Endo-Depth-and-Motion's paper; the benchmark gives it plain depth."""
    return Tracker(SETTINGS)


class StandingStill(FrameTracker):
    """Returns the first pose for every frame; frames with too few usable pixels are lost, as for the other methods."""

    def __init__(self) -> None:
        self._first: int | None = None

    def track(self, frame: Frame) -> Track:
        """Return the identity; "lost" where less than a tenth of the image is usable."""
        share = float(frame.valid.mean())
        reference = frame.index if self._first is None else self._first
        if share < _MIN_USABLE_SHARE:
            return Track(frame.index, "lost", f"only {share:.0%} of the image is usable", np.eye(4), reference)
        if self._first is None:
            self._first = frame.index
            return Track(frame.index, "initial", "fixes the world", np.eye(4), frame.index)
        return Track(frame.index, "ok", "", np.eye(4), reference)

    def update(self, frame: Frame, decision: KeyframeDecision, *, measured: bool) -> bool:
        """Return False: it uses no frames."""
        return False
