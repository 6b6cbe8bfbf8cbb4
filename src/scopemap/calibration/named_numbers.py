"""Intrinsics one by one, by name: fx, fy, cx, cy with k1, k2, p1, ...; as ORB-SLAM, OneSLAM and many others have them.

`Camera.fx: 520` (ORB-SLAM2), `Camera1.fx: 520` (ORB-SLAM3), `{"intrinsics": {"fx": 520, ...}}` (OneSLAM), `fx: 520` or
`fx=520` on lines of their own or in one, separated by commas.
"""

from __future__ import annotations

import re

from scopemap.calibration.opencv import size_of
from scopemap.calibration.stated import Calibration, Size, pinhole_of, with_lens
from scopemap.calibration.trees import Tree, as_number, number, words

_PREFIXES = ("", "Camera.", "Camera1.")
_FOCAL = ("fx", "fy")
_CENTRE = ("cx", "cy")
_RADIAL = ("k1", "k2", "k3", "k4", "k5", "k6")
_TANGENTIAL = ("p1", "p2")
_MODEL_NAMES = ("Camera.type", "camera_model", "distortion_model", "model", "type")
# Nothing, and what begins something else in YAML.
_NO_VALUES = ("", *"[{*&!|>")
_KANNALA_BRANDT = re.compile("kannala|fisheye|equi|kb4")


def has_names(tree: Tree) -> bool:
    """Whether a tree names a focal length in one of these ways."""
    return isinstance(tree.get("intrinsics"), dict) or any(f"{prefix}fx" in tree for prefix in _PREFIXES)


def of_names(tree: Tree, image_size: Size) -> Calibration:
    """Return the camera of a tree that names its intrinsics; `ValueError` where one is missing or no number."""
    inner = tree.get("intrinsics")
    own = inner if isinstance(inner, dict) else tree
    prefix = next((prefix for prefix in _PREFIXES if f"{prefix}fx" in own), "")
    found = {name: number(own, (prefix + name,)) for name in (*_FOCAL, *_CENTRE, *_RADIAL, *_TANGENTIAL)}
    intrinsics = [value for name in (*_FOCAL, *_CENTRE) if (value := found[name]) is not None]
    if len(intrinsics) < 4:
        missing = ", ".join(prefix + name for name in (*_FOCAL, *_CENTRE) if found[name] is None)
        raise ValueError(f"it has no {missing}")
    pinhole, origin = pinhole_of(intrinsics, size_of(own) or size_of(tree), image_size)
    model = words(tree, _MODEL_NAMES) or words(own, _MODEL_NAMES)
    camera = with_lens(pinhole, "" if model == "rectified" else model, _coefficients(found, model))
    return Calibration(camera, None, "", origin)


def pairs_in(text: str) -> dict[str, str] | None:
    """Return names and values of `name: value` or `name=value`, on lines of their own or separated by , or ;.

    None where there is anything else but comments.
    """
    pairs: dict[str, str] = {}
    lines = (line.partition("#")[0] for line in text.splitlines() if line.strip())
    for part in (part.strip() for line in lines for part in re.split("[,;]", line)):
        name, separator, value = part.partition("=" if "=" in part else ":")
        value = value.strip()
        if part and (not separator or not name.strip() or value[:1] in _NO_VALUES):
            return None
        if part:
            if name.strip() in pairs:
                raise ValueError(f"{name.strip()[:40]!r} stands in it twice: leave one out")
            pairs[name.strip()] = value
    return pairs or None


def _coefficients(found: dict[str, float | None], model: str) -> list[float]:
    """Return the coefficients in OpenCV's order of the model; `ValueError` where their names do not tell the model."""
    radial = [found[name] or 0.0 for name in _RADIAL]
    tangential = [found[name] or 0.0 for name in _TANGENTIAL]
    if _KANNALA_BRANDT.search(model):
        if any(tangential) or any(radial[4:]):
            raise ValueError("a Kannala-Brandt lens has k1 k2 k3 k4 alone, found others, too")
        return radial[:4]
    if not model and radial[3] and not any(found[name] is not None for name in _TANGENTIAL):
        raise ValueError("it has k4 but no p1, and names no model: OpenCV's or a fisheye's? add `model: fisheye`")
    terms = [*radial[:2], *tangential, *radial[2:]]
    return terms if any(terms[5:]) else terms[:5] if terms[4] else terms[:4]


def numbers_of_pairs(text: str) -> dict[str, float]:
    """Return the numbers of a text of pairs by name in lower case; `ValueError` for anything else in it."""
    pairs = pairs_in(text)
    if pairs is None:
        raise ValueError("expected lines `name: number`")
    return {name.lower(): as_number(value, name) for name, value in pairs.items()}
