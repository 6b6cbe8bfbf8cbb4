"""Calibration targets: a checkerboard or a ChArUco board, found in an image by OpenCV's detectors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scopemap.errors import SettingsError

DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
"""Names of the sets of markers that OpenCV has."""

_FEWEST, _MOST = 3, 100  # a side, inner corners or squares
_FEWEST_CORNERS = 8
# A target is first looked for in an image of this size: the search takes seconds in a large one without a target.
_SEARCH_SIDE_PX = 800
# Corners are refined in a window of so many px, or this share of the image, but at most this share of a square: farther
# off, the lens bends the edges.
_REACH_PX, _REACH_SHARE, _REACH_SQUARES = 8, 1 / 160, 0.4
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
    """A checkerboard of `columns` x `rows` inner corners, where four squares meet; all have to be in the image.

    Raises `SettingsError` for a board that cannot be.
    """

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
