"""Calibration targets, a checkerboard or a ChArUco board: found by OpenCV, and sharp views that differ selected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scopemap.engine.errors import InputError, SettingsError
from scopemap.input.source import Source

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
"""Names of the sets of markers that OpenCV has."""

_FEWEST = 3  # a side, inner corners or squares
_MOST = 100
_FEWEST_CORNERS = 8
# A target is first looked for in an image of this size: the search takes seconds in a large one without a target.
_SEARCH_SIDE_PX = 800
# Corners are refined in a window of so many px, or this share of the image, but at most this share of a square: farther
# off, the lens bends the edges.
_REACH_PX = 8
_REACH_SHARE = 1 / 160
_REACH_SQUARES = 0.4
_REFINED = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)


@dataclass(frozen=True)
class Corners:
    """Corners of a target: `board_mm` (N, 3) float64, on the target, z = 0; `pixels` (N, 2) float64, in the image."""

    board_mm: np.ndarray
    pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.pixels)

    def where(self, kept: np.ndarray) -> Corners:
        """Return the corners that the mask (N,) keeps."""
        return Corners(self.board_mm[kept], self.pixels[kept])


@dataclass(frozen=True)
class Checkerboard:
    """A checkerboard of `columns` x `rows` inner corners, all in the image; `SettingsError` for one that cannot be."""

    columns: int
    rows: int
    square_mm: float

    def __post_init__(self) -> None:
        _check(self.columns, self.rows, self.square_mm)

    @property
    def described(self) -> str:
        """The target in a few words."""
        return f"checkerboard of {self.columns}x{self.rows} inner corners, squares of {self.square_mm:g} mm"

    @cached_property
    def corners_mm(self) -> np.ndarray:
        """All corners (N, 3), row by row."""
        grid = np.mgrid[: self.columns, : self.rows, :1].T.reshape(-1, 3)
        return grid * float(self.square_mm)

    def find(self, grey: np.ndarray) -> Corners | None:
        """Return all corners in an image (h, w) uint8, None where one is missing (Duda and Frese, BMVC 2018)."""
        shrink = min(1.0, _SEARCH_SIDE_PX / max(grey.shape))
        small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        size = (self.columns, self.rows)
        found, pixels = cv2.findChessboardCornersSB(small, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        scale = np.array(grey.shape[::-1]) / small.shape[::-1]
        pixels = (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5
        widest = max(_REACH_PX, round(_REACH_SHARE * max(grey.shape)))
        reach = max(2, min(widest, int(_REACH_SQUARES * nearest_px(pixels))))
        start = pixels.astype(np.float32).reshape(-1, 1, 2)
        refined = cv2.cornerSubPix(grey, start, (reach, reach), (-1, -1), _REFINED)
        return Corners(self.corners_mm, refined.reshape(-1, 2).astype(np.float64))


@dataclass(frozen=True)
class CharucoBoard:
    """A ChArUco board: `columns` x `rows` squares, the white ones with markers that identify them; a part is enough.

    `dictionary` is OpenCV's name of the set of markers; `legacy`: laid out as by OpenCV before 4.6. Raises
    `SettingsError` for a board that cannot be.
    """

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_4X4_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        _check(self.columns, self.rows, self.square_mm)
        if not 0 < self.marker_mm < self.square_mm:
            raise SettingsError(f"a marker of {self.marker_mm:g} mm does not fit a square of {self.square_mm:g} mm")
        if self.dictionary not in DICTIONARIES:
            raise SettingsError(f"unknown markers '{self.dictionary}': choose one of {', '.join(DICTIONARIES)}")
        known, wanted = len(self._markers.bytesList), self.columns * self.rows // 2
        if wanted > known:
            raise SettingsError(
                f"a ChArUco board of {self.columns}x{self.rows} squares has {wanted} markers, {self.dictionary} only "
                f"{known}: count squares, not corners, or name its dictionary"
            )

    @property
    def described(self) -> str:
        """The target in a few words."""
        return (
            f"ChArUco board of {self.columns}x{self.rows} squares of {self.square_mm:g} mm, markers of "
            f"{self.marker_mm:g} mm from {self.dictionary}{', legacy layout' if self.legacy else ''}"
        )

    @property
    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    @cached_property
    def layout(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board."""
        size = (self.columns, self.rows)
        board = cv2.aruco.CharucoBoard(size, self.square_mm, self.marker_mm, self._markers)
        board.setLegacyPattern(self.legacy)
        return board

    def find(self, grey: np.ndarray) -> Corners | None:
        """Return the corners beside markers that were read in an image (h, w) uint8, None for too few of them."""
        # In a small image markers have few pixels: doubled, more are read, and corners are twice as exact.
        grow = 2 if max(grey.shape) <= _SEARCH_SIDE_PX else 1
        large = cv2.resize(grey, None, fx=grow, fy=grow, interpolation=cv2.INTER_CUBIC)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(self.layout).detectBoard(large)
        if ids is None or len(ids) < _FEWEST_CORNERS:
            return None
        board_mm = np.asarray(self.layout.getChessboardCorners(), dtype=np.float64)[ids.ravel()]
        if np.any(np.ptp(board_mm[:, :2], axis=0) == 0):
            return None
        return Corners(board_mm, (np.asarray(pixels, dtype=np.float64).reshape(-1, 2) + 0.5) / grow - 0.5)


