"""From anyone's words for a lens, and its coefficients, to a camera model."""

from __future__ import annotations

import re
from collections.abc import Sequence

from scopemap.cameras.camera import CameraModel, PinholeCamera
from scopemap.cameras.formats.stated import MOST_TERMS
from scopemap.cameras.lenses import FisheyeCamera, FovCamera, OpenCvCamera

# Words come in lower case with blanks between them. These are other lenses even where all coefficients are zero,
_OTHER_PROJECTION = re.compile(
    r"\bomni|\bds\b|double ?sphere|\beucm\b|\bucm\b|unified|\bmei\b|scaramuzza|ocam|catadioptric|equirect|panoram|"
    r"spherical|stereographic|equisolid|orthographic|cylind|f ?theta"
)
# and these where one is not.
_OTHER_DISTORTION = re.compile(r"thin ?prism|division|inverse|modified|tilt")
_FISHEYE = re.compile(r"fisheye|fish eye|\bequi(distant)?\b|kannala|\bkb[48]?\b")
_FOV = re.compile(r"\bfov\b")
_OPENCV = re.compile(
    r"opencv|pin ?hole|perspective|plumb ?bob|rad ?tan|radial|tangential|brown|rational|standard|rectified|"
    r"undistorted|\bnone\b"
)
_LONGEST_QUOTE = 40
_FISHEYE_TERMS = 4
_WITH_THIN_PRISM = (12, 14)


def is_fisheye(model: str) -> bool:
    """Whether the words name Kannala-Brandt's lens."""
    return bool(_FISHEYE.search(model))


def with_lens(pinhole: PinholeCamera, model: str, coefficients: Sequence[float]) -> tuple[CameraModel, str]:
    """Return the camera with the lens that the words `model` name, and a note on what was assumed, "" for nothing.

    No words, and words that are no lens' (the endoscope's name), stand for OpenCV's. Zeros at the end do not count.
    Raises `ValueError` for a model that has no counterpart here, and for coefficients that are not its.
    """
    if len(coefficients) > MOST_TERMS:
        raise ValueError(f"it has {len(coefficients)} distortion coefficients, more than any lens")
    lens = tuple(float(k) for k in coefficients)
    if _OTHER_PROJECTION.search(model) or (any(lens) and _OTHER_DISTORTION.search(model)):
        raise ValueError(
            f"the lens model {model[:_LONGEST_QUOTE]!r} has no counterpart here: calibrate as pinhole with "
            "radial-tangential or equidistant (fisheye) coefficients"
        )
    if is_fisheye(model):
        return FisheyeCamera(pinhole, _without_zeros(lens, _FISHEYE_TERMS)), ""
    if _FOV.search(model):
        lens = _without_zeros(lens, 1)
        if len(lens) != 1:
            raise ValueError(f"a lens of the model fov has one coefficient, found {len(lens)}")
        return FovCamera(pinhole, lens[0]) if lens[0] else pinhole, ""
    if not any(lens):
        return pinhole, ""
    if len(lens) in _WITH_THIN_PRISM and any(lens[8:]):
        raise ValueError("the thin-prism and tilt coefficients s1 ... have no counterpart here: calibrate without them")
    camera = OpenCvCamera(pinhole, lens[:8] if len(lens) in _WITH_THIN_PRISM else lens)
    if model and not _OPENCV.search(model):
        return camera, f", its lens taken as OpenCV's ({model[:_LONGEST_QUOTE]!r} names none)"
    return camera, ""


def _without_zeros(lens: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return `count` coefficients, as far as only zeros are missing or too many."""
    return (*lens[:count], *[0.0] * (count - len(lens))) if not any(lens[count:]) else lens
