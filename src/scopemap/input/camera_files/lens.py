"""The lens of a calibration file: its model, in any tool's words (`lens_models.py`), and its distortion coefficients.

Nothing that a file says of its lens is passed over: what is not used is an error by its name (`coefficients.py`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.input.camera_files.coefficients import LISTS, coefficients_in, has_numbers
from scopemap.input.camera_files.lens_models import OPENCV, OTHER_DISTORTION, OTHER_PROJECTION, lens_called
from scopemap.input.camera_files.parsing import MOST_TERMS, Fields

_SCARAMUZZA = re.compile(r"scaramuzza|ocam|omnidirectional")
_MODELS = (
    "camera_model", "distortion_model", "lens_model", "model", "model_type", "distortion_type", "type", "camera_type",
    "lens_type", "projection", "projection_model", "projection_type", "intrinsics_model", "intrinsics_type",
    "model_name",
)  # fmt: skip
# Numbers that lenses without a counterpart have beside those of a pinhole, and such a lens.
_OF_OTHERS = {"xi": "unified omnidirectional (MEI)", "mirror_parameters": "unified omnidirectional (MEI)"}
_FLAGS = ("fisheye_model", "fisheye", "is_fisheye")
_LONGEST_QUOTE = 40


def model_in(levels: Sequence[Fields]) -> str:
    """Return the words for the lens in the levels of a tree, "" where there are none."""
    places = _places(levels)
    texts = [place.words(_MODELS) for place in places] + ["fisheye" for place in places if place.flag(_FLAGS)]
    return " ".join(filter(None, texts))


def refuse_other_lens(levels: Sequence[Fields], model: str) -> None:
    """Raise `ValueError`, with its name, for a lens that has no counterpart here, by its words or by its numbers."""
    for name, lens in _OF_OTHERS.items():
        for level in levels:
            for spelling, node in level.nodes((name,)):
                if has_numbers(node):
                    raise _no_counterpart(model or lens, f", for {spelling[:_LONGEST_QUOTE]!r} in it")
    if _SCARAMUZZA.search(model):
        looked_for = "looked for as a0 a1 ..., as `polynomial`, and in OCamCalib's own text"
        raise ValueError(f"its model is {model[:_LONGEST_QUOTE]!r}, but it has no polynomial ({looked_for})")
    if OTHER_PROJECTION.search(model):
        raise _no_counterpart(model)


def lens_of(pinhole: PinholeCamera, levels: Sequence[Fields], model: str) -> tuple[CameraModel, str]:
    """Return the camera with the lens in the levels of a tree, and a note on what was assumed of it.

    Raises `ValueError` as `with_lens` and `coefficients_in`.
    """
    places, note = _places(levels), ""
    if not model and (model := "fisheye" if _is_column(places) else ""):
        note = ", its lens taken as a fisheye's: D is 4x1, as cv2.fisheye returns it"
    coefficients = coefficients_in(places, lens_called(model) or (OPENCV if model else None))
    if not model and any(coefficients) and _is_undecided(places, coefficients):
        raise ValueError(
            "its four coefficients may be k1 k2 p1 p2 of OpenCV's lens or k1 k2 k3 k4 of a fisheye's: "
            "add `model: opencv` or `model: fisheye`"
        )
    camera, assumed = with_lens(pinhole, model, coefficients)
    return camera, note + assumed


def with_lens(pinhole: PinholeCamera, model: str, coefficients: Sequence[float]) -> tuple[CameraModel, str]:
    """Return the camera with the lens that the words `model` name, and a note on what was assumed, "" for nothing.

    No words, and words that name no lens (the endoscope's name), mean OpenCV's. Zeros at the end do not count.
    Raises `ValueError` for a model that has no counterpart here, and for a wrong number of coefficients.
    """
    if len(coefficients) > MOST_TERMS:
        raise ValueError(f"it has {len(coefficients)} distortion coefficients, more than any lens")
    values, lens = tuple(float(k) for k in coefficients), lens_called(model)
    if OTHER_PROJECTION.search(model) or (any(values) and OTHER_DISTORTION.search(model)):
        raise _no_counterpart(model)
    if lens is not None or not model or not any(values):
        return (lens or OPENCV).make(pinhole, values), ""
    assumed = f", its lens taken as OpenCV's ({model[:_LONGEST_QUOTE]!r} names none)"
    return OPENCV.make(pinhole, values), assumed


def _is_column(places: Sequence[Fields]) -> bool:
    """Return whether coefficients are four rows of one, which only `cv2.fisheye.calibrate` returns."""
    lists = (node for place in places for _, node in place.nodes(LISTS) if isinstance(node, list))
    return any(len(rows) == 4 and all(isinstance(row, list) and len(row) == 1 for row in rows) for rows in lists)


def _is_undecided(places: Sequence[Fields], coefficients: Sequence[float]) -> bool:
    """Return whether four coefficients are in a file's column, or beside the DIM of programs that use `cv2.fisheye`."""
    if len(coefficients) != 4:
        return False
    matrices = [node for place in places for _, node in place.nodes(LISTS) if isinstance(node, Fields)]
    is_column = any((node.number(("rows",)), node.number(("cols",))) == (4, 1) for node in matrices)
    return is_column or any(any(place.nodes(("DIM",))) for place in places)


def _places(levels: Sequence[Fields]) -> list[Fields]:
    return [*levels, *(inner for level in levels for inner in level.inner(LISTS))]


def _no_counterpart(model: str, why: str = "") -> ValueError:
    advice = "calibrate as pinhole with radial-tangential or equidistant (fisheye) coefficients"
    return ValueError(f"the lens model {model[:_LONGEST_QUOTE]!r}{why} has no counterpart here: {advice}")
