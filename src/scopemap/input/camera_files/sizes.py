"""The size of the pictures that a calibration file was made for, under any usual name, or in a comment."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import TypeAlias

from scopemap.input.camera_files.calibration import Size, check_size
from scopemap.input.camera_files.parsing import Fields, mappings_below, numbers_in

# Width, height, and whether they were in one list.
_Sides: TypeAlias = tuple[float | None, float | None, bool]
_OF = ("image", "img", "im", "frame", "picture", "video", "input", "calibration", "calib", "original")
_SIZES = (
    *(f"{of}_{name}" for of in (*_OF, "camera") for name in ("size", "resolution", "shape", "dimensions")),
    "resolution", "dim", "image_dimension", "calib_dimension",
)  # fmt: skip
_UNSURE_SIZES = ("size", "dimensions", "shape")
_SIDES = (
    *((f"{of}_{wide}", f"{of}_{high}") for of in _OF for wide, high in (("width", "height"), ("w", "h"))),
    *((f"{of}_width_px", f"{of}_height_px") for of in _OF), ("width_px", "height_px"), ("res_x", "res_y"),
    ("resolution_x", "resolution_y"), ("x_resolution", "y_resolution"), ("x_res", "y_res"), ("imx", "imy"),
    ("size_x", "size_y"), ("x_size", "y_size"),
)  # fmt: skip
# Of the image, or of the calibration board, whose number of corners or squares has the same names.
_UNSURE_SIDES = (
    ("width", "height"), ("w", "h"), ("cols", "rows"), ("columns", "rows"), ("ncols", "nrows"), ("nx", "ny"),
)  # fmt: skip
# Mappings beside that of the camera in which a width is the image's; and those that belong to something else.
_OF_IMAGE = re.compile(r"^(image|img|im|frame|picture|video|camera|resolution|size)", re.IGNORECASE)
_OF_ANOTHER = re.compile(r"^cam\d|right|[_-]?[2r]$|depth|roi|board|target|pattern|sensor", re.IGNORECASE)
_SMALLEST_SIDE_PX = 16
_LONGEST_COMMENTED = 20_000
_TIMES = re.compile(r"\s*(\d{2,6})\s*(?:px|pixels?)?\s*(?:[x×*, ]|by)\s*(\d{2,6})\s*(?:px|pixels?)?\s*", re.IGNORECASE)
_COMMENTS = re.compile(
    r"(?:#|//|%|^\s*;)(.*)$|<!--([\s\S]{0,200}?)-->|\"_?(?:comment|note|description|remark)s?\"\s*:\s*\"(.*?)\"",
    re.IGNORECASE | re.MULTILINE,
)
_IN_COMMENT = (
    re.compile(r"(?<![\d.])(\d{3,5}) ?(?:px|pixels?)? ?(?:[x×*]|by) ?(\d{3,5})(?![\d.])", re.IGNORECASE),
    re.compile(r"\bw(?:idth)?\b\W{0,5}(\d{3,5})\b[^\d]{1,40}?\bh(?:eight)?\b\W{0,5}(\d{3,5})\b", re.IGNORECASE),
    re.compile(r"(?:size|resolution)\W{0,5}(\d{3,5})[ ,;]{1,3}(\d{3,5})(?![\d.])", re.IGNORECASE),
)


def size_of(
    levels: Sequence[Fields], root: Fields, intrinsics: Sequence[float], image_size: Size
) -> tuple[Size | None, str]:
    """Return the size (width, height), px, that a tree states, None where it states none, and a note on it.

    `levels` : where the camera is; `root` : the whole tree, whose other mappings are looked through after them. Zeros,
    which ROS writes for an unknown size, are no size. Raises `ValueError` for half a size.
    """
    _, _, cx, cy = intrinsics
    for width, height, is_list in _sizes_in(levels, root, cx, cy):
        if not width and not height:
            continue
        if not width or not height:
            raise ValueError("it states one of width and height, but not both")
        size = check_size(width, height)
        if is_list and size != image_size and size[::-1] == image_size:
            as_stated, swapped = ((cx - w / 2) ** 2 + (cy - h / 2) ** 2 for w, h in (size, image_size))
            if swapped < as_stated:
                return image_size, f", its size {size[0]}, {size[1]} taken as height, width"
        return size, ""
    return None, ""


def size_in_comments(text: str) -> Size | None:
    """Return the one size (width, height), px, that the comments of a text name, None where it is none or several."""
    comments = "\n".join("".join(groups) for groups in _COMMENTS.findall(text[:_LONGEST_COMMENTED]))
    found = {(int(wide), int(high)) for form in _IN_COMMENT for wide, high in form.findall(comments)}
    return found.pop() if len(found) == 1 else None


def _sizes_in(levels: Sequence[Fields], root: Fields, cx: float, cy: float) -> Iterator[_Sides]:
    for level in levels:
        yield from _sizes_at(level, cx, cy, unsure=True)
    for name, place in mappings_below(root, _OF_ANOTHER):
        yield from _sizes_at(place, cx, cy, unsure=bool(_OF_IMAGE.search(name)))


def _sizes_at(level: Fields, cx: float, cy: float, unsure: bool) -> Iterator[_Sides]:
    least = max(cx, _SMALLEST_SIDE_PX), max(cy, _SMALLEST_SIDE_PX)
    for names, is_sure in ((_SIZES, True), (_UNSURE_SIZES if unsure else (), False)):
        for sides in filter(None, (_sides_in(node, name) for name, node in level.nodes(names))):
            if is_sure or (sides[0] > least[0] and sides[1] > least[1]):
                yield *sides, True
    for place in (level, *level.inner(_SIZES)):
        for wide, high in (*_SIDES, *(_UNSURE_SIDES if unsure else ())):
            width, height = place.number((wide,)), place.number((high,))
            # A width that does not contain the principal point is the calibration board's.
            if (wide, high) in _SIDES or ((width or 0) > least[0] and (height or 0) > least[1]):
                yield width, height, False


def _sides_in(node: object, name: str) -> tuple[float, float] | None:
    """Return the two numbers of `640x480` or of a list, also of one with the count of channels behind them."""
    if isinstance(node, str) and (text := _TIMES.fullmatch(node)):
        return float(text[1]), float(text[2])
    found = numbers_in(node, name)
    if found is None or not (len(found) == 2 or (len(found) == 3 and found[2] in (1, 3, 4))):
        return None
    return found[0], found[1]
