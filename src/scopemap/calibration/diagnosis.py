"""Why a board was not found: another one lies there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from scopemap.calibration.targets import DICTIONARIES, Board, CharucoBoard, Checkerboard, nearest_px

_ANY_SIZE = (4, 3)
# Texture of any kind often passes for a grid of that size, sometimes for a larger one. It does not lie as a plane does:
# it is off by 0.16 squares and more, larger grids by 0.4; strong distortion moves a whole board by up to 0.3.
_SMALL_OFF, _LARGE_OFF, _SEEN_TWICE = 0.1, 0.3, 2
_LONGEST_SIDE_PX = 1200
_PICTURES = 6
_TELLING_MARKERS = 4


def what_is_seen_instead(board: Board, pictures: list[np.ndarray]) -> str:
    """Return what the grey `pictures`, in which `board` was not found, show of another board; "" where nothing."""
    searches: list[Callable[[Board, np.ndarray], str]] = [_otherwise_laid_out, _other_markers]
    shown = []
    for picture in pictures[-_PICTURES:]:
        shrink = min(1.0, _LONGEST_SIDE_PX / max(picture.shape))
        shown.append(cv2.resize(picture, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA))
    found = next((seen for search in searches for grey in shown if (seen := search(board, grey))), "")
    return found or _other_checkerboard(board, shown)


def _otherwise_laid_out(board: Board, grey: np.ndarray) -> str:
    if not isinstance(board, CharucoBoard):
        return ""
    here, turned = (board.columns, board.rows), (board.rows, board.columns)
    for (columns, rows), legacy in (
        (turned, board.legacy),
        (here, not board.legacy),
        (turned, not board.legacy),
    ):
        if replace(board, columns=columns, rows=rows, legacy=legacy).find(grey) is not None:
            how = "--legacy" if legacy else "without --legacy"
            return f"a ChArUco board of {columns}x{rows} squares is seen: give --board {columns}x{rows}, {how}"
    return ""


def _other_markers(board: Board, grey: np.ndarray) -> str:
    own = board.dictionary if isinstance(board, CharucoBoard) else ""
    counts = {name: _markers_in(grey, name) for name in DICTIONARIES}
    # Small sets are parts of large ones: of those that tell the same, the board's own, else the smallest.
    name = max(DICTIONARIES, key=lambda name: (counts[name], name == own, -_markers_of(name)))
    if counts[name] < _TELLING_MARKERS:
        return ""
    if name == own:
        return f"markers of {own} are seen, but not as they lie on this board: check --board (squares, not corners)"
    asked = f"give --dictionary {name}" if own else f"is it a ChArUco board (--charuco --dictionary {name})?"
    return f"markers of {name} are seen: {asked}"


def _markers_of(dictionary: str) -> int:
    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)


def _markers_in(grey: np.ndarray, dictionary: str) -> int:
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))
    _, ids, _ = detector.detectMarkers(grey)
    return 0 if ids is None else len(ids)


def _other_checkerboard(board: Board, pictures: list[np.ndarray]) -> str:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    tries = (cv2.findChessboardCornersSBWithMeta(grey, _ANY_SIZE, flags) for grey in pictures)
    grids = [np.asarray(pixels, dtype=np.float64).reshape(*meta.shape[:2], 2) for found, pixels, meta in tries if found]
    counts = Counter(tuple(sorted(grid.shape[:2])) for grid in grids if _is_plane(grid))
    # Of a board that is hard to see a part is found: the largest is nearest to the truth.
    sizes = [size for size, count in counts.items() if size != tuple(sorted(_ANY_SIZE)) or count >= _SEEN_TWICE]
    rows, columns = max(sizes, key=lambda size: size[0] * size[1], default=(0, 0))
    if not rows:
        return ""
    seen = f"a checkerboard of {columns}x{rows} inner corners is seen"
    if not isinstance(board, Checkerboard):
        return f"{seen}: leave out --charuco"
    return "" if sorted((board.columns, board.rows)) == [rows, columns] else f"{seen}: give --board {columns}x{rows}"


def _is_plane(grid: np.ndarray) -> bool:
    """Whether corners (rows, columns, 2) lie about as those of a plane do."""
    rows, columns = grid.shape[:2]
    pixels, even = grid.reshape(-1, 2), np.mgrid[:columns, :rows].T.reshape(-1, 2).astype(np.float64)
    H, _ = cv2.findHomography(even, pixels)
    if H is None:
        return False
    off = cv2.perspectiveTransform(even[None], H)[0] - pixels
    limit = _LARGE_OFF if grid.size > 2 * _ANY_SIZE[0] * _ANY_SIZE[1] else _SMALL_OFF
    return bool(np.sqrt(np.mean(np.sum(off**2, axis=1))) < limit * nearest_px(pixels))
