"""Depth from files: one disparity or depth image per frame.

8-bit images are disparity unless `depth.files_kind` is set (0 = farthest, not unknown). 16-bit images and floats are
taken as measured depth, unless the first frames tell that they are inverse depth (`depth_kind`). The files show the
source's view, distorted as the frames are, at any size; a depth folder written by scopemap itself (`depth.json` in it)
is in the geometry of the rectified frames.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.estimate import DepthEstimate, DepthKind
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.input.decoding import frame_number, frames_later
from scopemap.input.depth_reading import NUMPY, read_depth_file
from scopemap.input.image_names import by_frame

_IMAGES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
_OTHER_ARRAYS = (".npz", ".exr", ".pfm", ".mat", ".h5", ".hdf5", ".pt", ".pth", ".pkl")  # that networks write depth to
_NAMED_DEPTH = re.compile(r"(^|[._-])(depth|disp|disparity)([._-]|$)", re.IGNORECASE)
_COLOUR = re.compile(r"[._-](color|colour|rgb)$", re.IGNORECASE)
_OTHER_CONTENT = re.compile(r"[._-](color|colour|rgb|normals?|flow|occlusion|masks?)$", re.IGNORECASE)
_SEPARATORS = "._-"
_ASPECT_TOLERANCE = 0.02
_LOOKED_AT = 5  # files whose median tells the unit; by hand: a first frame at the wall is one of them
# C3VD writes 0..100 mm over the whole range of its `NNNN_depth.tiff` (DATASETS: u16, 65535 = clipped).
_C3VD_RANGE_MM = 100.0
_C3VD_NAMES = ("_depth.tiff", "_depth.tif")


@dataclass(frozen=True)
class _Scale:
    """Millimetres per unit of depth, the source of that number, and whether it is more than a guess."""

    mm: float
    source: str
    is_known: bool = True


@dataclass(frozen=True)
class FilesOfInput:
    """What an input knows of depth files.

    scale_mm : mm per unit by its calibration, or None. pictures : its pictures by frame number, none of a video.
    numbers : of all its frames, ascending; none where they are unknown.
    """

    scale_mm: float | None = None
    pictures: Mapping[int, Path] = field(default_factory=dict)
    numbers: Sequence[int] = ()


class FilesDepth:
    """Depth estimator that reads depth or disparity from files.

    folder : holds one file per frame; `*_depth.*` and `*.depth.*` are preferred where the folder has other images.
    rectifier : from the source camera to the working camera.
    of_input : what the input knows of them.
    kind : of the values. kind_is_stated : whether a setting, or a file beside them, says so. kind_reason : why they are
    of this kind where it is implied; "": a guess. later : by how many frames a file belongs to another frame than its
    number says: 1 or -1 where they are numbered from 1 and the frames from 0, or the other way round.

    Raises `InputError` where the folder does not exist, holds no usable file, or two files for one frame.
    """

    name = "files"

    def __init__(
        self, folder: Path, rectifier: Rectifier, settings: DepthSettings, of_input: FilesOfInput | None = None
    ) -> None:
        of_input = of_input or FilesOfInput()
        self._folder, self._rectifier = Path(folder), rectifier
        self._files = depth_files(self._folder, of_input.pictures)
        self._is_rectified = (self._folder / "depth.json").exists()
        # The files of a run have its frames' numbers.
        self.later = 0 if self._is_rectified else frames_later(list(self._files), of_input.numbers)
        self._files = {number + self.later: file for number, file in self._files.items()}
        first = read_depth_file(next(iter(self._files.values())))
        self._only_type = first.dtype if settings.files_kind == "auto" else None
        stated = _scale_in(self._folder)
        self.kind_is_stated = settings.files_kind != "auto" or stated is not None
        self.kind, self.kind_reason = self._kind_of(first, settings)
        self._scale = self._found_scale(first, settings, stated, of_input.scale_mm)
        self._largest = _largest(first)

    @property
    def folder(self) -> Path:
        """Where the files are."""
        return self._folder

    @property
    def is_in_mm(self) -> bool:
        """Whether they are meant to be mm by their scale; a run of unknown scale writes depth in a unit of its own."""
        return not self._is_rectified or self._scale.is_known

    @property
    def scale(self) -> tuple[float, str]:
        """Millimetres per unit of depth, and where that number comes from."""
        return self._scale.mm, self._scale.source

    @property
    def measured_max_mm(self) -> float | None:
        """Farthest depth that measured files can hold, of floats twice the first file's; None: predicted."""
        return self._largest * self._scale.mm if self.kind == "measured" else None

    def of_kind(self, kind: DepthKind) -> FilesDepth:
        """Return the same files, read as another kind."""
        other = copy.copy(self)
        other.kind, other.kind_is_stated = kind, True
        return other

    def numbers(self, frame: Frame) -> np.ndarray | None:
        """Return what the file of `frame` holds, rectified, (H, W) float32, 0 and NaN = unknown; None: cannot be read.

        The numbers are those of the file, whatever its kind.
        """
        try:
            array = read_depth_file(self._files[frame.index])
            self._check(array, self._files[frame.index])
        except (KeyError, InputError):
            return None
        values = _depth(array, 1.0)
        return self._resized(values) if self._is_rectified else self._rectifier.nearest(values)

    def samples(self) -> list[np.ndarray]:
        """Return what a few files from all parts hold, (h, w) each, of those that can be read."""
        files, found = list(self._files.values()), list[np.ndarray]()
        for file in files[:: max(1, len(files) // _LOOKED_AT)]:
            with suppress(InputError):
                found.append(read_depth_file(file))
        return found

    def median(self) -> float:
        """Return the median of all positive values in a few files, in their unit; NaN where none can be read."""
        known = [values[np.isfinite(values)] for values in (_depth(array, 1.0) for array in self.samples())]
        return float(np.median([np.median(values) for values in known if values.size] or [np.nan]))

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return the depth or disparity of `frame` (found by `frame.index`), rectified, NaN = unknown.

        Disparity of an integer file is 0..1 of the full range. Raises `InputError` where the frame has no file, or its
        shape does not fit the images.
        """
        file = self._files.get(frame.index)
        if file is None:
            numbers = sorted(self._files)
            raise InputError(
                f"no depth file for frame {frame.index} in {self._folder} ({len(numbers)} files, numbers {numbers[0]} "
                f"to {numbers[-1]}): name each file as its picture, or by the frame's number"
            )
        array = read_depth_file(file)
        self._check(array, file)
        values = _disparity(array) if self.kind == "disparity" else _depth(array, self._scale.mm)
        return DepthEstimate(self._rectified(values), self.kind)

    @property
    def scale_is_known(self) -> bool:
        """False where the unit of the files is a guess, or that of a run of unknown scale."""
        return self._scale.is_known

    def provenance(self) -> dict[str, str]:
        """Return the folder, the kind of values and, for depth, mm per unit with the reason."""
        origin = {"depth": f"{len(self._files)} files in {self._folder}", "depth_kind": self.kind}
        if self.kind != "disparity":
            origin["depth_scale"] = f"{self._scale.mm:.6g} mm per unit ({self._scale.source})"
        return origin

    def _kind_of(self, array: np.ndarray, settings: DepthSettings) -> tuple[DepthKind, str]:
        """Return the kind by what is stated or implied, and why that implies it."""
        if settings.files_kind != "auto":
            return settings.files_kind, "depth.files_kind"
        if array.dtype == np.uint8:
            return "disparity", "they have 8 bits"
        first_name = next(iter(self._files.values())).name.lower()
        if array.dtype != np.uint16 and "disp" in first_name:
            return "disparity", 'their names contain "disp"'
        if settings.files_scale_mm is not None:
            return "measured", "depth.files_scale_mm states their unit"
        return "measured", "their names are those of C3VD's depth" if first_name.endswith(_C3VD_NAMES) else ""

    def _found_scale(
        self, array: np.ndarray, settings: DepthSettings, stated: _Scale | None, calibrated_mm: float | None
    ) -> _Scale:
        if settings.files_scale_mm is not None:
            return _Scale(settings.files_scale_mm, "depth.files_scale_mm")
        if stated is not None:
            return stated
        if np.issubdtype(array.dtype, np.floating):
            return _Scale(1.0, "floats are taken as mm")
        if calibrated_mm is not None:
            return _Scale(calibrated_mm, "depth_scale of the input's calibration")
        if next(iter(self._files.values())).name.lower().endswith(_C3VD_NAMES):
            return _Scale(_C3VD_RANGE_MM / np.iinfo(array.dtype).max, "C3VD's 0..100 mm")
        return _Scale(1.0, "assumed; set depth.files_scale_mm if it is not so", is_known=False)

    def _check(self, array: np.ndarray, file: Path) -> None:
        if self._only_type not in (None, array.dtype):
            raise InputError(
                f"the depth file {file} holds {array.dtype}, the first one {self._only_type}: set their kind by "
                "depth.files_kind (disparity, depth or measured)"
            )
        geometry = self._rectifier.target if self._is_rectified else self._rectifier.source
        height, width = array.shape
        if abs(width * geometry.height / (height * geometry.width) - 1) > _ASPECT_TOLERANCE:
            raise InputError(
                f"the depth file {file} is {width}x{height} px, the images are {geometry.width}x{geometry.height} px: "
                "another aspect, so not the same view; give depth for these images"
            )

    def _rectified(self, values: np.ndarray) -> np.ndarray:
        if self._is_rectified:
            return self._resized(values)
        return self._rectifier.smooth(values) if self.kind == "disparity" else self._rectifier.nearest(values)

    def _resized(self, values: np.ndarray) -> np.ndarray:
        size = (self._rectifier.target.width, self._rectifier.target.height)
        return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)


def depth_files(folder: Path, pictures: Mapping[int, Path] | None = None) -> dict[int, Path]:
    """Return the depth files of a folder by the number of their frame, in the order of the numbers.

    pictures : the input's pictures by frame number, None of a video. A depth file belongs to the picture whose name it
    has, with more before or after a separator (`0001_color.png`, `0001_color-dpt_512.png`), where half of the files or
    of the pictures match; else to the frame of the number in its name (`by_frame`). Where some names contain depth or
    disparity, the others are left out, as are names of other content (`*_color.*`, masks, normals), unless pictures
    are named so. Raises `InputError` where there is none, or two belong to one frame.
    """
    if not folder.is_dir():
        raise InputError(f"reading depth files: {folder} is no folder; give files:FOLDER with the folder of the files")
    candidates = [f for f in sorted(folder.iterdir()) if f.suffix.lower() in (*_IMAGES, NUMPY) and f.name[0] != "."]
    own = {picture.resolve() for picture in (pictures or {}).values()}
    others = [file for file in candidates if file.resolve() not in own]
    if pictures and (matched := _by_picture(others, pictures)):
        return matched
    with_number = [file for file in others if frame_number(file) is not None]
    numbered = [file for file in with_number if not _OTHER_CONTENT.search(file.stem)]
    named = [file for file in numbered if _NAMED_DEPTH.search(file.stem)]
    # A program that writes depth by the name of its picture keeps "color".
    numbered = numbered or [file for file in with_number if _COLOUR.search(file.stem)]
    if not numbered:
        raise InputError(
            f"reading depth files: {folder} holds no png, tif, jpg or npy file with a number in its name that could be "
            f"depth; the number is the frame's{_other_endings(folder)}"
        )
    return by_frame(named or numbered, pictures or {})


def _other_endings(folder: Path) -> str:
    """Return what to do with files of arrays in other formats, as the end of a sentence; "" where there are none."""
    endings = sorted({file.suffix.lower() for file in folder.iterdir()} & set(_OTHER_ARRAYS))
    return f"; save what its {' and '.join(endings)} files hold as one npy file per frame" if endings else ""


def _by_picture(files: list[Path], pictures: Mapping[int, Path]) -> dict[int, Path]:
    """Return the files whose names contain that of a picture, by its frame; {} where less than half of either do."""
    number_of = {picture.stem: number for number, picture in pictures.items()}
    if len(number_of) < len(pictures):
        return {}
    found: dict[int, list[Path]] = {}
    for file in files:
        if (stem := _picture_in(file.stem, number_of)) is not None:
            found.setdefault(number_of[stem], []).append(file)
    if 2 * len(found) < min(len(pictures), len(files)):
        return {}
    matched = {}
    for number, of_one in sorted(found.items()):
        chosen = [file for file in of_one if _NAMED_DEPTH.search(file.stem)] or of_one
        if len(chosen) > 1:
            first, second, *_ = chosen
            raise InputError(
                f"reading {first.parent}: {first.name} and {second.name} are both named as {pictures[number].name}; "
                "leave one depth file for each picture"
            )
        matched[number] = chosen[0]
    return matched


def _picture_in(stem: str, pictures: Mapping[str, int]) -> str | None:
    """Return the longest name of a picture that `stem` is, begins with or ends with; None for other content, too."""
    if stem in pictures:
        return stem
    at = [i for i, letter in enumerate(stem) if letter in _SEPARATORS]
    begins = [stem[:i] for i in reversed(at) if stem[:i] in pictures]
    ends = [stem[i + 1 :] for i in at if stem[i + 1 :] in pictures]
    return next(iter([] if _OTHER_CONTENT.search(stem) else [*begins, *ends]), None)


def _disparity(array: np.ndarray) -> np.ndarray:
    if np.issubdtype(array.dtype, np.floating):
        return np.where(np.isfinite(array) & (array >= 0), array, np.nan).astype(np.float32)
    return array.astype(np.float32) / np.float32(np.iinfo(array.dtype).max)


def _depth(array: np.ndarray, scale_mm: float) -> np.ndarray:
    known = np.isfinite(array) & (array > 0)
    if array.dtype == np.uint16:
        known &= array < np.iinfo(np.uint16).max
    return np.where(known, array * np.float32(scale_mm), np.nan).astype(np.float32)


def _largest(array: np.ndarray) -> float:
    if np.issubdtype(array.dtype, np.integer):
        return float(np.iinfo(array.dtype).max - (array.dtype == np.uint16))  # 65535 is unknown
    return 2.0 * float(np.max(array, initial=0.0, where=np.isfinite(array)))


def _scale_in(folder: Path) -> _Scale | None:
    """Return the scale that a `depth.json` or `camera.yaml` in the folder states."""
    written, calibration = folder / "depth.json", folder / "camera.yaml"
    if written.exists():
        try:
            stated = json.loads(written.read_text(encoding="utf-8"))
            return _Scale(float(stated["scale_mm"]), written.name, bool(stated.get("scale_known", True)))
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"cannot read scale_mm in {written}: {error!r}") from None
    if calibration.exists():
        try:
            text = calibration.read_text(encoding="utf-8")
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        except (cv2.error, SystemError, OSError, ValueError) as error:
            raise InputError(f"cannot read depth_scale in {calibration}: {error}") from None
        # A node is a view into its storage, which must outlive it.
        node = storage.getNode("depth_scale")
        if node.isReal() or node.isInt():
            return _Scale(node.real(), f"depth_scale in {calibration.name}")
    return None
