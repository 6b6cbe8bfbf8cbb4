"""What a calibration file says, before it is fitted to the images: a camera, and how far its size is known."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from scopemap.camera import CameraModel, PinholeCamera
from scopemap.lenses import FisheyeCamera, FovCamera, OpenCvCamera

Size: TypeAlias = tuple[int, int]
SizeOrigin: TypeAlias = Literal["stated", "images", "relative"]

LARGEST_SIDE_PX = 100_000
MOST_TERMS = 20
_LONGEST_RELATIVE_FOCAL = 10.0
_MOST_SKEW = 1e-3
_FISHEYE = re.compile(r"fisheye|\bequi(distant)?\b|kannala|kb4")
_FOV = re.compile(r"\bfov\b")
# Every other word for what a lens is refused by name where it has coefficients.
_RADIAL_TANGENTIAL = re.compile(
    r"opencv|pinhole|perspective|plumb_?bob|radtan|radial-tangential|brown(-?conrady)?|rational(_polynomial)?"
)


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


def intrinsics_of(K: np.ndarray) -> tuple[float, float, float, float]:
    """Return fx fy cx cy of a camera matrix (3, 3); `ValueError` where it is none, or is skewed.

    A skew of up to a thousandth of the focal length, as calibrations leave it, is passed over.
    """
    (fx, skew, cx), (zero, fy, cy) = K[:2].tolist()
    if not np.allclose([zero, *K[2]], [0, 0, 0, 1]):
        raise ValueError(f"its matrix is no camera matrix [fx 0 cx; 0 fy cy; 0 0 1], found {_rows(K)}")
    if abs(skew) > _MOST_SKEW * abs(fx):
        raise ValueError(f"its camera matrix has a skew of {skew:g}, which no camera here has")
    return fx, fy, cx, cy


def with_lens(pinhole: PinholeCamera, model: str, coefficients: Sequence[float]) -> CameraModel:
    """Return the camera with the lens that `model` names, in anyone's words, "" where nothing is said: OpenCV's.

    Raises `ValueError` for a model that has no counterpart here, and for coefficients that are not its.
    """
    if len(coefficients) > MOST_TERMS:
        raise ValueError(f"it has {len(coefficients)} distortion coefficients, more than any lens")
    words, lens = model.lower().strip(), tuple(float(k) for k in coefficients)
    if _FISHEYE.search(words):
        return FisheyeCamera(pinhole, lens)
    if _FOV.search(words):
        if len(lens) != 1:
            raise ValueError(f"a lens of the model fov has one coefficient, found {len(lens)}")
        return FovCamera(pinhole, lens[0]) if lens[0] else pinhole
    if not any(lens):
        return pinhole
    unknown = [word for word in words.split() if not _RADIAL_TANGENTIAL.fullmatch(word)]
    if unknown:
        raise ValueError(
            f"the lens model {' '.join(unknown)[:40]!r} has no counterpart here: calibrate as pinhole with "
            "radial-tangential or equidistant (fisheye) coefficients"
        )
    if len(lens) in (12, 14) and any(lens[8:]):
        raise ValueError("the thin-prism and tilt coefficients s1 ... have no counterpart here: calibrate without them")
    return OpenCvCamera(pinhole, lens[:8] if len(lens) in (12, 14) else lens)


def _rows(K: np.ndarray) -> str:
    return "; ".join(" ".join(f"{value:g}" for value in row) for row in K)
