"""Views of a calibration target in a video: found, measured for sharpness, and selected so that they differ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from scopemap.calibration.targets import Corners, Target, nearest_px
from scopemap.errors import InputError
from scopemap.io.source import Source

_FRAMES_SEARCHED = 300
_FARTHEST_EDGE_PX = 20
_MOST_VIEWS = 40
_CELLS_ACROSS = 16
# Edges so much wider than in the sharper quarter of the views are blurred.
_BLURRED, _BLURRED_PX = 1.7, 0.5
# Views this close in position, size and tilt, with this few new cells, show the same.
_SAME, _NEW_CELLS = 0.05, 2
_FARTHEST = 0.5

Listener = Callable[[int, int | None], None]


@dataclass(frozen=True)
class BoardView:
    """The target in one frame: number and file ("" for none) of the frame, corners, width of their edges in px."""

    index: int
    name: str
    corners: Corners
    edge_px: float


@dataclass
class Search:
    """The views in frames of `size` (width, height) px, of which one in `every` was searched, `looked_at` in all."""

    size: tuple[int, int]
    every: int = 1
    looked_at: int = 0
    views: list[BoardView] = field(default_factory=list)


@dataclass(frozen=True)
class LeftOut:
    """A view that was not used, and why."""

    view: BoardView
    reason: str


def find_views(
    source: Source,
    target: Target,
    selection: slice | None = None,
    every: int | None = None,
    listener: Listener | None = None,
) -> Search:
    """Search every `every`-th selected frame of `source` for `target`; None: about 300 frames in all.

    `selection` counts positions in the source, None: all. `listener` is called with the number of frames searched, and
    of all. Raises `InputError` where the source cannot be read.
    """
    selection = selection or slice(None)
    step = 1 if selection.step is None else selection.step
    if step <= 0:
        raise InputError(f"selecting frames: the step must be positive, got {step}")
    count = None if source.count is None else len(range(*selection.indices(source.count)))
    every = every or max(1, (count or 0) // _FRAMES_SEARCHED)
    total = None if count is None else -(-count // every)
    search = Search((source.width, source.height), every)
    for frame in source.frames(slice(selection.start, selection.stop, every * step)):
        search.looked_at += 1
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        corners = target.find(grey)
        if corners is not None:
            search.views.append(BoardView(frame.index, frame.name, corners, edge_width_px(grey, corners.pixels)))
        if listener is not None:
            listener(search.looked_at, total)
    return search


def edge_width_px(grey: np.ndarray, pixels: np.ndarray) -> float:
    """Return the width of the edges at corners (N, 2), px: contrast over steepest slope, the median of the corners."""
    image = grey.astype(np.float32)
    slope = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8))
    reach = int(np.clip(0.4 * nearest_px(pixels), 2, _FARTHEST_EDGE_PX))
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    widths = (cv2.dilate(image, window) - cv2.erode(image, window)) / np.maximum(cv2.dilate(slope, window), 1e-6)
    u, v = np.rint(pixels).astype(int).clip(0, np.array(grey.shape[::-1]) - 1).T
    return float(np.median(widths[v, u]))


def select_views(
    views: list[BoardView], size: tuple[int, int], most: int = _MOST_VIEWS
) -> tuple[list[BoardView], list[LeftOut]]:
    """Return at most `most` sharp `views` of frames of `size` (width, height) that differ, and those that are blurred.

    The next view is the one with most new cells of the image under its corners and the greatest distance, in position,
    size and tilt, from those that were taken.
    """
    edge_px = np.array([view.edge_px for view in views])
    usual = float(np.percentile(edge_px, 25))
    limit = max(_BLURRED * usual, usual + _BLURRED_PX)
    reason = "blurred: its edges are {:.1f} px wide, in sharp views {:.1f} px"
    blurred = [LeftOut(view, reason.format(view.edge_px, usual)) for view in views if view.edge_px > limit]
    sharp, edge_px = [view for view in views if view.edge_px <= limit], edge_px[edge_px <= limit]
    pose = np.array([_pose(view, size) for view in sharp])
    cells = np.array([_cells(view, size) for view in sharp])
    covered, distance = np.zeros(cells.shape[1], dtype=bool), np.full(len(sharp), _FARTHEST)
    chosen: list[int] = []
    while len(chosen) < most:
        new = (cells & ~covered).sum(axis=1)
        worth = (distance + new / cells.shape[1]) * edge_px.min() / edge_px
        worth[(distance < _SAME) & (new < _NEW_CELLS)] = -1.0
        worth[chosen] = -1.0
        best = int(np.argmax(worth))
        if worth[best] < 0:
            break
        chosen.append(best)
        covered |= cells[best]
        distance = np.minimum(distance, np.linalg.norm(pose - pose[best], axis=1))
    return [sharp[i] for i in chosen], blurred


def views_per_pixel(views: list[BoardView], size: tuple[int, int], across: int = 160) -> np.ndarray:
    """Return how many views have a pixel within their corners: (h, w) int, the image on a grid `across` wide."""
    scale = across / size[0]
    count = np.zeros((max(1, round(size[1] * scale)), across), dtype=int)
    for view in views:
        hull = cv2.convexHull(np.rint(view.corners.pixels * scale).astype(np.int32))
        count += cv2.fillConvexPoly(np.zeros(count.shape, np.uint8), hull, 1)
    return count


def _pose(view: BoardView, size: tuple[int, int]) -> np.ndarray:
    """Position (2), log extent, and elongation (2), which changes with the tilt, of the target in the image."""
    pixels = view.corners.pixels / np.sqrt(size[0] * size[1])
    (xx, xy), (_, yy) = np.cov(pixels.T)
    return np.array([*pixels.mean(axis=0), 0.5 * np.log(xx + yy), (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def _cells(view: BoardView, size: tuple[int, int]) -> np.ndarray:
    """Which cells of a grid over the image hold a corner, flat bool."""
    bins = (_CELLS_ACROSS, max(1, round(_CELLS_ACROSS * size[1] / size[0])))
    x, y = view.corners.pixels.T
    count, _, _ = np.histogram2d(x, y, bins, range=((0, size[0]), (0, size[1])))
    return count.ravel() > 0
