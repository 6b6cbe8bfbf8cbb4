"""The images of a COLMAP model, text and binary (colmap.github.io/format.html).

`images.bin` is little-endian: a count (uint64); per image its number (uint32), qw qx qy qz tx ty tz (double), its
camera's number (uint32), its name ending in a zero byte, a count of points (uint64), 24 bytes each.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from struct import Struct

from scopemap.cameras.formats.colmap_binary import opened_model
from scopemap.errors import InputError
from scopemap.trajectory.formats.colmap import ModelImage, read_text_images

_IMAGE = Struct("<I7dI")
_POINT_BYTES = 24
# An image has at least a letter and the end of its name, and a count of points.
_SMALLEST_IMAGE_BYTES = _IMAGE.size + 2 + Struct("<Q").size


def model_files(folder: Path) -> tuple[Path, Path] | None:
    """Return the files (cameras, images) of the model in `folder`, binary before text as COLMAP does, or None."""
    pairs = ((folder / f"cameras{ending}", folder / f"images{ending}") for ending in (".bin", ".txt"))
    return next((pair for pair in pairs if pair[0].is_file() and pair[1].is_file()), None)


def read_images(file: Path) -> list[ModelImage]:
    """Return the images of a model; `InputError` for a file that is damaged, holds none, or names one twice."""
    images = _binary_images(file) if file.suffix == ".bin" else read_text_images(file)
    if not images:
        raise InputError(f"reading {file}: the COLMAP model holds no image with its pose")
    seen: set[PurePosixPath] = set()
    for image in images:
        if image_path(image) in seen:
            raise InputError(f"{image.where}: the image {image.name!r} comes again; leave one out")
        seen.add(image_path(image))
    return images


def image_path(image: ModelImage) -> PurePosixPath:
    """Return the image's path below the folder of the images, also where a name was written with backslashes."""
    return PurePosixPath(image.name.replace("\\", "/"))


def _binary_images(file: Path) -> list[ModelImage]:
    images = []
    with opened_model(file) as content:
        for position in range(content.count(_SMALLEST_IMAGE_BYTES, "images")):
            _, *values, camera = content.take(_IMAGE)
            images.append(ModelImage(content.name(), camera, tuple(values), f"{file}, image {position + 1}"))
            content.skip(_POINT_BYTES * content.count(_POINT_BYTES, "points of an image"))
        content.check_end()
    return images
