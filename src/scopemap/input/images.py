"""A folder of images, sorted by the numbers in their names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from statistics import median

import cv2
import numpy as np

from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.camera_files.reading import stated_calibration
from scopemap.input.decoding import frame_number, read_decoded, stated_size
from scopemap.input.image_names import Chosen, chosen_frames, in_order, times_in_names
from scopemap.input.sampling import MOST_REPEATS, SampledPair, pair_of
from scopemap.input.source import OWN_CALIBRATION, Source, SourceFrame

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_MOST_HEADERS = 500  # are looked at
_LATEST_START_S = 1e6  # of a video whose frames are numbered: 11 days
_BITS = 16
_CAMERA_BITS = (8, 10, 12, 14)  # of sensors, as they are left in 16 bits
_OF_16_BITS = (".png", ".tif", ".tiff")
_LOOKED_AT = 16  # pictures, for their largest level
_COMPANION = re.compile(r"[_.](depth|normals?|flow|occlusions?|masks?)$", re.IGNORECASE)

DepthCode = tuple[tuple[int, float, int], ...]
"""How integer images store depth, by bits: (bits, mm per level, largest level that is a depth). Level 0 is unknown."""


def image_files(folder: Path) -> list[Path]:
    """Return the colour images in `folder` in numeric order; not depth, not masks, none of a run's folder."""
    if _is_result(folder):
        return []
    files = in_order(images_in(folder))
    return [file for file in files if not _COMPANION.search(file.stem)]


def _pictures_in(folder: Path) -> list[Path]:
    return [] if _is_result(folder) else images_in(folder)


def _is_result(folder: Path) -> bool:
    return all((folder / name).is_file() for name in ("trajectory.tum", "provenance.json"))


