"""Reading and writing of images of unknown origin: 64 million pixels, or `SCOPEMAP_MAX_MEGAPIXELS`, at most."""

from __future__ import annotations

import io
import math
import os
import re
import warnings
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.errors import InputError, reporting

_MOST_MEGAPIXELS = 64.0
_VARIABLE = "SCOPEMAP_MAX_MEGAPIXELS"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG = b"\x89PNG\r\n\x1a\n"
_MOST_MISSING_BYTES = 16 << 20
_WIDTH = 256  # TIFF 6.0, section 8
_HEIGHT = 257
# Where Pillow finds the orientation of a PNG; eXIf may stand behind the picture.
_ORIENTATION_OF_PNG = (b"eXIf", b"Raw profile type exif", b"XML:com.adobe.xmp")
_ON_THEIR_SIDE = (5, 6, 7, 8)  # orientations of Exif 2.32, 4.6.4


def decoded(content: bytes, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray | None:
    """Return the image in a file's `content` (BGR), None where it holds none; `InputError` beyond the limit."""
    claimed = _claimed_pixels(content)
    check_pixels(claimed)
    if content.startswith(_PNG) and not _holds_its_chunks(content):
        return None
    with suppress(cv2.error):
        return cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags) if claimed else None
    return None


def read_decoded(file: Path, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray | None:
    """Return the image in a file as `decoded` does; None also where no file can be read. Errors name the file."""
    try:
        return decoded(file.read_bytes(), flags) if file.is_file() else None  # a pipe would be waited for
    except OSError:
        return None
    except InputError as error:
        raise InputError(f"reading {file}: {error}") from None


def write_encoded(file: Path, image: np.ndarray) -> None:
    """Write an image (BGR) in the format of the file's ending, by any name on Windows, too. Raises `OSError`.

    A TIFF is packed by deflate: OpenCV's own LZW is read by imageio and tifffile with imagecodecs alone.
    """
    is_tiff = file.suffix.lower() in (".tif", ".tiff")
    options = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE] if is_tiff else []
    file.write_bytes(cv2.imencode(file.suffix, image, options)[1].tobytes())


def write_image(file: Path, image: np.ndarray) -> None:
    """Write an image (BGR) into a folder, which is made; raises `InputError` where that fails."""
    with reporting(f"cannot write {file}"):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_encoded(file, image)


def first_bytes(file: Path, count: int) -> bytes:
    """Return the first bytes of a file; none of a pipe, and none where it cannot be read."""
    with suppress(OSError):
        if file.is_file():
            with file.open("rb") as stream:
                return stream.read(count)
    return b""


def check_pixels(claimed: float, doing: str = "decoding an image") -> None:
    """Raise `InputError` where an image claims more pixels than the limit."""
    if claimed > most_pixels():
        raise InputError(f"{doing}: its header claims {limit_in_words()}")


def limit_in_words() -> str:
    """Return the limit of pixels, and how to set another, as the end of a sentence."""
    return f"more than {most_pixels() / 1e6:g} million pixels; if it is sound, set the environment variable {_VARIABLE}"


def most_pixels() -> float:
    """Return the limit of pixels. Raises `InputError` where the environment variable is no number."""
    text = os.environ.get(_VARIABLE, "")
    try:
        return 1e6 * (float(text) if text else _MOST_MEGAPIXELS)
    except ValueError:
        raise InputError(f"the environment variable {_VARIABLE} must be a number, got '{text}'") from None


def stated_size(file: Path) -> tuple[int, int] | None:
    """Return (height, width), px, of an image by its header, as it is to be shown; None where that cannot be read."""
    from PIL import ExifTags, Image

    if not file.is_file():  # a pipe would be waited for
        return None
    try:
        with warnings.catch_warnings(), Image.open(file) as image:
            warnings.simplefilter("ignore")
            if image.format == "PNG" and not _states_orientation(file):
                return image.height, image.width
            swapped = image.getexif().get(ExifTags.Base.Orientation, 1) in _ON_THEIR_SIDE
            return (image.width, image.height) if swapped else (image.height, image.width)
    except Exception:  # damaged headers end in exceptions of any kind
        return None


def _states_orientation(png: Path) -> bool:
    """Return whether a PNG may state an orientation: to look for it, Pillow decodes the picture."""
    content = png.read_bytes()
    return any(name in content for name in _ORIENTATION_OF_PNG)


def _holds_its_chunks(content: bytes) -> bool:
    """Return whether no chunk of a PNG claims far more bytes than follow: OpenCV takes the memory for up to 4 GB."""
    at = len(_PNG)
    while at + 8 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        if length > len(content) - at + _MOST_MISSING_BYTES:
            return False
        at += 12 + length
    return True


def _claimed_pixels(content: bytes) -> float:
    """Return how many pixels the header claims; 0 for formats that Pillow does not know and damaged headers."""
    # Only reading of images waits for the import.
    from PIL import Image, TiffImagePlugin

    file = io.BytesIO(content)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if content[:4] in TIFF:
                # Pillow opens few kinds of TIFF, but reads the directory of all.
                directory = TiffImagePlugin.ImageFileDirectory_v2(content[: 16 if b"+" in content[:4] else 8])
                file.seek(directory.next)
                directory.load(file)
                return int(directory[_WIDTH]) * int(directory[_HEIGHT])
            with Image.open(file) as image:
                return image.width * image.height
    except Image.DecompressionBombError:
        return math.inf
    except Exception:  # damaged headers end in exceptions of any kind
        return 0


def frame_number(path: Path) -> int | None:
    """Return the last number in a file's name, or None."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def by_number(files: Iterable[Path]) -> dict[int, Path]:
    """Return files by the last number in their names, ascending; `InputError` without one, or with one twice."""
    found: dict[int, Path] = {}
    for file in sorted(file for file in files if file.is_file()):
        number = frame_number(file)
        if number is None:
            raise InputError(f"reading {file}: its name holds no number, which would be the frame's")
        if number in found:
            raise InputError(f"reading {file.parent}: {found[number].name} and {file.name} have the same number")
        found[number] = file
    return dict(sorted(found.items()))


def frames_later(files: Sequence[int], frames: Sequence[int]) -> int:
    """Return by how much the numbers of files must change so that both begin and end alike: 0, 1 or -1.

    files, frames : ascending numbers, which may be none.
    """
    if not files or not frames:
        return 0
    ends = frames[0] - min(files), frames[-1] - max(files)
    return ends[0] if ends[0] == ends[1] and abs(ends[0]) == 1 else 0
