"""The distortion coefficients of a tree, under whatever name and in whatever form they stand there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from scopemap.cameras.formats.fields import Fields, is_number, numbers_in
from scopemap.cameras.formats.lens_models import is_fisheye

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
_MODELS = (
    *("camera_model", "distortion_model", "lens_model", "model", "model_type", "distortion_type", "type"),
    *("Camera.type", "Camera.model"),
)
_FLAGS = ("fisheye_model", "fisheye", "is_fisheye")
_UNREAD = re.compile(r"(?<!un)dist(?!anc|rib)|coef|radial|tangential", re.IGNORECASE)
# Counts, settings and precisions of a lens, and those of the second camera, are not its coefficients.
_BESIDE = re.compile(
    r"num|count|estim|flag|model$|type$|fix|zero|max|min|std|sigma|err|uncert|cov|right|inverse|depth|2$|_r$",
    re.IGNORECASE,
)


def model_in(levels: list[Fields]) -> str:
    """Return the words for the lens in the levels of a tree, "" where there are none."""
    inner = [fields for level in levels for fields in level.inner(_LISTS)]
    texts = [level.words(_MODELS) for level in (*levels, *inner)]
    texts += ["fisheye" for level in (*levels, *inner) if level.flag(_FLAGS)]
    return " ".join(filter(None, texts))


def coefficients_in(levels: list[Fields], model: str) -> tuple[list[float], bool]:
    """Return the coefficients in the order of the lens that `model` names, and whether they stood in one list.

    Of several, the first that is not zero. Raises `ValueError` where what looks like coefficients is not read.
    """
    found: tuple[list[float], bool] = ([], False)
    for coefficients, is_list in _candidates(levels, model):
        found = found if found[0] else (coefficients, is_list)
        if any(coefficients):
            return coefficients, is_list
    for name, node in (pair for level in levels for pair in level.items()):
        is_lens = _UNREAD.search(name) or (isinstance(node, dict) and Fields(node).number(("k1",)) is not None)
        if is_lens and not _BESIDE.search(name) and _holds_number(node):
            raise ValueError(
                f"{name[:40]!r} in it looks like distortion but is not read: call it distortion_coefficients, a list "
                "in OpenCV's order, k1 k2 p1 p2 k3"
            )
    return found


def _candidates(levels: list[Fields], model: str) -> Iterator[tuple[list[float], bool]]:
    for level in levels:
        for name, node in level.nodes(_LISTS):
            coefficients = numbers_in(node, name)
            if coefficients is not None:
                yield coefficients, True
            elif isinstance(node, dict):
                yield from _in_level(Fields(node), model)
        yield from _in_level(level, model, lists=False)


def _in_level(level: Fields, model: str, *, lists: bool = True) -> Iterator[tuple[list[float], bool]]:
    """Yield the coefficients by name, by kind, and in a list within a mapping."""
    if lists and (coefficients := level.numbers(_LISTS)) is not None:
        yield coefficients, True
    radial, tangential = level.numbers(_RADIAL_LISTS), level.numbers(_TANGENTIAL_LISTS) or []
    if radial is not None or tangential:
        names = zip((*_RADIAL, *_TANGENTIAL), (*_filled(radial or [], 6), *_filled(tangential, 2)), strict=True)
        yield _in_order(dict(names), model), False
    found = {name: level.number((name,)) for name in (*_RADIAL, *_TANGENTIAL)}
    if any(value is not None for value in found.values()):
        yield _in_order(found, model), False


def _filled(values: list[float], count: int) -> list[float]:
    if len(values) > count:
        raise ValueError(f"it has {len(values)} radial or tangential coefficients, more than any lens")
    return [*values, *[0.0] * (count - len(values))]


def _in_order(found: dict[str, float | None], model: str) -> list[float]:
    """Return the coefficients in the order of the lens; `ValueError` where their names do not tell which it is."""
    radial = [found[name] or 0.0 for name in _RADIAL]
    tangential = [found[name] or 0.0 for name in _TANGENTIAL]
    if is_fisheye(model):
        if any(tangential) or any(radial[4:]):
            raise ValueError("a Kannala-Brandt lens has k1 k2 k3 k4 alone, found others, too")
        return radial[:4]
    if not model and radial[3] and not any(found[name] is not None for name in _TANGENTIAL):
        raise ValueError("it has k4 but no p1, and names no model: OpenCV's or a fisheye's? add `model: fisheye`")
    terms = [*radial[:2], *tangential, *radial[2:]]
    return terms if any(terms[5:]) else terms[:5] if terms[4] else terms[:4]


def _holds_number(node: Any) -> bool:
    if isinstance(node, dict):
        return any(_holds_number(inner) for name, inner in node.items() if name not in ("rows", "cols"))
    if isinstance(node, list):
        return any(map(_holds_number, node))
    words = node.split() if isinstance(node, str) else [node]
    return any(is_number(word) and float(word) for word in words)
