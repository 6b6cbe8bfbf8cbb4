"""Masks from files: pixels that show no tissue, such as instruments; one image per frame, or one for all frames."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Numbers
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scopemap.engine.cameras.rectification import Rectifier
from scopemap.engine.config import MaskSettings
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.masking.masker import disc
from scopemap.engine.notices import Notice
from scopemap.input.decoding import frame_number, frames_later, read_decoded
from scopemap.input.image_names import by_frame, decimal_numbers

if TYPE_CHECKING:
    from scopemap.input.sequence import Sequence

_LOSSLESS = (".png", ".tif", ".tiff", ".bmp")
_LOSSY = (".jpg", ".jpeg")
_HALF = 127
_GROW_PX = 3  # by hand: by which masks are widened
_LARGE = 0.75  # by hand: of a picture, on average; the border around a round field of view in 16:9 hides .6
_NO_MASKS = "none"


def masks_of(settings: MaskSettings, sequence: Sequence) -> MaskFiles | None:
    """Return the masks of a sequence's frames that the settings name; see `create_masks`."""
    source = sequence.source
    return create_masks(settings, sequence.rectifier, source.masks, sequence.numbers, source.picture_files())


def create_masks(
    settings: MaskSettings,
    rectifier: Rectifier,
    own: Path | None = None,
    numbers: Numbers[int] | None = None,
    pictures: Mapping[int, Path] | None = None,
) -> MaskFiles | None:
    """Return the masks that the settings name, where they name none the data set's own, None where there are none.

    own : folder of the data set's masks, or None. numbers, pictures : as `MaskFiles` has them. Raises as
    `MaskFiles` does, and `SettingsError` where the settings contradict each other or the input.
    """
    folder = None if settings.files == _NO_MASKS else Path(settings.files) if settings.files else own
    if settings.instruments == "off" and folder is not None and settings.files:
        raise SettingsError(f"mask.instruments=off contradicts mask.files={settings.files}: leave one of them out")
    if folder is None or settings.instruments == "off":
        return None
    return MaskFiles(folder, rectifier, _GROW_PX, numbers, pictures)


class MaskFiles:
    """Masks in a folder, found by the last whole number in their names, which is the frame's; or one for all frames.

    The one for all frames is the only image of its folder, and has no number in its name.

    folder : holds the images. rectifier : from the camera of the images to the working camera.
    grow_px : by which masks are widened, at the working size: outlines are drawn a little inside more often than not.
    numbers : of all frames of the input, ascending, or None. Masks that are numbered from 1 where the frames are from
    0, or the other way round, belong to the frame one before or after their number.
    pictures : of all frames by their numbers, None of a video. Masks whose names hold decimal numbers (mask_0.067)
    belong to the pictures with these numbers.

    Raises `InputError` where the folder does not exist, holds no such image, or two for one frame.
    """

    def __init__(
        self,
        folder: Path,
        rectifier: Rectifier,
        grow_px: int = 0,
        numbers: Numbers[int] | None = None,
        pictures: Mapping[int, Path] | None = None,
    ) -> None:
        self._folder, self._rectifier, self._grow_px = Path(folder), rectifier, grow_px
        self._files, self._single = _numbered(self._folder, pictures or {})
        self._numbers = range(0) if numbers is None else numbers
        self._by_name = bool(pictures) and decimal_numbers(list(self._files.values())) is not None
        self._later = frames_later(list(self._files), self._numbers)
        self._files = {number + self._later: file for number, file in self._files.items()}
        self._asked, self._hidden, self._read_masks, self._level = set[int](), 0.0, 0, 0

    def covered(self, index: int) -> np.ndarray | None:
        """Return which pixels of the working camera are masked in the frame `index`, (H, W) bool; None without a file.

        Masked are pixels other than 0, in a JPEG those above 127. Raises `InputError` for a file that is no image,
        `CalibrationError` for one of another aspect than the images.
        """
        if self._single is not None:
            return self._covered_always
        self._asked.add(index)
        file = self._files.get(index)
        return None if file is None else self._read(file)

    @cached_property
    def _covered_always(self) -> np.ndarray | None:
        return None if self._single is None else self._read(self._single)

    def _read(self, file: Path) -> np.ndarray:
        image = read_decoded(file)
        if image is None:
            raise InputError(f"cannot read the mask {file}: it is no image, or damaged")
        # The alpha channel is ignored.
        level = image if image.ndim == 2 else image[..., :3].max(-1)
        hidden = level > (_HALF if file.suffix.lower() in _LOSSY else 0)
        self._hidden, self._read_masks = self._hidden + float(hidden.mean()), self._read_masks + 1
        self._level = max(self._level, int(level.max()))
        masked = self._rectifier.nearest(hidden.astype(np.uint8))
        return cv2.dilate(masked, disc(self._grow_px)) > 0

    def provenance(self) -> dict[str, str]:
        """Return the folder, how many masks it holds, and how many of the frames have one."""
        if self._single is not None:
            return {"masks": f"{self._single}, for all frames"}
        found = f"{len(self._files)} files in {self._folder}"
        if self._asked:
            found += f"; {len(self._asked & set(self._files))} of {len(self._asked)} frames have one"
        return {"masks": found}

    @property
    def notices(self) -> list[Notice]:
        """What looks wrong: masks that are missing or have no frame, another number, or hide nothing or nearly all."""
        found, folder = list[Notice](), {"folder": str(self._folder)}
        missing = len(self._asked - set(self._files))
        if self._single is None and 2 * missing > len(self._asked):
            found.append(Notice("masks-missing", {"missing": missing, "frames": len(self._asked)} | folder))
        if self._later:
            found.append(Notice("masks-shifted", {"shift": self._later} | folder))
        if self._may_be_late:
            found.append(Notice("masks-late", {"frame": self._numbers[0], "mask": min(self._files)} | folder))
        if self._numbers and (left := sorted(set(self._files) - set(self._numbers) - self._asked)):
            found.append(Notice("masks-unused", {"masks": len(left), "first": self._files[left[0]].name} | folder))
        used = 1 if self._single is not None else len(self._asked & set(self._files))
        if used and not self._hidden:
            found.append(Notice("masks-faint" if self._level else "masks-empty", {"level": self._level} | folder))
        if self._read_masks and (share := self._hidden / self._read_masks) > _LARGE:
            found.append(Notice("masks-large", {"share": share} | folder))
        return found

    @property
    def _may_be_late(self) -> bool:
        """Whether masks begin at the second frame and lack none: they may be counted from another number."""
        own = sorted(self._files)
        gapless = len(own) > 1 and own[-1] - own[0] == len(own) - 1
        begins = bool(self._numbers) and self._numbers[0] in self._asked and own[:1] == [self._numbers[0] + 1]
        return not (self._later or self._by_name) and gapless and begins


def _numbered(folder: Path, pictures: Mapping[int, Path]) -> tuple[dict[int, Path], Path | None]:
    """Return the images by the number of their frame, and the only image where its name has no number."""
    if not folder.is_dir():
        raise InputError(f"reading masks: {folder} is no folder; mask.files names the folder of the images")
    files = (file for file in sorted(folder.iterdir()) if not file.name.startswith("."))
    images = [file for file in files if file.suffix.lower() in (*_LOSSLESS, *_LOSSY)]
    numbered = [file for file in images if frame_number(file) is not None]
    if numbered:
        return by_frame(numbered, pictures), None
    if len(images) == 1:
        return {}, images[0]
    raise InputError(
        f"reading masks: {folder} holds no image with a number in its name, which is the frame's, and not one image "
        "alone, for all frames"
    )