Target: TypeAlias = Checkerboard | CharucoBoard
"""A printed calibration target."""


def nearest_px(pixels: np.ndarray) -> float:
    """Return the median distance of corners (N, 2) from their nearest neighbour, px."""
    distance, _ = cKDTree(pixels).query(pixels, k=2)
    return float(np.median(distance[:, 1]))


def _check(columns: int, rows: int, square_mm: float) -> None:
    if not all(_FEWEST <= side <= _MOST for side in (columns, rows)):
        raise SettingsError(f"a board of {columns}x{rows} cannot be: {_FEWEST} to {_MOST} a side are possible")
    if not 0 < square_mm < np.inf:
        raise SettingsError(f"the squares of a board must be larger than 0 mm, got {square_mm:g}")


_FRAMES_SEARCHED = 300
_FARTHEST_EDGE_PX = 20
_MOST_VIEWS = 40
_CELLS_ACROSS = 16
# Edges so much wider than in the sharper quarter of the views are blurred.
_BLURRED = 1.7
_BLURRED_PX = 0.5
# Views this close in position, size and tilt, with this few new cells, show the same.
_SAME = 0.05
_NEW_CELLS = 2
_FARTHEST = 0.5

Listener = Callable[[int, int | None], None]


@dataclass(frozen=True)
class DetectedBoard:
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
    views: list[DetectedBoard] = field(default_factory=list)


@dataclass(frozen=True)
class LeftOut:
    """A view that was not used, and why."""

    view: DetectedBoard
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
            search.views.append(DetectedBoard(frame.index, frame.name, corners, edge_width_px(grey, corners.pixels)))
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


def select_views(views: list[DetectedBoard], size: tuple[int, int]) -> tuple[list[DetectedBoard], list[LeftOut]]:
    """Return at most 40 sharp `views` of frames of `size` (width, height) that differ, and the blurred ones."""
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
    while len(chosen) < _MOST_VIEWS:
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


def views_per_pixel(views: list[DetectedBoard], size: tuple[int, int], across: int = 160) -> np.ndarray:
    """Return how many views have a pixel within their corners: (h, w) int, the image on a grid `across` wide."""
    scale = across / size[0]
    count = np.zeros((max(1, round(size[1] * scale)), across), dtype=int)
    for view in views:
        hull = cv2.convexHull(np.rint(view.corners.pixels * scale).astype(np.int32))
        count += cv2.fillConvexPoly(np.zeros(count.shape, np.uint8), hull, 1)
    return count


def _pose(view: DetectedBoard, size: tuple[int, int]) -> np.ndarray:
    """Position (2), log extent, and elongation (2), which changes with the tilt, of the target in the image."""
    pixels = view.corners.pixels / np.sqrt(size[0] * size[1])
    (xx, xy), (_, yy) = np.cov(pixels.T)
    return np.array([*pixels.mean(axis=0), 0.5 * np.log(xx + yy), (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def _cells(view: DetectedBoard, size: tuple[int, int]) -> np.ndarray:
    """Which cells of a grid over the image hold a corner, flat bool."""
    bins = (_CELLS_ACROSS, max(1, round(_CELLS_ACROSS * size[1] / size[0])))
    x, y = view.corners.pixels.T
    count, _, _ = np.histogram2d(x, y, bins, range=((0, size[0]), (0, size[1])))
    return count.ravel() > 0
