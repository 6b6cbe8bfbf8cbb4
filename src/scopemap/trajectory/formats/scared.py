"""SCARED: one JSON of kinematics per frame (Allan et al., "Stereo correspondence and reconstruction of endoscopic data
challenge", arXiv 2101.01133).

`camera-pose` is the 4x4 world-to-camera motion of the left camera, mm; the world is the left camera at the keyframe. So
it is read by scared_toolkit, AF-SfMLearner, EndoSurf and SurgCUT3R. The number in a file's name is the frame's: from 0
in SCARED, from 1 and with gaps in SCARED-C, whose `camera-calibration` is a file name instead of matrices. The unit of
`timestamp` is not documented. It is taken for the power of ten of a second by which a frame lasts 10 to 100 ms.
"""

from __future__ import annotations

import json
import math
import re
import tarfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.poses import rigid, stamped
from scopemap.trajectory.trajectory import Trajectory, Unit

# In the order of preference: unpacked files before the tar beside them. AF-SfMLearner unpacks to image_02/data.
SCARED_FILES = tuple(
    f"{folder}{name}"
    for folder in ("", "data/", "image_02/data/")
    for name in ("frame_data/frame_data*.json", "frame_data*.json", "frame_data.tar.gz", "frame_data.tar")
)
"""Where the poses of a keyframe's folder are."""

_TAR_ENDINGS = (".tar", ".tar.gz", ".tgz")
_MEMBER = re.compile(r"frame_data\D*(\d{1,18})\.json")
_LARGEST_BYTES = 1 << 20
_SHORTEST_STEP_POWER = -2
_LARGEST_STAMP = 1e30


@dataclass(frozen=True)
class FrameData:
    """The content of one `frame_data` file.

    where : file. index : number of the frame. T_world_camera : (4, 4), mm, None where it cannot be used, which `fault`
    explains. stamp : `timestamp`.
    """

    where: str
    index: int
    T_world_camera: np.ndarray | None = None
    stamp: Any = None
    fault: str = ""


def parse_frame_data(where: str, index: int, content: bytes) -> FrameData:
    """Return what a `frame_data` file holds; a file that cannot be used is not an error but has a `fault`."""
    T_world_camera, stamp, fault = None, None, ""
    try:
        document = json.loads(content)
        stamp = document.get("timestamp")
        pose = np.array(document["camera-pose"], dtype=np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"found the shape {pose.shape}")
        T_world_camera = inverse(rigid(pose[None], [where])[0])
    except InputError as error:
        fault = str(error)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        fault = f"{where}: expected a JSON object with a 4x4 'camera-pose' ({error!r})"
    return FrameData(where, index, T_world_camera, stamp, fault)


def times_of(frames: list[FrameData]) -> tuple[dict[int, float], str]:
    """Return the time of each frame, s, frame 0 at 0, and the unit of the stamps in words.

    frames : in ascending order of index. Empty where stamps are missing, do not ascend, or step by a whole power of
    ten: those merely count frames.
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


def find_scared(path: Path) -> Path | None:
    """Return the tar or the folder of JSON files with the poses in `path`, a file or folder; or None."""
    if path.is_file():
        return path if path.name.endswith(_TAR_ENDINGS) or tarfile.is_tarfile(path) else None
    found = (file for pattern in SCARED_FILES for file in path.glob(pattern) if file.is_file())
    first = next(found, None)
    return first.parent if first is not None and first.suffix == ".json" else first


def read_scared(path: Path, unit: Unit) -> Trajectory:
    """Read the poses of a keyframe, always mm: its folder, the folder of its JSON files, or their tar."""
    place = find_scared(path)
    if place is None:
        raise InputError(
            f"cannot read SCARED poses from {path}: looked for frame_data*.json and frame_data.tar.gz, here, in data "
            "and in data/frame_data"
        )
    documents = _from_folder(place) if place.is_dir() else _from_tar(place)
    frames = sorted((parse_frame_data(*document) for document in documents), key=lambda frame: frame.index)
    if not frames:
        raise InputError(f"cannot read SCARED poses from {place}: it holds no frame_data*.json")
    for earlier, later in pairwise(frames):
        if earlier.index == later.index:
            raise InputError(f"{later.where}: frame {later.index} comes a second time, it is in {earlier.where} too")
    fault = next((frame.fault for frame in frames if frame.fault), "")
    if fault:
        raise InputError(fault)
    poses = [frame.T_world_camera for frame in frames if frame.T_world_camera is not None]
    times_s, words = times_of(frames)
    indices = np.array([frame.index for frame in frames])
    source = f"SCARED JSON, world-to-camera inverted, mm, {words or '30 frames per s (assumed)'}"
    return stamped(np.stack(poses), indices, np.array(list(times_s.values())) if times_s else None, source)


def _from_folder(folder: Path) -> Iterator[tuple[str, int, bytes]]:
    for path in folder.glob("frame_data*.json"):
        if match := _MEMBER.fullmatch(path.name):
            yield str(path), int(match[1]), path.read_bytes()


def _from_tar(path: Path) -> Iterator[tuple[str, int, bytes]]:
    try:
        # Read as a stream and never unpacked: names in a tar may point anywhere.
        with tarfile.open(path, "r:*") as archive:
            for member in archive:
                match = _MEMBER.fullmatch(member.name.rpartition("/")[2])
                file = archive.extractfile(member) if match and member.isfile() else None
                if match and file:
                    yield f"{path}, {member.name}", int(match[1]), file.read(_LARGEST_BYTES)
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot read SCARED poses from {path}: the tar is damaged ({error})") from None