def images_in(folder: Path) -> list[Path]:
    """Return all images in `folder`, depth and masks too, but for hidden files; [] where there is no folder."""
    files = folder.iterdir() if folder.is_dir() else ()
    return [file for file in files if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")]


def read_image(file: Path, bits: int = 16) -> np.ndarray | None:
    """Return the image as (h, w, 3) uint8 RGB, whatever its depth and channels; None where it cannot be read.

    bits : how many of 16 are used, where they are fewer.
    """
    if bits == _BITS:
        image = read_decoded(file, cv2.IMREAD_COLOR)
        return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    image = read_decoded(file, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image is not None and image.dtype == np.uint16:
        image = np.minimum(image >> (bits - 8), 255).astype(np.uint8)
    elif image is not None:
        image = read_decoded(file, cv2.IMREAD_COLOR)
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _used_bits(files: list[Path]) -> int:
    """Return how many bits pictures of 16 bits use, by the largest level of some of them: cameras have 10, 12 or 14."""
    largest = 0
    for file in files[:: max(1, len(files) // _LOOKED_AT)]:
        image = read_decoded(file, cv2.IMREAD_UNCHANGED) if file.suffix.lower() in _OF_16_BITS else None
        if image is None or image.dtype != np.uint16:
            return _BITS
        largest = max(largest, int(image[..., :3].max() if image.ndim == 3 else image.max()))
        if largest >= 1 << _CAMERA_BITS[-1]:
            return _BITS
    return next((bits for bits in _CAMERA_BITS if largest < 1 << bits), _BITS) if largest else _BITS


class ImageFolder(Source):
    """A folder of images. A reader of a data set fills in what it knows: `poses`, `times_s` and `depth_files`.

    depth_files : depth images by frame number, stored as `depth_code` has it. The calibration is `camera.yaml` in the
    folder, else beside the images; one that cannot be read is its `camera_fault`. Raises `InputError` where no image
    can be read.
    """

    name = "images"
    depth_code: DepthCode = ((16, 1.0, 65535),)

    def __init__(self, path: Path, files: list[Path] | None = None) -> None:
        super().__init__(path)
        chosen = chosen_frames(path, _pictures_in(path)) if files is None else Chosen(files, [], [])
        self.files, self.notes, self.warnings = chosen.files, [*chosen.notes], [*chosen.warnings]
        self.numbers: list[int] = _numbers(self.files)
        self.count = len(self.files)
        self.depth_files: dict[int, Path] = {}
        self._take_times()
        self._bits = _used_bits(self.files)
        if self._bits != _BITS:
            self.notes.append(f"levels: 16-bit pictures hold {self._bits} bits, which are scaled to the whole range")
        self.height, self.width = self._size()
        with self._making_camera():
            use_first_calibration(self, path / OWN_CALIBRATION, self.files[0].with_name(OWN_CALIBRATION))

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether `path` is a folder with images."""
        return bool(image_files(path))

    @property
    def file_of(self) -> dict[int, Path]:
        """The images by frame number."""
        return dict(zip(self.numbers, self.files, strict=True))

    def picture_files(self) -> dict[int, Path]:
        """Return the files of the frames by number."""
        return self.file_of

    def entry(self, number: int) -> int:
        """Return the position itself: each picture is a file."""
        return number

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; unreadable files, with a warning, and those of another size are left out."""
        for number, file in list(zip(self.numbers, self.files, strict=True))[selection]:
            rgb = self._image(file)
            if rgb is None:
                self._warn(f"{file} cannot be read and was left out")
                continue
            frame = self._of_one_size(SourceFrame(number, self._time_s(number), rgb, file.name))
            if frame is not None:
                yield frame

    def sample_pairs(self, count: int) -> list[SampledPair]:
        """Return about `count` pictures from all parts of the folder, each with the next other one."""
        starts = range(0, len(self.files), max(1, len(self.files) // count))[:count]
        runs = (self.frames(slice(start, start + 1 + MOST_REPEATS)) for start in starts)
        return [pair for run in runs if (pair := pair_of(frame.rgb for frame in run)) is not None]

    def _take_times(self) -> None:
        """Take the times that the names give, else the numbers over the assumed rate."""
        times_s, source = times_in_names(self.files, self.numbers) if self.name == ImageFolder.name else ([], "")
        if times_s:
            self.times_s, self.stamped = dict(zip(self.numbers, times_s, strict=True)), True
            self.rate_hz = 1 / median(b - a for a, b in pairwise(times_s))
        else:
            first = self.numbers[0] if self.numbers else 0
            source = f"frame number / {self.rate_hz:g} s (the folder holds none)"
            if first / self.rate_hz > _LATEST_START_S:  # a date or the number of a patient
                self.times_s = {number: (number - first) / self.rate_hz for number in self.numbers}
                source = f"frame number, from {first} on, / {self.rate_hz:g} s (the folder holds none)"
        self.notes.insert(0, f"time stamps: {source}")

    def _image(self, file: Path) -> np.ndarray | None:
        return read_image(file, self._bits)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        """Return the depth (h, w) float32, mm, NaN = unknown; `InputError` unless stored as `depth_code` has it."""
        file = self.depth_files.get(index)
        if file is None:
            return None
        levels = self._depth_levels(file)
        bits = 8 * levels.itemsize if levels is not None and levels.ndim == 2 and levels.dtype.kind == "u" else 0
        known = next((entry for entry in self.depth_code if entry[0] == bits), None)
        if levels is None or known is None:
            allowed = "- or ".join(str(entry[0]) for entry in self.depth_code)
            raise InputError(f"reading {file}: expected a depth image of one {allowed}-bit channel")
        _, mm_per_level, largest = known
        depth_mm = levels * np.float32(self.depth_scale_mm or mm_per_level)
        return np.where((levels > 0) & (levels <= largest), depth_mm, np.nan).astype(np.float32)

    def _depth_levels(self, file: Path) -> np.ndarray | None:
        return read_decoded(file)

    def _size(self) -> tuple[int, int]:
        for file in self.files:
            image = self._image(file)
            if image is not None:
                first = image.shape[0], image.shape[1]
                return self._usual_size(first) if stated_size(file) == first else first
        found = f"none of the {len(self.files)} images can be read" if self.files else "there is no image"
        raise InputError(f"reading {self.path}: {found} (looked for {', '.join(SUFFIXES)})")

    def _usual_size(self, first: tuple[int, int]) -> tuple[int, int]:
        """Return the size of most pictures by their headers, or else that of the first one."""
        every = max(1, len(self.files) // _MOST_HEADERS)
        sizes = Counter(size for file in self.files[::every] if (size := stated_size(file)) is not None)
        size, count = sizes.most_common(1)[0]
        if 2 * count <= sizes.total() and len(sizes) > 2:
            named = ", ".join(f"{n} of {width}x{height} px" for (height, width), n in sizes.most_common(3))
            raise InputError(f"reading {self.path}: its pictures have no common size ({named}); give those of one size")
        return size if count > sizes[first] else first

    @contextmanager
    def _making_camera(self) -> Iterator[None]:
        """Keep an error about the data set's camera as `camera_fault`: another camera may have been given."""
        try:
            yield
        except (CalibrationError, InputError) as fault:
            self.camera_fault = fault


def _numbers(files: list[Path]) -> list[int]:
    """Return the files' own numbers where they have them and these increase, else their positions."""
    numbers = [frame_number(file) for file in files]
    known = [number for number in numbers if number is not None]
    increase = len(known) == len(files) and all(a < b for a, b in pairwise(known))
    return known if increase else list(range(len(files)))


def use_first_calibration(source: Source, *files: Path) -> bool:
    """Have a source use the first calibration of these files beside the frames; return whether there is one."""
    file = next((file for file in files if file.is_file()), None)
    if file is not None:
        stated = stated_calibration(file, (source.width, source.height))
        source.calibration = replace(stated, source=f"{stated.source} beside the frames")
        source.camera, source.camera_source = stated.camera, source.calibration.source
        source.depth_scale_mm = stated.depth_scale_mm
    return file is not None
