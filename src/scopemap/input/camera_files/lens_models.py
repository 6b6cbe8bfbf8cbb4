"""The table of lens models: what camera files call each, the terms that it has, and the camera that these make.

All that reading (`lens.py`, `coefficients.py`, `arranging.py`) and writing (`writing.py`) ask of a lens is in its row.
Scaramuzza's lens has none: it has a polynomial in place of coefficients (`scaramuzza.py`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OpenCvCamera

# Words come in lower case with blanks between them. These are other lenses even where all coefficients are zero,
OTHER_PROJECTION = re.compile(
    r"\bomni|\bds\b|double ?sphere|\beucm\b|\bucm\b|unified|\bc?mei\b|scaramuzza|ocam|catadioptric|equirect|panoram|"
    r"spherical|stereographic|equisolid|orthographic|cylind|f ?theta|taylor|cahvor|fisheye ?62|mirror"
)
# and these where one is not.
OTHER_DISTORTION = re.compile(r"thin ?prism|division|inverse|modified|tilt")
_WITH_THIN_PRISM = (12, 14)  # how many coefficients OpenCV has with s1 s2 s3 s4, and with the two of a tilt


@dataclass(frozen=True)
class LensModel:
    """A row: a lens whose terms are a list of coefficients.

    name : in our files. title : in sentences. called : matches words that mean it. terms : names of its coefficients
    in their order, k1 k2 ... for radial ones, p1 p2 for tangential ones. lengths : how many of these a list may have,
    ascending. own_names : names that files give to all terms where these are neither radial nor tangential. from_two :
    radial terms may count from 2. needs : what a term is only with one of these others beside it; else it is that of
    another lens.

    camera : the class, whose `plane` takes the distorted plane to pixels. make : returns the camera of a plane and
    coefficients, as many as a file has; raises `ValueError` where their number is wrong. coefficients : returns those
    of a camera.
    """

    name: str
    title: str
    called: re.Pattern[str]
    terms: tuple[str, ...]
    lengths: tuple[int, ...]
    camera: type[Any]
    make: Callable[[PinholeCamera, tuple[float, ...]], CameraModel]
    coefficients: Callable[[Any], tuple[float, ...]]
    own_names: tuple[tuple[str, ...], ...] = ()
    from_two: bool = False
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def in_order(self, named: Mapping[str, float]) -> list[float]:
        """Return terms by name as the shortest list that has all that are not 0."""
        values = [named.get(name, 0.0) for name in self.terms]
        return values[: next(length for length in self.lengths if not any(values[length:]))]


def _opencv(pinhole: PinholeCamera, coefficients: tuple[float, ...]) -> CameraModel:
    if not any(coefficients):
        return pinhole
    if len(coefficients) in _WITH_THIN_PRISM:
        if any(coefficients[8:]):
            raise ValueError("the thin-prism and tilt coefficients s1 ... have no counterpart: calibrate without them")
        coefficients = coefficients[:8]
    return OpenCvCamera(pinhole, coefficients)


def _fisheye(pinhole: PinholeCamera, coefficients: tuple[float, ...]) -> CameraModel:
    return FisheyeCamera(pinhole, _of_count(coefficients, 4, "Kannala-Brandt"))


def _fov(pinhole: PinholeCamera, coefficients: tuple[float, ...]) -> CameraModel:
    (omega,) = _of_count(coefficients, 1, "Devernay-Faugeras")
    return FovCamera(pinhole, omega) if omega else pinhole


def _of_count(coefficients: tuple[float, ...], count: int, title: str) -> tuple[float, ...]:
    """Return `count` coefficients, where only zeros are missing or too many."""
    if any(coefficients[count:]):
        raise ValueError(f"the {title} lens has {count} coefficient{'s'[: count > 1]}, found {len(coefficients)}")
    return (*coefficients[:count], *[0.0] * (count - len(coefficients)))


OPENCV = LensModel(
    "opencv",
    "OpenCV",
    re.compile(
        r"opencv|pin ?hole|perspective|plumb ?bob|rad ?tan|radial|tangential|brown|rational|standard|rectified|"
        r"undistorted|\bnone\b"
    ),
    ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    (4, 5, 8),
    OpenCvCamera,
    _opencv,
    lambda camera: camera.distortion,
    needs={"k4": ("k5", "k6")},  # k4 to k6 divide
)
# The first row that words name is the lens.
LENS_MODELS = (
    LensModel(
        "fisheye",
        "Kannala-Brandt",
        re.compile(r"fisheye|fish eye|\bequi(distant)?\b|kannala|\bkb[48]?\b"),
        ("k1", "k2", "k3", "k4"),
        (4,),
        FisheyeCamera,
        _fisheye,
        lambda camera: camera.distortion,
        from_two=True,  # camodocal: by the power of the angle before
    ),
    LensModel(
        "fov",
        "Devernay-Faugeras",
        re.compile(r"\bfov\b|\batan\b"),
        ("omega",),
        (1,),
        FovCamera,
        _fov,
        lambda camera: (camera.omega,),
        own_names=(("omega",), ("w",)),  # beside h, w is a width
    ),
    OPENCV,
)


def lens_called(words: str) -> LensModel | None:
    """Return the lens that words name, None where they name none: no words, or those for an endoscope."""
    return next((lens for lens in LENS_MODELS if lens.called.search(words)), None)
