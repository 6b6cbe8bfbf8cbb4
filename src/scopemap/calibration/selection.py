"""Which views to calibrate with: sharp ones that differ and together cover the picture; a video shows most twice."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.calibration.views import View

MOST_VIEWS = 40
_CELLS_ACROSS = 16
# Edges so much wider than in the sharper quarter of the views are blurred.
_BLURRED, _BLURRED_PX = 1.7, 0.5
# Views this close in place, size and tilt, with this few new cells, show the same.
_SAME, _NEW_CELLS = 0.05, 2
_FARTHEST = 0.5


@dataclass(frozen=True)
class LeftOut:
    """A view that was not used, and why."""

    view: View
    reason: str


@dataclass(frozen=True)
class Selected:
    """Views to calibrate with; those that were blurred; how many looked like one of the selected."""

    views: list[View]
    blurred: list[LeftOut]
    alike: int


def select_views(views: list[View], size: tuple[int, int], most: int = MOST_VIEWS) -> Selected:
    """Return at most `most` sharp `views` of frames of `size` (width, height) that differ, best first.

    The next view is the one with most new cells of the picture under its corners and the greatest distance, in place,
    size and tilt, from those that were taken.
    """
    sharp, blurred = _sharp(views)
    if not sharp:
        return Selected([], blurred, 0)
    pose = np.array([_pose(view, size) for view in sharp])
    cells = np.array([_cells(view, size) for view in sharp])
    sharpness = min(view.edge_px for view in sharp) / np.array([view.edge_px for view in sharp])
    covered, distance = np.zeros(cells.shape[1], dtype=bool), np.full(len(sharp), _FARTHEST)
    chosen: list[int] = []
    while len(chosen) < most:
        new = (cells & ~covered).sum(axis=1)
        worth = np.where((distance < _SAME) & (new < _NEW_CELLS), -1.0, (distance + new / cells.shape[1]) * sharpness)
        worth[chosen] = -1.0
        best = int(np.argmax(worth))
        if worth[best] < 0:
            break
        chosen.append(best)
        covered |= cells[best]
        distance = np.minimum(distance, np.linalg.norm(pose - pose[best], axis=1))
    return Selected([sharp[i] for i in chosen], blurred, len(sharp) - len(chosen))


def coverage(views: list[View], size: tuple[int, int]) -> float:
    """Return the share of a picture of `size` (width, height) that lies within the corners of a view at least."""
    return float(views_per_place(views, size).astype(bool).mean())


def views_per_place(views: list[View], size: tuple[int, int], across: int = 160) -> np.ndarray:
    """Return how many views have a place within their corners: (h, w) int, the picture on a grid `across` wide."""
    scale = across / size[0]
    count = np.zeros((max(1, round(size[1] * scale)), across), dtype=int)
    for view in views:
        hull = cv2.convexHull(np.rint(view.corners.pixels * scale).astype(np.int32))
        count += cv2.fillConvexPoly(np.zeros(count.shape, np.uint8), hull, 1)
    return count


def _sharp(views: list[View]) -> tuple[list[View], list[LeftOut]]:
    if not views:
        return [], []
    usual = float(np.percentile([view.edge_px for view in views], 25))
    limit = max(_BLURRED * usual, usual + _BLURRED_PX)
    reason = "blurred: its edges are {:.1f} px wide, in sharp views {:.1f} px"
    blurred = [LeftOut(view, reason.format(view.edge_px, usual)) for view in views if view.edge_px > limit]
    return [view for view in views if view.edge_px <= limit], blurred


def _pose(view: View, size: tuple[int, int]) -> np.ndarray:
    """Place (2), log size and tilt (2) of the board, all about 1 at most: from the homography, no camera needed."""
    board, pixels = view.corners.board_mm[:, :2], view.corners.pixels
    centre, extent = board.mean(axis=0), float(np.linalg.norm(np.ptp(board, axis=0)))
    picture = float(np.sqrt(size[0] * size[1]))
    H, _ = cv2.findHomography((board - centre) / extent, pixels / picture)
    if H is None:
        return np.array([*(pixels.mean(axis=0) / picture), 0, 0, 0])
    jacobian = H[:2, :2] - np.outer(H[:2, 2], H[2, :2])
    # Down which direction of the picture the board recedes, whatever way up it is held.
    turn = jacobian @ H[2, :2]
    tilt = turn / max(float(np.linalg.norm(turn)), 1e-12) * float(np.linalg.norm(H[2, :2]))
    log_size = 0.5 * float(np.log(max(abs(np.linalg.det(jacobian)), 1e-12)))
    return np.array([*H[:2, 2], log_size, *tilt])


def _cells(view: View, size: tuple[int, int]) -> np.ndarray:
    """Which cells of a grid over the picture hold a corner."""
    side = size[0] / _CELLS_ACROSS
    down = max(1, round(size[1] / side))
    cell = np.clip((view.corners.pixels / side).astype(int), 0, [_CELLS_ACROSS - 1, down - 1])
    covered = np.zeros((down, _CELLS_ACROSS), dtype=bool)
    covered[cell[:, 1], cell[:, 0]] = True
    return covered.ravel()
