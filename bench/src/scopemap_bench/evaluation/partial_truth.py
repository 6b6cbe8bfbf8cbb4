"""Runs whose truth no sensor knows: pairs of pixels of which one is nearer, and a camera that does not move."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from scopemap.input.camera_files.reading import stated_calibration
from scopemap.result.result import Result

_PAIR_PX = 2  # a pixel's depth is the median of those so near


def pairs_in_order(run: Result, file: Path) -> tuple[int, int]:
    """Return how many pairs of pixels a run's depth has in the right order, and of how many.

    A row of the CSV file is a pair: `frame`, and `x_near`, `y_near`, `x_far`, `y_far`, shares of the width and height
    of the video's frame. A pair without depth is not in order.
    """
    with file.open(encoding="utf-8") as opened:
        rows = list(csv.DictReader(opened))
    depths = {index: run.depth.read(index) for index in {int(row["frame"]) for row in rows}}
    right = 0
    for row in rows:
        depth_mm = depths[int(row["frame"])]
        near, far = (
            _depth_at(run, depth_mm, float(row[f"x_{end}"]), float(row[f"y_{end}"])) for end in ("near", "far")
        )
        right += near < far
    return right, len(rows)


def _depth_at(run: Result, depth_mm: np.ndarray | None, x: float, y: float) -> float:
    """Return the depth, mm, at a place of the video's frame, shares of width and height; NaN where it is unknown."""
    assert run.source_camera_file is not None
    if depth_mm is None:
        return float("nan")
    lens = stated_calibration(run.source_camera_file, (1, 1)).camera  # the file states its size
    ray = lens.unproject(np.array([[x * lens.width - 0.5, y * lens.height - 0.5]]))
    column, row = np.round(run.camera.project(ray)[0]).astype(int)
    if not (0 <= row < depth_mm.shape[0] and 0 <= column < depth_mm.shape[1]):
        return float("nan")
    near = depth_mm[max(row - _PAIR_PX, 0) : row + _PAIR_PX + 1, max(column - _PAIR_PX, 0) : column + _PAIR_PX + 1]
    return float(np.nanmedian(near)) if np.isfinite(near).any() else float("nan")


def drift(run: Result) -> float:
    """Return the largest distance between two positions of a camera at rest, as a share of the median depth."""
    inside = run.frames.submap == 0
    positions_mm = run.frames["T_world_camera"][inside][:, :3, 3]
    depth_mm = run.depth.read(int(run.frames["index"][inside][0]))
    assert depth_mm is not None  # every frame of a result has depth
    return float(np.linalg.norm(positions_mm[:, None] - positions_mm, axis=-1).max() / np.nanmedian(depth_mm))
