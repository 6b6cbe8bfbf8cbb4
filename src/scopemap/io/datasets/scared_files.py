"""The files of SCARED and of SCARED-C: `frame_data` (pose, calibration, time) and `scene_points` (surface per pixel).

`camera-pose` takes a point in the world to the left camera, mm, OpenCV axes; the world is the left camera at the
keyframe. A scene point file holds X, Y, Z per pixel in the camera's frame, mm, the left view above the right one.
Allan et al., "Stereo correspondence and reconstruction of endoscopic data challenge", arXiv 2101.01133.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.formats.parsing import Fields
from scopemap.cameras.formats.reading import of_fields
from scopemap.errors import CalibrationError, InputError
from scopemap.frame import TruthQuality
from scopemap.geometry.se3 import inverse, orthonormalised
from scopemap.io.datasets.numbered import NumberedFiles, find_numbered
from scopemap.io.decoding import decoded
from scopemap.io.source import SourceTruth

# The last place are files that lie loose in `data`; an archive of that name is not meant.
_FRAME_DATA = ("data/frame_data", "frame_data", "image_02/data/frame_data", "data/.")
_SCENE_POINTS = ("data/scene_points", "scene_points", "image_02/data/groundtruth")
_RIGID_TOLERANCE = 1e-2
# The unit of time stamps is not documented; that a camera takes a picture in 10 to 100 ms tells it.
_SHORTEST_STEP_POWER = -2
_WHOLE_POWER = 1e-9
_LARGEST_STAMP = 1e30


@dataclass(frozen=True)
class FrameData:
    """What the `frame_data` files say, by frame number.

    Attributes
    ----------
    numbers : frames that have a file, ascending.
    poses : (4, 4) float64 camera-to-world, mm; a frame whose pose cannot be used is not among them.
    times_s : seconds since the first frame; empty where the time stamps are missing or do not increase.
    calibration : the first file's `camera-calibration`, or None where that is only a file's name.
    faults : what is wrong with the files, one sentence each.
    """

    numbers: list[int] = field(default_factory=list)
    poses: dict[int, np.ndarray] = field(default_factory=dict)
    times_s: dict[int, float] = field(default_factory=dict)
    calibration: dict[str, Any] | None = None
    faults: list[str] = field(default_factory=list)


def read_frame_data(folder: Path) -> FrameData:
    """Return the poses, time stamps and calibration below a keyframe's `folder`; empty where there is no such file.

    They are read at once and kept: a pose is small. Raises `InputError` for a damaged archive; a single file that
    cannot be used is a fault, and its frame has no pose.
    """
    files = find_numbered(folder, _FRAME_DATA, "frame_data", (".json",))
    poses: dict[int, np.ndarray] = {}
    stamps: dict[int, Any] = {}
    calibration: dict[str, Any] | None = None
    bad: list[str] = []
    for name, number, content in files or []:
        try:
            entry = json.loads(content)
            stamps[number] = entry.get("timestamp")
            found = entry.get("camera-calibration")
            poses[number] = _pose(entry.get("camera-pose"))
        except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            bad.append(f"{name}: {error}")
            stamps.setdefault(number, None)
        else:
            calibration = found if calibration is None and isinstance(found, dict) else calibration
    stamps = dict(sorted(stamps.items()))
    faults = [] if not bad or files is None else [_told(files.path, bad, len(stamps))]
    back = _first_not_later(stamps)
    if files is not None and back is not None:
        faults.append(f"{files.path}: the time stamp of frame {back} is not after the one before; none is used")
    return FrameData(sorted(stamps), poses, _seconds(stamps), calibration, faults)


def calibration_camera(calibration: dict[str, Any], size: tuple[int, int], source: str) -> CameraModel:
    """Return the left camera of a `camera-calibration` entry for images of `size` (width, height), px.

    `KL` is its matrix, `DL` holds k1 k2 p1 p2 k3. Raises `CalibrationError` where they are not there.
    """
    try:
        return of_fields(Fields(calibration.items()), size).camera
    except ValueError as error:
        raise CalibrationError(f"the calibration in {source} cannot be used: {error}") from None


class ScenePoints:
    """The true surface of a keyframe's frames: read on demand, one frame at a time, nothing kept.

    folder : the keyframe's. size : (width, height) of the left images, px.
    """

    def __init__(self, folder: Path, size: tuple[int, int]) -> None:
        self._files: NumberedFiles | None = find_numbered(folder, _SCENE_POINTS, "scene_points", (".tiff", ".tif"))
        self._size = size

    def depth_mm(self, number: int) -> np.ndarray | None:
        """Return the left view's depth (h, w) float32, NaN = unknown; None where the frame has no scene points.

        Raises `InputError` where the file is not what it should be.
        """
        content = None if self._files is None else self._files.read(number)
        if content is None or self._files is None:
            return None
        where = f"{self._files.path}, frame {number}"
        points = _points_in(content, where)
        rows, columns = points.shape[:2]
        width, height = self._size
        if rows * width not in (height * columns, 2 * height * columns):
            raise InputError(
                f"reading {where}: scene points of {columns}x{rows} px fit neither the left images of {width}x{height} "
                "px nor both views above each other"
            )
        # The left view lies on top; OpenCV turns X, Y, Z round as it does R, G, B.
        depth_mm = points[: height * columns // width, :, 0]
        return np.where(np.isfinite(depth_mm) & (depth_mm > 0), depth_mm, np.nan).astype(np.float32)


class KeyframeTruth:
    """Poses and surface of a keyframe's frames, for the sources of both data sets.

    folder : the keyframe's. size : (width, height) of the left images, px. scale_mm : mm per unit of the scene points.
    """

    def __init__(
        self, folder: Path, data: FrameData, size: tuple[int, int], quality: TruthQuality, scale_mm: float = 1.0
    ) -> None:
        self._data, self._points = data, ScenePoints(folder, size)
        self._quality, self._scale_mm = quality, np.float32(scale_mm)

    def pose(self, index: int) -> np.ndarray | None:
        """Return the camera-to-world pose (4, 4), mm, or None."""
        return self._data.poses.get(index)

    def of_frame(self, index: int) -> SourceTruth | None:
        """Return pose and depth, each where it is known; None where neither is."""
        pose, depth_mm = self.pose(index), self._points.depth_mm(index)
        if pose is None and depth_mm is None:
            return None
        return SourceTruth(pose, None if depth_mm is None else depth_mm * self._scale_mm, self._quality)


def _points_in(content: bytes, where: str) -> np.ndarray:
    points = decoded(content)
    if points is None or points.dtype != np.float32 or points.ndim != 3 or points.shape[2] != 3:
        found = "no readable image" if points is None else f"{points.dtype} of shape {points.shape}"
        raise InputError(f"reading {where}: expected scene points, an image of three 32-bit floats, found {found}")
    return points


def _pose(matrix: object) -> np.ndarray:
    """Return the camera-to-world pose of a `camera-pose` entry; `ValueError` for what is no rigid motion."""
    T_camera_world = np.array(matrix, dtype=np.float64)
    if T_camera_world.shape != (4, 4) or not np.isfinite(T_camera_world).all():
        raise ValueError("its camera-pose is no matrix of 4x4 numbers")
    R = T_camera_world[:3, :3]
    deviation = np.abs(R.T @ R - np.eye(3)).max()
    if deviation > _RIGID_TOLERANCE or np.linalg.det(R) < 0 or not np.allclose(T_camera_world[3], [0, 0, 0, 1]):
        raise ValueError("its camera-pose is no rigid motion")
    return inverse(orthonormalised(T_camera_world))


def _seconds(stamps: dict[int, Any]) -> dict[int, float]:
    """Return seconds since the first stamp, or nothing where stamps are missing, fall, or have no plausible unit.

    The unit is the power of ten that makes the median step 10 to 100 ms. Stamps whose smallest step is itself a power
    of ten merely count frames: they have none.
    """
    values = list(stamps.values())
    if len(values) < 2 or not _are_numbers(values):
        return {}
    # Whole numbers of nanoseconds since 1970 have more digits than a float.
    since_first = [float(value - values[0]) for value in values]
    steps = np.diff(since_first)
    if not (steps > 0).all():
        return {}
    smallest = math.log10(steps.min())
    if abs(smallest - round(smallest)) < _WHOLE_POWER:
        return {}
    unit_s = 10.0 ** (_SHORTEST_STEP_POWER - math.floor(math.log10(np.median(steps))))
    return {number: since * unit_s for number, since in zip(stamps, since_first, strict=True)}


def _are_numbers(values: list[Any]) -> bool:
    return all(isinstance(value, int | float) and abs(value) < _LARGEST_STAMP for value in values)


def _first_not_later(stamps: dict[int, Any]) -> int | None:
    """Return the first frame whose stamp is not after that of the frame before; None where all are, or are no times.

    Stamps that are all the same, as zeros are, were never times.
    """
    values = list(stamps.values())
    if not _are_numbers(values) or len(set(values)) < 2:
        return None
    pairs = zip(list(stamps)[1:], values, values[1:], strict=False)
    return next((number for number, before, stamp in pairs if not stamp > before), None)


def _told(path: Path, bad: list[str], count: int) -> str:
    return f"{path}: {len(bad)} of {count} files cannot be used, so their frames have no true pose (first: {bad[0]})"
