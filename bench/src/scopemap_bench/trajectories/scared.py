"""SCARED: one JSON of kinematics per frame (Allan et al., arXiv 2101.01133).

`camera-pose` is the 4x4 world-to-camera motion of the left camera, mm; the world is the left camera at the keyframe. So
it is read by scared_toolkit, AF-SfMLearner, EndoSurf and SurgCUT3R. The number in a file's name is the frame's: from 0
in SCARED, from 1 and with gaps in SCARED-C, whose `camera-calibration` is a file name. The unit of `timestamp` is not
documented: it is taken for the power of ten of a second by which a frame lasts 10 to 100 ms.
"""

from __future__ import annotations

import json
import math
import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.geometry.se3 import inverse
from scopemap.input.trajectory.poses import rigid, stamped
from scopemap.input.trajectory.trajectory import Trajectory, Unit
from scopemap_bench.trajectories.numbered import ARCHIVES, ArchiveFiles, NumberedFiles, find_numbered

_PREFIX = "frame_data"
_SUFFIXES = (".json",)
# AF-SfMLearner unpacks to image_02/data. A place that ends in a dot has loose files.
_PLACES = ("frame_data", ".", "data/frame_data", "data/.", "image_02/data/frame_data", "image_02/data/.")
SCARED_FILES = tuple(f"{place}{end}" for place in _PLACES for end in (f"/{_PREFIX}*.json", *ARCHIVES))
"""Where the poses of a keyframe's folder are: a file of any of these names holds some."""

_SHORTEST_STEP_POWER = -2
_LARGEST_STAMP = 1e30
_LARGEST_FILE_BYTES = 1 << 20  # a file of poses and calibrations holds 2 kB


@dataclass(frozen=True)
class FrameData:
    """The content of one `frame_data` file: number, pose (4, 4), mm, `timestamp`, and why there is no pose."""

    index: int
    T_world_camera: np.ndarray | None = None
    stamp: Any = None
    fault: str = ""


def find_frame_data(path: Path) -> NumberedFiles | None:
    """Return the `frame_data` files of a keyframe's folder, of the folder that holds them, or of their tar; or None."""
    if not path.is_file():
        return find_numbered(path, _PLACES, _PREFIX, _SUFFIXES)
    is_tar = path.name.endswith(ARCHIVES) or tarfile.is_tarfile(path)
    return ArchiveFiles(path, _PREFIX, _SUFFIXES) if is_tar else None


def read_frame_data(files: NumberedFiles) -> list[FrameData]:
    """Return the content of all files, ascending; one that cannot be used is not an error but has a `fault`."""
    numbers = files.stored()
    found = [_parsed(f"{files.path}, {_PREFIX}{n:06d}.json", n, files.read(n, _LARGEST_FILE_BYTES)) for n in numbers]
    return sorted(found, key=lambda frame: frame.index)


def times_of(frames: list[FrameData]) -> tuple[dict[int, float], str]:
    """Return the time of each frame (ascending), s, frame 0 at 0, and the unit of the stamps in words.

    Empty where stamps are missing, do not ascend, or step by a whole power of ten: those merely count frames.
    """
    stamps = [frame.stamp for frame in frames]
    numeric = all(isinstance(stamp, int | float) and abs(stamp) < _LARGEST_STAMP for stamp in stamps)
    if len(stamps) < 2 or not numeric:
        return {}, ""
    indices = np.array([frame.index for frame in frames])
    # Whole numbers of nanoseconds since 1970 have more digits than a float.
    passed = np.array([float(stamp - stamps[0]) for stamp in stamps])
    steps = np.diff(passed) / np.diff(indices)
    if not (steps > 0).all() or math.log10(steps.min()).is_integer():
        return {}, ""
    step = float(np.median(steps))
    exponent = _SHORTEST_STEP_POWER - math.floor(math.log10(step))
    times_s = (passed + indices[0] * step) * 10.0**exponent
    return dict(zip(indices.tolist(), times_s.tolist(), strict=True)), f"time stamps of 1e{exponent} s (assumed)"


def read_scared(path: Path, unit: Unit) -> Trajectory:
    """Read the poses of a keyframe, always mm: its folder, the folder of its JSON files, or their tar."""
    files = find_frame_data(path)
    if files is None:
        raise InputError(
            f"cannot read SCARED poses from {path}: looked for frame_data*.json and frame_data.tar.gz, here, in data "
            "and in data/frame_data"
        )
    frames = read_frame_data(files)
    fault = next((frame.fault for frame in frames if frame.fault), "")
    if fault or not frames:
        raise InputError(fault or f"cannot read SCARED poses from {files.path}: it holds no frame_data*.json")
    poses = [frame.T_world_camera for frame in frames if frame.T_world_camera is not None]
    times_s, words = times_of(frames)
    indices = np.array([frame.index for frame in frames])
    source = f"SCARED JSON, world-to-camera inverted, mm, {words or '30 frames per s (assumed)'}"
    return stamped(np.stack(poses), indices, np.array(list(times_s.values())) if times_s else None, source)


def _parsed(where: str, index: int, content: bytes | None) -> FrameData:
    T_world_camera, stamp, fault = None, None, ""
    try:
        document = json.loads(content or b"")
        stamp = document.get("timestamp")
        pose = np.array(document["camera-pose"], dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"found the shape {pose.shape}")
        T_world_camera = inverse(rigid(pose[None], [where])[0])
    except InputError as error:
        fault = str(error)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        fault = f"{where}: expected a JSON object with a 4x4 'camera-pose' ({error!r})"
    return FrameData(index, T_world_camera, stamp, fault)
