"""Frames that wait to be fused, packed into a temporary file: an hour of video must not fill the memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.camera import PinholeCamera
from scopemap.errors import InputError
from scopemap.frame import Frame

# ln of millimetres in 16 bits: 0.0001 mm (uncertainties are small) to 34 m in steps of 0.03 %; 0 = unknown.
_LOG_STEP, _LEAST_MM = 3e-4, 1e-4
_MOST_CODE = 65535


class _Entry(NamedTuple):
    """What of a frame is small, and how many bytes each of its images takes in the file."""

    number: int
    time_s: float
    camera: PinholeCamera
    T_world_camera: np.ndarray | None
    sizes: list[int]


class FrameSpool:
    """Keeps frames with depth and pose in order; what fusion does not need of them is not kept."""

    def __init__(self) -> None:
        # It lives as long as the spool: closed, and so gone, with it.
        self._file = tempfile.TemporaryFile(prefix="scopemap")  # noqa: SIM115
        self._entries: list[_Entry] = []

    def __len__(self) -> int:
        """Return how many frames wait."""
        return len(self._entries)

    def put(self, frame: Frame) -> None:
        """Keep a frame. Raises `InputError` where the temporary folder is full."""
        assert frame.depth_mm is not None
        images = [cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), np.where(frame.valid, np.uint8(255), np.uint8(0))]
        images += [_packed(mm) for mm in (frame.depth_mm, frame.depth_sigma_mm) if mm is not None]
        codes = [cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes() for image in images]
        try:
            self._file.write(b"".join(codes))
        except OSError as error:
            raise InputError(
                f"cannot keep frames to be fused in {tempfile.gettempdir()}: {error.strerror or error}"
            ) from None
        sizes = [len(code) for code in codes]
        self._entries.append(_Entry(frame.index, frame.time_s, frame.camera, frame.T_world_camera, sizes))

    def frames(self) -> Iterator[Frame]:
        """Yield the frames in the order they came; depths are exact to 0.015 %."""
        self._file.seek(0)
        for entry in self._entries:
            bgr, valid, depth, *sigma = (self._image(size) for size in entry.sizes)
            yield Frame(
                entry.number,
                entry.time_s,
                cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB),
                entry.camera,
                valid > 0,
                _unpacked(depth),
                entry.T_world_camera,
                depth_sigma_mm=_unpacked(sigma[0]) if sigma else None,
            )

    def _image(self, size: int) -> np.ndarray:
        return np.asarray(cv2.imdecode(np.frombuffer(self._file.read(size), np.uint8), cv2.IMREAD_UNCHANGED))


def _packed(mm: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        code = 1 + np.log(mm / _LEAST_MM) / _LOG_STEP
    return np.where(np.isfinite(code), np.clip(np.rint(code), 1, _MOST_CODE), 0).astype(np.uint16)


def _unpacked(code: np.ndarray) -> np.ndarray:
    mm = _LEAST_MM * np.exp((code.astype(np.float32) - 1) * np.float32(_LOG_STEP))
    return np.where(code > 0, mm, np.float32(np.nan))
