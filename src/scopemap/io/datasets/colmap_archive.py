"""COLMAP's sub-models in a zip archive: `sparse/<M>/images.bin`, and `cluster_list/<M>.txt` with its frames."""

from __future__ import annotations

import lzma
import re
import shutil
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from scopemap.errors import InputError
from scopemap.geometry.se3 import inverse
from scopemap.io.datasets.colmap_files import image_path, read_images
from scopemap.trajectory.formats.colmap import poses_of

_IMAGES = re.compile(r"(.*/)?sparse/(\d{1,9})/images\.bin")
_LARGEST_MODEL_BYTES = 1 << 30
_MOST_IMAGES = 1_000_000
_COUNT_BYTES = 8
# Poses and points hardly compress: what claims to be larger than this, and that many times its place, is no model.
_PLAUSIBLE_BYTES, _PLAUSIBLE_RATIO = 16 << 20, 200
_MOST_MODELS = 64
_LONGEST_LIST_BYTES = 1 << 20
# What zipfile raises for damage; a RuntimeError for a password and for a compression that it does not know.
_DAMAGE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, RuntimeError, ValueError)


@dataclass(frozen=True)
class SubModel:
    """One of COLMAP's sub-models; frame and scale are its own.

    Attributes
    ----------
    number : the name of its folder.
    count : how many sub-models the archive holds.
    poses : (4, 4) float64 camera-to-world, in the model's unit, by the image's file name.
    """

    number: int
    count: int
    poses: dict[str, np.ndarray]


def read_largest_model(archive: Path) -> SubModel:
    """Return the sub-model whose list names the most frames, without lists the longest file; of equals the first.

    Raises `InputError` for an archive that is damaged, holds no sub-model with poses, or claims to hold too much.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            members = {int(match[2]): match for name in opened.namelist() if (match := _IMAGES.fullmatch(name))}
            if not members:
                raise InputError(f"reading {archive}: it holds no COLMAP model (sparse/<number>/images.bin)")
            if len(members) > _MOST_MODELS:
                raise InputError(
                    f"reading {archive}: it holds {len(members)} sub-models, expected {_MOST_MODELS} at most; leave "
                    "small ones out"
                )
            sizes = _sizes(opened, members)
            number = max(sizes, key=lambda number: (sizes[number], -number))
            poses = _poses(opened, archive, members[number][0])
    except _DAMAGE as error:
        raise InputError(f"reading {archive}: the archive is damaged or incomplete ({error})") from None
    return SubModel(number, len(members), poses)


def _sizes(opened: zipfile.ZipFile, members: dict[int, re.Match[str]]) -> dict[int, int]:
    lists = {number: f"{match[1] or ''}cluster_list/{number}.txt" for number, match in members.items()}
    if not set(lists.values()) <= set(opened.namelist()):
        return {number: opened.getinfo(match[0]).file_size for number, match in members.items()}
    sizes = {}
    for number, name in lists.items():
        with opened.open(name) as stream:
            sizes[number] = len(stream.read(_LONGEST_LIST_BYTES).split())
    return sizes


def _poses(opened: zipfile.ZipFile, archive: Path, member: str) -> dict[str, np.ndarray]:
    with TemporaryDirectory() as folder:
        unpacked = Path(folder) / "images.bin"
        _unpack(opened, archive, member, unpacked)
        try:
            images = [image for image in read_images(unpacked) if image.is_posed]
            T_camera_world = poses_of(images)
        except InputError as error:
            # The place where it was unpacked to tells nobody anything.
            raise InputError(str(error).replace(str(unpacked), f"{archive}, {member}")) from None
    names = [image_path(image).name for image in images]
    return dict(zip(names, inverse(T_camera_world), strict=True))


def _unpack(opened: zipfile.ZipFile, archive: Path, member: str, unpacked: Path) -> None:
    """Write `member` to the file `unpacked`; zipfile never gives more than the size that was looked at."""
    size, stored = opened.getinfo(member).file_size, opened.getinfo(member).compress_size
    if size > _LARGEST_MODEL_BYTES or size > max(_PLAUSIBLE_BYTES, _PLAUSIBLE_RATIO * stored):
        raise InputError(
            f"reading {archive}: {member} claims {size >> 20} MB in {stored} bytes, expected "
            f"{_LARGEST_MODEL_BYTES >> 20} MB and {_PLAUSIBLE_RATIO} times its compressed size at most"
        )
    with opened.open(member) as stream, unpacked.open("wb") as file:
        start = stream.read(_COUNT_BYTES)
        count = int.from_bytes(start, "little")
        if count > _MOST_IMAGES:
            raise InputError(f"reading {archive}: {member} claims {count} images, expected {_MOST_IMAGES} at most")
        file.write(start)
        shutil.copyfileobj(stream, file)
