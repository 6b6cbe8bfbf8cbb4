"""A folder of images, sorted by the numbers in their names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from scopemap.cameras.formats.reading import stated_calibration
from scopemap.errors import CalibrationError, InputError
from scopemap.frame import TruthQuality
from scopemap.io.decoding import decoded, read_decoded
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
FOLDER_RATE_HZ = 30.0
_OWN_CALIBRATION = "camera.yaml"
_COMPANION = re.compile(r"[_.](depth|normals?|flow|occlusions?|masks?)$", re.IGNORECASE)


def numeric_order(path: Path) -> list[tuple[int, int, str]]:
    """Sorting key: digits in the name count as numbers, so that 10 comes after 9."""
    parts = re.split(r"(\d+)", path.stem)
    return [(1, int(part), "") if part.isdigit() else (0, 0, part) for part in parts]


def frame_number(path: Path) -> int | None:
    """Return the last number in a file's name, or None."""
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1]) if numbers else None


def image_files(folder: Path) -> list[Path]:
    """Return the colour images in `folder` in numeric order; depth, masks and hidden files are not among them."""
    files = (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith("."))
    return sorted((file for file in files if not _COMPANION.search(file.stem)), key=numeric_order)


def read_image(file: Path) -> np.ndarray | None:
    """Return the image as (h, w, 3) uint8 RGB, whatever its depth and channels; None where it cannot be read."""
    return _rgb(read_decoded(file, cv2.IMREAD_COLOR))


def decoded_image(content: bytes) -> np.ndarray | None:
    """Return the image in a file's `content` as (h, w, 3) uint8 RGB; None where it holds none."""
    return _rgb(decoded(content, cv2.IMREAD_COLOR))


def read_depth16(file: Path) -> np.ndarray | None:
    """Return a depth image (h, w) uint16 as it is in the file, None where there is no file.

    Raises `InputError` for what is no image of one 16-bit channel: depth that was squeezed into 8 bit is not the same.
    """
    if not file.is_file():
        return None
    values = read_decoded(file)
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        raise InputError(f"reading {file}: expected a depth image of one 16-bit channel")
    return values


class ImageFolder(SourceDefaults):
    """A folder of images; the layouts of data sets build on it.

    The calibration is `camera.yaml` in the folder, else beside the images, where it is there; one that cannot be
    read is its `camera_fault`. Time stamps are frame number / 30 s. Raises `InputError` where no image can be read.
    """

    name = "images"
    quality: TruthQuality = "registered"

    def __init__(self, path: Path, files: list[Path] | None = None) -> None:
        self.path = path
        self.files = image_files(path) if files is None else files
        self.numbers = _numbers(self.files)
        self.count: int | None = len(self.files)
        self.notes = [f"time stamps: frame number / {FOLDER_RATE_HZ:g} s (the folder holds none)"]
        self.warnings: list[str] = []
        self.height, self.width = self._size()
        own = (folder / _OWN_CALIBRATION for folder in (path, self.files[0].parent))
        calibration_file = next((file for file in own if file.is_file()), None)
        if calibration_file is not None:
            with self._making_camera():
                self._use_calibration(stated_calibration(calibration_file, (self.width, self.height)))

    @staticmethod
    def recognises(path: Path) -> bool:
        """Whether `path` is a folder with images."""
        return path.is_dir() and bool(image_files(path))

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames; an unreadable file is left out with a warning, another size is an `InputError`."""
        for number, file in list(zip(self.numbers, self.files, strict=True))[selection]:
            rgb = read_image(file)
            if rgb is None:
                self._warn(f"{file} cannot be read and was left out")
                continue
            height, width = rgb.shape[:2]
            if (width, height) != (self.width, self.height):
                raise InputError(
                    f"reading {file}: it is {width}x{height} px, those before it {self.width}x{self.height} px; "
                    "a sequence needs frames of one size"
                )
            yield SourceFrame(number, self._time_s(number), rgb, file.name)

    def stamps(self, selection: slice) -> list[tuple[int, float]]:
        """Return number and time stamp of the selected frames, of files that turn out unreadable, too."""
        return [(number, self._time_s(number)) for number in self.numbers[selection]]

    def pose(self, index: int) -> np.ndarray | None:
        """A plain folder knows no pose."""
        return None

    def truth(self, index: int) -> SourceTruth | None:
        """Return pose and depth, each where it is known; None where neither is. A plain folder knows none."""
        pose, depth_mm = self.pose(index), self._depth_mm(index)
        return None if pose is None and depth_mm is None else SourceTruth(pose, depth_mm, self.quality)

    def _depth_mm(self, index: int) -> np.ndarray | None:
        """What a data set knows of the depth of a frame, as in `SourceTruth`."""
        return None

    def _time_s(self, number: int) -> float:
        """When a frame was taken, s."""
        return number / FOLDER_RATE_HZ

    def _size(self) -> tuple[int, int]:
        for file in self.files:
            image = read_image(file)
            if image is not None:
                return image.shape[0], image.shape[1]
        found = f"none of the {len(self.files)} images can be read" if self.files else "there is no image"
        raise InputError(f"reading {self.path}: {found} (looked for {', '.join(SUFFIXES)})")

    @contextmanager
    def _making_camera(self) -> Iterator[None]:
        """Keep what is wrong with the data set's camera in `camera_fault`: another one may have been given."""
        try:
            yield
        except (CalibrationError, InputError) as fault:
            self.camera_fault = fault

    def _warn(self, message: str) -> None:
        if message not in self.warnings:
            self.warnings.append(message)


def _rgb(image: np.ndarray | None) -> np.ndarray | None:
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _numbers(files: list[Path]) -> list[int]:
    """Return the files' own numbers where they have them and these increase, else their positions."""
    numbers = [frame_number(file) for file in files]
    known = [number for number in numbers if number is not None]
    increase = len(known) == len(files) and all(a < b for a, b in pairwise(known))
    return known if increase else list(range(len(files)))
