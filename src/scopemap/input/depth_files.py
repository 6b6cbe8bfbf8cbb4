"""Depth from files: one disparity or depth image per frame, found by the number in its name.

8-bit images are disparity unless `depth.files_kind` is set (0 = farthest, not unknown); 16-bit images are
measured depth. The files show the source's view, distorted as the frames are, at any size; a depth folder written by
scopemap itself (`depth.json` in it) is in the geometry of the rectified frames.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import DepthSettings
from scopemap.engine.depth.estimate import DepthEstimate, DepthKind
from scopemap.engine.errors import InputError
from scopemap.engine.frame import Frame
from scopemap.input.decoding import by_number, frame_number, read_decoded

_IMAGES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
_NUMPY = ".npy"
_NAMED_DEPTH = re.compile(r"(^|[._-])(depth|disp|disparity)([._-]|$)", re.IGNORECASE)
_OTHER_CONTENT = re.compile(r"[._-](color|colour|rgb|normals?|flow|occlusion|masks?)$", re.IGNORECASE)
_ASPECT_TOLERANCE = 0.02
# C3VD writes 0..100 mm over the whole range of its `NNNN_depth.tiff` (DATASETS: u16, 65535 = clipped).
_C3VD_RANGE_MM = 100.0


@dataclass(frozen=True)
class _Scale:
    """Millimetres per unit of depth, the source of that number, and whether it is more than a guess."""

    mm: float
    source: str
    is_known: bool = True


class FilesDepth:
    """Depth estimator that reads depth or disparity from files.

    folder : holds one file per frame; `*_depth.*` and `*.depth.*` are preferred where the folder has other images.
    rectifier : from the source camera to the working camera.
    depth_scale_mm : mm per unit by the input's own calibration, or None.
    measured_max_mm : farthest depth that measured files can hold, of floats twice the first file's; None: predicted.

    Raises `InputError` where the folder does not exist, holds no usable file, or two files for one number.
    """

    name = "files"

    def __init__(
        self, folder: Path, rectifier: Rectifier, settings: DepthSettings, depth_scale_mm: float | None = None
    ) -> None:
        self._folder, self._rectifier = Path(folder), rectifier
        self._files = depth_files(self._folder)
        first = _read(next(iter(self._files.values())))
        self._kind = settings.files_kind if settings.files_kind != "auto" else self._kind_of(first)
        self._only_type = first.dtype if settings.files_kind == "auto" else None
        self._is_rectified = (self._folder / "depth.json").exists()
        self._scale = self._found_scale(first, settings, depth_scale_mm)
        self.measured_max_mm = _largest(first) * self._scale.mm if self._kind == "measured" else None

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
                f"to {numbers[-1]}): the number in a file's name must be the frame's"
            )
        array = _read(file)
        self._check(array, file)
        values = _disparity(array) if self._kind == "disparity" else _depth(array, self._scale.mm)
        return DepthEstimate(self._rectified(values), self._kind)

    @property
    def scale_is_known(self) -> bool:
        """False where the unit of the files is a guess, or that of a run of unknown scale."""
        return self._scale.is_known

    def provenance(self) -> dict[str, str]:
        """Return the folder, the kind of values and, for depth, mm per unit with the reason."""
        origin = {"depth": f"{len(self._files)} files in {self._folder}", "depth_kind": self._kind}
        if self._kind != "disparity":
            origin["depth_scale"] = f"{self._scale.mm:.6g} mm per unit ({self._scale.source})"
        return origin

    def _kind_of(self, array: np.ndarray) -> DepthKind:
        if array.dtype == np.uint8:
            return "disparity"
        first_name = next(iter(self._files.values())).name.lower()
        return "disparity" if array.dtype != np.uint16 and "disp" in first_name else "measured"

    def _found_scale(self, array: np.ndarray, settings: DepthSettings, calibrated_mm: float | None) -> _Scale:
        if settings.files_scale_mm is not None:
            return _Scale(settings.files_scale_mm, "depth.files_scale_mm")
        stated = _scale_in(self._folder)
        if stated is not None:
            return stated
        if np.issubdtype(array.dtype, np.floating):
            return _Scale(1.0, "floats are taken as mm")
        if calibrated_mm is not None:
            return _Scale(calibrated_mm, "depth_scale of the input's calibration")
        if next(iter(self._files.values())).name.lower().endswith(("_depth.tiff", "_depth.tif")):
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
            size = (self._rectifier.target.width, self._rectifier.target.height)
            return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)
        return self._rectifier.smooth(values) if self._kind == "disparity" else self._rectifier.nearest(values)


def depth_files(folder: Path) -> dict[int, Path]:
    """Return the depth files of a folder by the last whole number in their names, in the order of the numbers.

    Where some names contain depth or disparity, the others are left out, as are names of other content
    (`*_color.*`, masks, normals). Raises `InputError` where there is none, or two have the same number.
    """
    if not folder.is_dir():
        raise InputError(f"reading depth files: {folder} is no folder; give files:FOLDER with the folder of the files")
    candidates = [f for f in sorted(folder.iterdir()) if f.suffix.lower() in (*_IMAGES, _NUMPY) and f.name[0] != "."]
    numbered = [f for f in candidates if frame_number(f) is not None and not _OTHER_CONTENT.search(f.stem)]
    named = [f for f in numbered if _NAMED_DEPTH.search(f.stem)]
    if not numbered:
        raise InputError(
            f"reading depth files: {folder} holds no png, tif, jpg or npy file with a number in its name that could be "
            "depth; the number is the frame's"
        )
    return by_number(named or numbered)


def _read(file: Path) -> np.ndarray:
    """Return (h, w) uint8, uint16 or floating; raises `InputError` for other content."""
    try:
        is_array = file.suffix.lower() == _NUMPY
        array = np.load(file, mmap_mode="r", allow_pickle=False) if is_array else read_decoded(file)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"cannot read the depth file {file}: {error}") from None
    if array is None:
        raise InputError(f"cannot read the depth file {file}: not an image, or damaged")
    array = np.squeeze(array)
    if array.ndim == 3 and (array[..., :3] == array[..., :1]).all():
        array = array[..., 0]
    if array.ndim != 2 or not (array.dtype in (np.uint8, np.uint16) or np.issubdtype(array.dtype, np.floating)):
        raise InputError(
            f"the depth file {file} holds {array.dtype} of shape {array.shape}: expected one channel of 8 or 16 bit "
            "or floats; a colour-mapped depth picture cannot be converted to depth"
        )
    return array


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
