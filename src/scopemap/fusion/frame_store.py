"""Frames that wait to be fused, kept in a temporary file (4 bytes a pixel): long videos must not fill the memory."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Iterator
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import InputError
from scopemap.frame import Frame

# ln of millimetres in 16 bits: 0.0001 mm (uncertainties are small) to 34 m in steps of 0.03 %; 0 = unknown.
_LOG_STEP, _LEAST_MM = 3e-4, 1e-4
_MOST_CODE = 65535
# Colours only paint the mesh: JPEG takes a fifth of the time and half of the room of what loses nothing.
_COLOUR_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


class _Entry(NamedTuple):
    """What of a frame is small, and how many bytes each of its images takes in the file."""

    number: int
    time_s: float
    camera: PinholeCamera
    T_world_camera: np.ndarray | None
    sizes: list[int]
    median_mm: float


class FrameSpool:
    """Keeps frames with depth and pose in order; what fusion does not need of them is not kept."""

    def __init__(self) -> None:
        # It lives as long as the spool: closed, and so gone, with it.
        self._file = tempfile.TemporaryFile(prefix="scopemap")  # noqa: SIM115
        self._entries: list[_Entry] = []

    def __len__(self) -> int:
        """Return how many frames wait."""
        return len(self._entries)

    def typical_mm(self, among: Collection[int] | None = None) -> float | None:
        """Return the median of the frames' median depths, mm; None where no depth is known.

        among : numbers of the frames that count; None: all.
        """
        some = [entry.median_mm for entry in self._entries if among is None or entry.number in among]
        medians_mm = [median_mm for median_mm in some if np.isfinite(median_mm)]
        return float(np.median(medians_mm)) if medians_mm else None

    def put(self, frame: Frame) -> None:
        """Keep a frame. Raises `InputError` where the temporary folder is full."""
        assert frame.depth_mm is not None
        parts = [
            cv2.imencode(".jpg", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), _COLOUR_QUALITY)[1].tobytes(),
            np.packbits(frame.valid).tobytes(),
            *(_packed(mm).tobytes() for mm in (frame.depth_mm, frame.depth_sigma_mm) if mm is not None),
        ]
        try:
            self._file.write(b"".join(parts))
            self._file.flush()
        except OSError as error:
            raise InputError(
                f"cannot keep frames to be fused in {tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR "
                "to a folder with room, or mapping.method=none and fusion.voxel_mm: then nothing waits"
            ) from None
        sizes = [len(part) for part in parts]
        self._entries.append(
            _Entry(frame.index, frame.time_s, frame.camera, frame.T_world_camera, sizes, _median_mm(frame))
        )

    def frames(self) -> Iterator[Frame]:
        """Yield the frames in the order they came; depths are exact to 0.015 %, colours to a few levels."""
        self._file.seek(0)
        for entry in self._entries:
            shape = (entry.camera.height, entry.camera.width)
            colours, valid, depth, *sigma = (np.frombuffer(self._file.read(size), np.uint8) for size in entry.sizes)
            yield Frame(
                entry.number,
                entry.time_s,
                cv2.cvtColor(np.asarray(cv2.imdecode(colours, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB),
                entry.camera,
                np.unpackbits(valid, count=shape[0] * shape[1]).reshape(shape).astype(bool),
                _unpacked(depth, shape),
                entry.T_world_camera,
                depth_sigma_mm=_unpacked(sigma[0], shape) if sigma else None,
            )


def _median_mm(frame: Frame) -> float:
    """Median of the known depth in a frame's usable pixels, mm; NaN where there is none."""
    assert frame.depth_mm is not None
    some_mm = frame.depth_mm[::4, ::4][frame.valid[::4, ::4]]
    some_mm = some_mm[np.isfinite(some_mm)]
    return float(np.median(some_mm)) if some_mm.size else float("nan")


def _packed(mm: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        code = np.float32(1.5 - np.log(_LEAST_MM) / _LOG_STEP) + np.log(mm) * np.float32(1 / _LOG_STEP)
    # What lies beyond is unknown, not at the end.
    return np.where(np.isfinite(code) & (code < _MOST_CODE + 1), np.maximum(code, 1), 0).astype(np.uint16)


def _unpacked(code: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return _millimetres()[code.view(np.uint16).reshape(shape)]


@cache
def _millimetres() -> np.ndarray:
    """Return the depth that each code stands for, (65536,) float32."""
    mm = _LEAST_MM * np.exp((np.arange(_MOST_CODE + 1) - 1) * _LOG_STEP)
    mm[0] = np.nan
    return mm.astype(np.float32)
