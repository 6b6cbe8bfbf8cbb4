"""Views of a board: the frames of an input in which it is found, and how sharp they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from scopemap.calibration.targets import Board, Corners, nearest_px
from scopemap.errors import InputError
from scopemap.io.source import Source

_FRAMES_LOOKED_AT = 300
_FARTHEST_EDGE_PX = 20

Listener = Callable[[int, int | None], None]


@dataclass(frozen=True)
class View:
    """A board as one frame shows it.

    Attributes
    ----------
    index : number of the frame in the input. name : the frame's file, or "".
    corners : the board's corners and where they are seen, those in use.
    edge_px : width of the edges between black and white, px.
    found : all corners that were found.
    """

    index: int
    name: str
    corners: Corners
    edge_px: float
    found: Corners


@dataclass
class Search:
    """What looking through an input gave.

    Attributes
    ----------
    size : width and height of the frames, px.
    selection : the frames in which the board was looked for, every `every`-th of those asked for.
    looked_at : how many these were.
    views : where it was found.
    without : some of the frames in which it was not found, grey: to say why.
    """

    size: tuple[int, int]
    selection: slice = field(default_factory=lambda: slice(None))
    every: int = 1
    looked_at: int = 0
    views: list[View] = field(default_factory=list)
    without: list[np.ndarray] = field(default_factory=list)


def find_views(
    source: Source,
    board: Board,
    selection: slice | None = None,
    every: int | None = None,
    listener: Listener | None = None,
) -> Search:
    """Look for `board` in every `every`-th selected frame, as `source` has it; None: about 300 frames in all.

    `selection` counts positions in the source, None: all. `listener` is told the frames looked at, and of how many.
    Raises `InputError` where the source cannot be read.
    """
    selection = selection or slice(None)
    if selection.step is not None and selection.step <= 0:
        raise InputError(f"selecting frames: the step must be positive, got {selection.step}")
    count = None if source.count is None else len(range(*selection.indices(source.count)))
    every = every or max(1, (count or 0) // _FRAMES_LOOKED_AT)
    total = None if count is None else -(-count // every)
    looked_at = slice(selection.start, selection.stop, every * (selection.step or 1))
    search = Search((source.width, source.height), looked_at, every)
    missed = 0
    for frame in source.frames(looked_at):
        search.looked_at += 1
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        corners = board.find(grey)
        if corners is None:
            missed += 1
            if missed & (missed - 1) == 0:  # the 1st, 2nd, 4th, 8th ...: few, from all parts of a long video
                search.without.append(grey)
        else:
            search.views.append(View(frame.index, frame.name, corners, edge_width_px(grey, corners.pixels), corners))
        if listener is not None:
            listener(search.looked_at, total)
    return search


def picture_of(view: View, source: Source, search: Search) -> np.ndarray:
    """Return the frame (h, w, 3) uint8 of a view that `search` found in `source`, read anew."""
    for frame in source.frames(search.selection):
        if frame.index == view.index:
            return frame.rgb
    raise InputError(f"reading {source.path} again: frame {view.index} is gone")


def edge_width_px(grey: np.ndarray, pixels: np.ndarray) -> float:
    """Return how wide the edges at corners (N, 2) are, px: contrast over steepest slope, the median of the corners."""
    image = grey.astype(np.float32)
    slope = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8))
    reach = int(np.clip(0.4 * nearest_px(pixels), 2, _FARTHEST_EDGE_PX))
    widths = []
    for u, v in np.rint(pixels).astype(int):
        window = np.s_[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
        widths.append(float(np.ptp(image[window])) / max(float(slope[window].max()), 1e-6))
    return float(np.median(widths))
