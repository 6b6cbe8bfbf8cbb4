"""The depth of a result's frames: written as 16-bit PNG with standard deviations, and read back."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.engine.errors import InputError, reporting
from scopemap.engine.frame import Frame
from scopemap.input.decoding import read_decoded, write_encoded

DEPTH_SCALE_MM = 0.01
"""The finest unit of depth/*.png; the largest depth is then 655 mm."""

_LARGEST_UNIT = 65534
_PREVIEW_SHARES = (0.01, 0.99)  # of all known depth, at the ends of the colours
# Standard deviations in 8 bits: shares of depth from 0.1 % to 180 % in steps of 3 %; 0 = unknown.
_LEAST_SIGMA = 0.001
_SIGMA_STEP = 1.03


class DepthWriter:
    """Writes the depth of each frame as 16-bit PNG, 0 = unknown, named by the frame's number.

    Beside it the standard deviation of frames that have one, as 8-bit PNG: 0.001 * 1.03^(v - 1) of the depth.

    largest_mm : depth that must be representable; it makes the unit coarser than `DEPTH_SCALE_MM` where necessary.
    Raises `InputError` where nothing can be written.
    """

    def __init__(self, folder: Path, largest_mm: float = 0.0) -> None:
        self._folder, self._sigma_folder = (Path(folder) / name for name in ("depth", "depth_sigma"))
        self._scale_mm = _unit_for(largest_mm)
        self._histogram = np.zeros(_LARGEST_UNIT + 2, np.int64)  # of every 16th pixel, by unit
        self._describe({})

    def __call__(self, frame: Frame) -> None:
        """Write the depth of a frame, and its standard deviation where it has one."""
        depth_mm = np.asarray(frame.depth_mm)
        units = depth_mm / self._scale_mm
        image = np.where(units < _LARGEST_UNIT + 1, np.round(units), 0).astype(np.uint16)
        write_picture(self._folder / f"{frame.index:06d}.png", image)
        self._histogram += np.bincount(image[::4, ::4].ravel(), minlength=len(self._histogram))
        if frame.depth_sigma_mm is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                code = 1 + np.log(frame.depth_sigma_mm / depth_mm / _LEAST_SIGMA) / np.log(_SIGMA_STEP)
            levels = np.where(np.isnan(code), 0, np.clip(np.round(code), 1, 255)).astype(np.uint8)
            with reporting(f"cannot write to {self._sigma_folder}"):
                self._sigma_folder.mkdir(exist_ok=True)
            write_picture(self._sigma_folder / f"{frame.index:06d}.png", levels)

    def finish(self, *, scale_known: bool) -> tuple[float, float] | None:
        """Return the nearest and the farthest depth, mm, but for 1 % at each end; None where no depth is known.

        depth.json then states them, and whether the millimetres are known or a guess.
        """
        seen = np.cumsum(self._histogram[1:])
        near, far = (1 + int(np.searchsorted(seen, share * seen[-1])) for share in _PREVIEW_SHARES)
        near_mm, far_mm = (round(unit * self._scale_mm, 4) for unit in (near, max(far, near + 1)))
        self._describe({"scale_known": scale_known} | ({"preview_mm": [near_mm, far_mm]} if seen[-1] else {}))
        return (near_mm, far_mm) if seen[-1] else None

    def _describe(self, facts: dict[str, Any]) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            description = json.dumps({"scale_mm": self._scale_mm, "unknown": 0} | facts) + "\n"
            (self._folder / "depth.json").write_text(description, encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write depth to {self._folder}: {error.strerror or error}") from None


def write_picture(file: Path, image: np.ndarray) -> None:
    """Write an image (BGR, or of one channel); raises `InputError` where that fails."""
    try:
        write_encoded(file, image)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror or error}") from None


class DepthReader:
    """Reads back the depth of a run's folder; raises `InputError` where depth/depth.json cannot be read."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._sigma_folder = (Path(folder) / name for name in ("depth", "depth_sigma"))
        description = self._folder / "depth.json"
        self.present = description.is_file()
        """Whether the run kept its depth."""
        try:
            self.scale_mm = float(json.loads(description.read_text())["scale_mm"]) if self.present else 0.0
            """Millimetres per unit of the files; 0 where there are none."""
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"cannot read {description}: {error}") from None

    def has(self, index: int) -> bool:
        """Return whether the frame with this number has a depth map."""
        return (self._folder / f"{index:06d}.png").is_file()

    def read(self, index: int) -> np.ndarray | None:
        """Return depth (H, W) float32, mm, NaN = unknown, of the frame with this number; None where none was kept."""
        image = read_decoded(self._folder / f"{index:06d}.png") if self.present else None
        if image is None:
            return None
        return np.where(image > 0, image * np.float32(self.scale_mm), np.float32(np.nan))

    def read_sigma(self, index: int) -> np.ndarray | None:
        """Return the standard deviation of `read`, to 1.5 %, in the same form; None where none was kept for it."""
        depth_mm, levels = self.read(index), read_decoded(self._sigma_folder / f"{index:06d}.png")
        if depth_mm is None or levels is None or levels.shape != depth_mm.shape:
            return None
        shares = np.asarray(_LEAST_SIGMA * _SIGMA_STEP ** (np.arange(256, dtype=np.float32) - 1), np.float32)
        shares[0] = np.nan
        return np.asarray(shares[levels] * depth_mm, np.float32)


def _unit_for(largest_mm: float) -> float:
    """Return the smallest of 0.01, 0.02, 0.05, 0.1, ... mm with which the largest depth is representable."""
    least = max(largest_mm / _LARGEST_UNIT, DEPTH_SCALE_MM) * (1 - 1e-6)
    power = 10.0 ** math.floor(math.log10(least))
    return next(round(digit * power, 12) for digit in (1, 2, 5, 10) if digit * power >= least)
