"""The lens of a calibration file: its model's name, in any tool's words, and its distortion coefficients."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera, FovCamera, OpenCvCamera
from scopemap.input.camera_files.parsing import MOST_TERMS, Fields, is_number, numbers_in

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
_LISTS = (
    "distortion_coefficients", "D", "D1", "K_dist", "distCoeffs", "dist", "DL", "dist_coeff", "dist_coefs",
    "dist_coef", "distortion", "distortion_coeffs", "distortion_coeff", "distortion_coefficient", "distortion_coefs",
    "distortion_parameters", "distortion_params", "dist_params", "distortion_vector", "lens_distortion", "coeffs",
    "coefficients", "kc", "distCoeffs1", "distCoeff1", "dist1",
)  # fmt: skip
_RADIAL_LISTS = ("RadialDistortion", "radial", "radial_distortion_coefficients", "radial_coefficients")
_TANGENTIAL_LISTS = (
    "TangentialDistortion", "tangential", "tangential_distortion_coefficients", "tangential_coefficients",
)  # fmt: skip
_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
_TANGENTIAL = ("p1", "p2")
_MODELS = ("camera_model", "distortion_model", "lens_model", "model", "model_type", "distortion_type", "type")
_FLAGS = ("fisheye_model", "fisheye", "is_fisheye")
_UNREAD = re.compile(r"(?<!un)dist(?!anc|rib)|coef|radial|tangential", re.IGNORECASE)
# Counts, settings and precisions of a lens, and the second camera's, are not its coefficients.
_BESIDE = re.compile(
    r"num|count|estim|flag|model$|type$|fix|zero|max|min|std|sigma|err|uncert|cov|right|inverse|depth|2$|_r$",
    re.IGNORECASE,
)
_LONGEST_QUOTE = 40
_WITH_THIN_PRISM = (12, 14)
_MOST_TRIED = 100
_DEEPEST = 3


def model_in(levels: Sequence[Fields]) -> str:
    """Return the words for the lens in the levels of a tree, "" where there are none."""
    places = _places(levels)
    texts = [place.words(_MODELS) for place in places] + ["fisheye" for place in places if place.flag(_FLAGS)]
    return " ".join(filter(None, texts))


def lens_of(pinhole: PinholeCamera, levels: Sequence[Fields], model: str) -> tuple[CameraModel, str]:
    """Return the camera with the lens in the levels of a tree, and a note on what was assumed of it.

    Of several sets of coefficients the first that is not zero counts. Raises `ValueError` as `with_lens`, and where
    something looks like coefficients but is not read.
    """
    found = [*_candidates(levels, model), []]
    coefficients = next(filter(any, found), found[0])
    if not any(coefficients):
        _check_nothing_unread(levels)
    return with_lens(pinhole, model, coefficients)


def with_lens(pinhole: PinholeCamera, model: str, coefficients: Sequence[float]) -> tuple[CameraModel, str]:
    """Return the camera with the lens that the words `model` name, and a note on what was assumed, "" for nothing.

    No words, and words that name no lens (the endoscope's name), mean OpenCV's. Zeros at the end do not count.
    Raises `ValueError` for a model that has no counterpart here, and for a wrong number of coefficients.
    """
    if len(coefficients) > MOST_TERMS:
        raise ValueError(f"it has {len(coefficients)} distortion coefficients, more than any lens")
    lens = tuple(float(k) for k in coefficients)
    if _OTHER_PROJECTION.search(model) or (any(lens) and _OTHER_DISTORTION.search(model)):
        advice = "calibrate as pinhole with radial-tangential or equidistant (fisheye) coefficients"
        raise ValueError(f"the lens model {model[:_LONGEST_QUOTE]!r} has no counterpart here: {advice}")
    if _FISHEYE.search(model):
        return FisheyeCamera(pinhole, _with_count(lens, 4)), ""
    if _FOV.search(model):
        lens = _with_count(lens, 1)
        if len(lens) != 1:
            raise ValueError(f"a lens of the model fov has one coefficient, found {len(lens)}")
        return FovCamera(pinhole, lens[0]) if lens[0] else pinhole, ""
    if not any(lens):
        return pinhole, ""
    if len(lens) in _WITH_THIN_PRISM:
        if any(lens[8:]):
            raise ValueError("the thin-prism and tilt coefficients s1 ... have no counterpart: calibrate without them")
        lens = lens[:8]
    camera = OpenCvCamera(pinhole, lens)
    if model and not _OPENCV.search(model):
        return camera, f", its lens taken as OpenCV's ({model[:_LONGEST_QUOTE]!r} names none)"
    return camera, ""


def _with_count(lens: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return `count` coefficients, where only zeros are missing or too many."""
    return (*lens[:count], *[0.0] * (count - len(lens))) if not any(lens[count:]) else lens


def _places(levels: Sequence[Fields]) -> list[Fields]:
    return [*levels, *(inner for level in levels for inner in level.inner(_LISTS))]


def _candidates(levels: Sequence[Fields], model: str) -> Iterator[list[float]]:
    """Yield coefficients in the order of the lens: of each list, by kind, by name."""
    for place in _places(levels):
        for name, node in place.nodes(_LISTS):
            if (coefficients := numbers_in(node, name)) is not None:
                yield coefficients
        radial, tangential = place.numbers(_RADIAL_LISTS) or [], place.numbers(_TANGENTIAL_LISTS) or []
        if len(radial) > len(_RADIAL) or len(tangential) > len(_TANGENTIAL):
            raise ValueError("it has more radial or tangential coefficients than any lens")
        if radial or tangential:
            tangential += [0.0] * (len(_TANGENTIAL) - len(tangential))
            yield _in_order(dict(zip((*_TANGENTIAL, *_RADIAL), (*tangential, *radial), strict=False)), model)
        named = {name: place.number((name,)) for name in (*_RADIAL, *_TANGENTIAL)}
        if found := {name: value for name, value in named.items() if value is not None}:
            yield _in_order(found, model)


def _in_order(found: dict[str, float], model: str) -> list[float]:
    """Return named coefficients in the order of the lens; `ValueError` where their names do not tell which it is."""
    radial, tangential = ([found.get(name, 0.0) for name in names] for names in (_RADIAL, _TANGENTIAL))
    if _FISHEYE.search(model):
        if any(tangential) or any(radial[4:]):
            raise ValueError("a Kannala-Brandt lens has k1 k2 k3 k4 alone, found others, too")
        return radial[:4]
    if not model and radial[3] and not found.keys() & set(_TANGENTIAL):
        raise ValueError("it has k4 but no p1, and names no model: OpenCV's or a fisheye's? add `model: fisheye`")
    terms = [*radial[:2], *tangential, *radial[2:]]
    return terms if any(terms[5:]) else terms[:5] if terms[4] else terms[:4]


def _check_nothing_unread(levels: Sequence[Fields]) -> None:
    for name, node in (pair for level in levels for pair in level.pairs):
        is_lens = _UNREAD.search(name) or (isinstance(node, Fields) and node.number(("k1",)) is not None)
        if is_lens and not _BESIDE.search(name) and _has_numbers(node):
            advice = "call it distortion_coefficients, a list in OpenCV's order, k1 k2 p1 p2 k3"
            raise ValueError(f"{name[:_LONGEST_QUOTE]!r} in it looks like distortion but is not read: {advice}")


def _has_numbers(node: Any, depth: int = 0) -> bool:
    """Return whether a number other than 0 is in a node; YAML's aliases may make it larger than the file."""
    if isinstance(node, Fields):
        node = [inner for name, inner in node.pairs if name not in ("rows", "cols")]
    if isinstance(node, list):
        return depth < _DEEPEST and any(_has_numbers(inner, depth + 1) for inner in node[:_MOST_TRIED])
    return any(is_number(word) and float(word) for word in str(node).split())
