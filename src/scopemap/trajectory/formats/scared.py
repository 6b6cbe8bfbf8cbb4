"""SCARED: one JSON of kinematics per frame (Allan et al., "Stereo correspondence and reconstruction of endoscopic data
challenge", arXiv 2101.01133).

`camera-pose` is the 4x4 world-to-camera motion of the left camera, mm; the world is the left camera at the keyframe. So
it is read by scared_toolkit (scaredtk), AF-SfMLearner (export_gt_pose.py), EndoSurf (data/scared2019/preprocess.py) and
SurgCUT3R. The number in a file's name is the frame's: from 0 in SCARED, from 1 and with gaps in SCARED-C
(juseonghan/SCARED-C), whose `camera-calibration` is a file name instead of matrices; it is not needed here.

The unit of `timestamp` is not documented. It is taken for the power of ten of a second by which a frame lasts 10 to
100 ms.
"""

from __future__ import annotations

import json
import re
import tarfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.trajectory.formats.poses import rigid, stamped
from scopemap.trajectory.trajectory import Trajectory, Unit

# A keyframe's folder, its data folder, and where AF-SfMLearner unpacks it.
_FOLDERS = (".", "data", "image_02/data")
_TAR_NAMES = ("frame_data.tar.gz", "frame_data.tar")
_TAR_ENDINGS = (".tar", ".tar.gz", ".tgz")
_MEMBER = re.compile(r"frame_data\D*(\d{1,18})\.json")


@dataclass(frozen=True)
class _Record:
    """What one file says: where it lies, its number, the pose as stored and the time stamp, NaN where there is none."""

    where: str
    index: int
    camera_pose: np.ndarray
    stamp: float


def find_scared(path: Path) -> Path | None:
    """Return the tar or the folder of JSON files with the poses of `path`: itself, or one below a keyframe's folder.

    Unpacked files win over the tar beside them. None where there is nothing.
    """
    if path.is_file():
        return path if path.name.endswith(_TAR_ENDINGS) or tarfile.is_tarfile(path) else None
    for folder in (path / name for name in _FOLDERS):
        for place in (folder / "frame_data", folder):
            if any(_MEMBER.fullmatch(file.name) for file in place.glob("frame_data*.json")):
                return place
        archive = next((folder / name for name in _TAR_NAMES if (folder / name).is_file()), None)
        if archive is not None:
            return archive
    return None


def read_scared(path: Path, unit: Unit) -> Trajectory:
    """Read the poses of a keyframe, always mm: its folder, the folder of its JSON files, or their tar."""
    place = find_scared(path)
    if place is None:
        raise InputError(
            f"cannot read SCARED poses from {path}: looked for frame_data*.json and frame_data.tar.gz, here, in data "
            "and in data/frame_data"
        )
    documents = _from_folder(place) if place.is_dir() else _from_tar(place)
    records = sorted((_record(*document) for document in documents), key=lambda record: record.index)
    if not records:
        raise InputError(f"cannot read SCARED poses from {place}: it holds no frame_data*.json")
    for earlier, later in pairwise(records):
        if earlier.index == later.index:
            raise InputError(f"{later.where}: frame {later.index} comes a second time, it is in {earlier.where} too")
    T = inverse(rigid(np.stack([record.camera_pose for record in records]), [record.where for record in records]))
    indices = np.array([record.index for record in records])
    times_s, words = _times_s(np.array([record.stamp for record in records]), indices)
    return stamped(T, indices, times_s, f"SCARED JSON, world-to-camera inverted, mm, {words}")


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
                    yield f"{path}, {member.name}", int(match[1]), file.read()
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot read SCARED poses from {path}: the tar is damaged ({error})") from None


def _record(where: str, index: int, content: bytes) -> _Record:
    try:
        document = json.loads(content)
        pose = np.array(document["camera-pose"], dtype=np.float64)
        stamp = document.get("timestamp")
        stamp = float("nan" if stamp is None else stamp)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{where}: expected a JSON object with a 4x4 'camera-pose' ({error!r})") from None
    if pose.shape != (4, 4):
        raise InputError(f"{where}: expected a 4x4 'camera-pose', found the shape {pose.shape}")
    return _Record(where, index, pose, stamp)


def _times_s(stamps: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Return times in s, frame 0 at 0, and their base in words; None where the stamps do not ascend."""
    steps = np.diff(stamps) / np.diff(indices)
    if not len(steps) or not np.all(steps > 0) or not np.all(np.isfinite(steps)):
        return None, "30 frames per s (assumed)"
    step = float(np.median(steps))
    exponent = -2 - int(np.floor(np.log10(step)))
    times_s = (stamps - stamps[0] + indices[0] * step) * 10.0**exponent
    return times_s, f"time stamps of 1e{exponent} s (assumed)"
