"""What a calibration file says, before it is fitted to the images: a camera, and how far its size is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from scopemap.cameras.camera import CameraModel, PinholeCamera

Size: TypeAlias = tuple[int, int]
SizeOrigin: TypeAlias = Literal["stated", "images", "relative"]

LARGEST_SIDE_PX = 100_000
MOST_TERMS = 20
_LONGEST_RELATIVE_FOCAL = 10.0
# A skew is passed over up to the first share of the focal length, with a note up to the second.
_SLIGHT_SKEW, _MOST_SKEW = 1e-3, 1e-2


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says.

    Attributes
    ----------
    camera : camera model.
    depth_scale_mm : mm per unit of the depth files beside it, or None where the file does not say.
    source : how the camera is known, one phrase.
    size_origin : where the size of `camera` is from. stated: the file. images: the file has none, and that of the
        images was taken. relative: so, and the file's numbers are shares of it.
    file : where it stands, None where in no file.
    """

    camera: CameraModel
    depth_scale_mm: float | None
    source: str
    size_origin: SizeOrigin = "stated"
    file: Path | None = None

    @property
    def name(self) -> str:
        """What errors call it."""
        return f"the calibration {self.file}" if self.file else f"the {self.source}"


def pinhole_of(intrinsics: Sequence[float], stated: Size | None, image_size: Size) -> tuple[PinholeCamera, SizeOrigin]:
    """Return the pinhole camera of fx fy cx cy, and where its size is from.

    The size is `stated`, else that of the images. Numbers with cx and cy up to 1 and focal lengths below 10 are shares
    of width and height.
    """
    fx, fy, cx, cy = intrinsics
    width, height = stated or image_size
    if max(cx, cy) <= 1 and max(abs(fx), abs(fy)) < _LONGEST_RELATIVE_FOCAL:
        camera = PinholeCamera(fx * width, fy * height, cx * width, cy * height, width, height)
        return camera, "stated" if stated else "relative"
    return PinholeCamera(fx, fy, cx, cy, width, height), "stated" if stated else "images"


def intrinsics_of(K: np.ndarray) -> tuple[tuple[float, float, float, float], str]:
    """Return fx fy cx cy of a camera matrix (3, 3), and a note on what was done; `ValueError` where it is none.

    The transposed matrix, as MATLAB and Open3D write it, is turned. A skew of up to a hundredth of the focal length is
    passed over.
    """
    note = ""
    if _is_camera_matrix(K.T) and not _is_camera_matrix(K):
        K, note = K.T, ", its matrix transposed"
    if not _is_camera_matrix(K):
        raise ValueError(f"its matrix is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1], found {_rows(K)}")
    (fx, skew, cx), (_, fy, cy) = K[:2].tolist()
    if abs(skew) > _MOST_SKEW * abs(fx):
        raise ValueError(f"its camera matrix has a skew of {skew:g}, which no camera here has")
    if abs(skew) > _SLIGHT_SKEW * abs(fx):
        note += f", its skew of {skew:g} px left out"
    return (fx, fy, cx, cy), note


def _is_camera_matrix(K: np.ndarray) -> bool:
    return np.allclose([K[1, 0], *K[2]], [0, 0, 0, 1])


def _rows(K: np.ndarray) -> str:
    return "; ".join(" ".join(f"{value:g}" for value in row) for row in K)
