"""The size of the pictures that a tree states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from scopemap.cameras.formats.fields import Fields
from scopemap.cameras.formats.stated import LARGEST_SIDE_PX, Size

_PAIRS = ("image_size", "img_size", "im_size", "resolution", "image_resolution", "frame_size", "image_shape")
_SIDES = (
    ("image_width", "image_height"),
    ("img_width", "img_height"),
    ("im_width", "im_height"),
    ("frame_width", "frame_height"),
    ("Camera.width", "Camera.height"),
)
# Of the picture, or of the board, of which the number of corners or squares is so called.
_ANY_PAIR = ("size",)
_ANY_SIDES = (("width", "height"), ("w", "h"), ("cols", "rows"))
_SMALLEST_SIDE_PX = 16


def size_of(levels: Sequence[Fields], intrinsics: Sequence[float], image_size: Size) -> tuple[Size | None, str]:
    """Return the size (width, height), px, that a tree states, None where it states none, and a note on it.

    `width` and the like that the principal point lies outside of are passed over: they are a board's. Zeros, which ROS
    writes for what it does not know, are no size. Raises `ValueError` for half a size, and for what no image has.
    """
    note = ""
    for width, height, kind in _stated(levels):
        if not width and not height:
            continue
        if not width or not height:
            raise ValueError("it states one of width and height, but not both")
        if kind == "any" and not _is_around(intrinsics, (width, height)):
            note = f", its size {width:g}x{height:g} passed over as no picture's"
            continue
        if not (1 <= width <= LARGEST_SIDE_PX and 1 <= height <= LARGEST_SIDE_PX) or width % 1 or height % 1:
            raise ValueError(f"its size is {width:g}x{height:g} px, which no image has")
        size = (int(width), int(height))
        if kind == "pair" and size != image_size and _is_turned(size, intrinsics, image_size):
            return image_size, f", its size {size[0]}, {size[1]} taken as height, width"
        return size, ""
    return None, note


def _stated(levels: Sequence[Fields]) -> Iterator[tuple[float | None, float | None, str]]:
    for level in levels:
        if (pair := level.numbers(_PAIRS, 2)) is not None:
            yield pair[0], pair[1], "pair"
        for inner in level.inner(_PAIRS):
            for wide, high in (*_SIDES, *_ANY_SIDES):
                yield inner.number((wide,)), inner.number((high,)), "sides"
        for wide, high in _SIDES:
            yield level.number((wide,)), level.number((high,)), "sides"
        if (pair := level.numbers(_ANY_PAIR, 2)) is not None:
            yield pair[0], pair[1], "any"
        for wide, high in _ANY_SIDES:
            yield level.number((wide,)), level.number((high,)), "any"


def _is_around(intrinsics: Sequence[float], size: tuple[float, float]) -> bool:
    return min(size) >= _SMALLEST_SIDE_PX and intrinsics[2] < size[0] and intrinsics[3] < size[1]


def _is_turned(size: Size, intrinsics: Sequence[float], image_size: Size) -> bool:
    """Whether the size is height, width of the images: as such, the principal point lies nearer the middle."""
    _, _, cx, cy = intrinsics
    as_stated, as_turned = ((cx - w / 2) ** 2 + (cy - h / 2) ** 2 for w, h in (size, size[::-1]))
    return size[::-1] == image_size and as_turned < as_stated
