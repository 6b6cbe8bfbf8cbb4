"""Intrinsics one by one, by name: fx, fy, cx, cy with k1, k2, p1, ...; as ORB-SLAM, OneSLAM and many others have them.

`Camera.fx: 520` (ORB-SLAM2), `Camera1.fx: 520` (ORB-SLAM3), `{"intrinsics": {"fx": 520, ...}}` (OneSLAM), `fx: 520` or
`fx=520` on lines of their own or in one, separated by commas.
"""

from __future__ import annotations

import re
from typing import Any

from scopemap.cameras.formats.distortion import model_in
from scopemap.cameras.formats.fields import Fields
from scopemap.cameras.formats.opencv import INNER, depth_scale_mm, lens_of
from scopemap.cameras.formats.sizes import size_of
from scopemap.cameras.formats.stated import Calibration, Size, pinhole_of
from scopemap.cameras.formats.trees import Repeated, Tree, as_number

_PREFIXES = ("Camera.", "Camera1.")
_OF_NERFSTUDIO = "fl_x"
_INTRINSICS = {
    "fx": ("fx", _OF_NERFSTUDIO, "focal_x", "focal_length_x"),
    "fy": ("fy", "fl_y", "focal_y", "focal_length_y"),
    "cx": ("cx", "ppx"),
    "cy": ("cy", "ppy"),
}
# Nothing, and what begins something else in YAML.
_NO_VALUES = ("", *"[{*&!|>")
_CORNER_TO_CENTRE_PX = 0.5


def has_names(tree: Tree) -> bool:
    """Whether a tree names a focal length in one of these ways."""
    return any(next(level.nodes(_INTRINSICS["fx"]), None) is not None for level, _ in _places(tree))


def of_names(tree: Tree, image_size: Size) -> Calibration:
    """Return the camera of a tree that names its intrinsics; `ValueError` where one is missing or no number."""
    own, prefix = next(place for place in _places(tree) if next(place[0].nodes(_INTRINSICS["fx"]), None) is not None)
    found = {name: own.number(spellings) for name, spellings in _INTRINSICS.items()}
    intrinsics = [value for value in found.values() if value is not None]
    if len(intrinsics) < 4:
        raise ValueError(f"it has no {', '.join(prefix + name for name, value in found.items() if value is None)}")
    note = ""
    if own.number((_OF_NERFSTUDIO,)) is not None and max(intrinsics[2:]) > 1:
        intrinsics[2:] = [value - _CORNER_TO_CENTRE_PX for value in intrinsics[2:]]
        note = ", its pixels counted from the corner, as in nerfstudio"
    whole = Fields(tree)
    levels = [own, whole] if prefix or next(whole.nodes(_INTRINSICS["fx"]), None) is None else [whole]
    size, size_note = size_of(levels, intrinsics, image_size)
    pinhole, origin = pinhole_of(intrinsics, size, image_size)
    camera, lens_note = lens_of(pinhole, levels, model_in(levels))
    return Calibration(camera, depth_scale_mm(levels), note + size_note + lens_note, origin)


def _places(tree: Tree) -> list[tuple[Fields, str]]:
    """Return where a tree may have its intrinsics, and with which prefix: within it, at its top, as ORB-SLAM does."""
    top = Fields(tree)
    prefixed = [
        ({name.removeprefix(prefix): node for name, node in tree.items() if name.startswith(prefix)}, prefix)
        for prefix in _PREFIXES
    ]
    return [(level, "") for level in (*top.inner(INNER), top)] + [(Fields(part), prefix) for part, prefix in prefixed]


def pairs_in(text: str) -> dict[str, Any] | None:
    """Return names and values of `name: value` or `name=value`, on lines of their own or separated by , or ;.

    None where there is anything else but comments.
    """
    pairs: dict[str, Any] = {}
    lines = (line.partition("#")[0] for line in text.splitlines() if line.strip())
    for part in (part.strip() for line in lines for part in re.split("[,;]", line)):
        name, separator, value = part.partition("=" if "=" in part else ":")
        value = value.strip()
        if part and (not separator or not name.strip() or value[:1] in _NO_VALUES):
            return None
        if part:
            pairs[name.strip()] = Repeated() if name.strip() in pairs else value
    return pairs or None


def numbers_of_pairs(text: str) -> dict[str, float]:
    """Return the numbers of a text of pairs by name in lower case; `ValueError` for anything else in it."""
    pairs = pairs_in(text)
    if pairs is None:
        raise ValueError("expected lines `name: number`")
    return {name.lower(): as_number(value, name) for name, value in pairs.items()}
