"""Which frame each triangle takes its texture from: few views, chosen one after the other by what they add.

A view shows a triangle where nothing is in front of it, where the frame's mask allows its pixels with some distance
from the mask's border, and where the picture has the colours of the surface, which are means of many frames. Of such
views the sharp and frontal ones from near are better. The energy of Waechter, Moehrle and Goesele ("Let there be
color!", ECCV 2014) weighs such a quality against seams. Here the few views and a smooth quality keep seams few.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import scipy.sparse as sparse
import trimesh

from scopemap.engine.frame import Frame
from scopemap.engine.geometry.mesh_faces import connected_parts
from scopemap.engine.geometry.rendering import Rendering, render_mesh
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.models.device import cpu_threads

_BORDER = 1 / 100  # by hand: of the picture's width, that is left out along borders of the mask
_HIDDEN = 1.02  # by hand: a vertex farther than what is rendered at its pixel by this factor is hidden
# Beside the edge of what is nearer by this factor a small error of the pose shows the wrong one of both.
_DEPTH_EDGE = 1.1  # by hand
_LEAST_COSINE = 0.1  # by hand: of the incidence; flatter views smear
_OTHER_COLOUR = 0.5  # by hand: ln of the ratio to the surface's colour, from which on the picture shows something else
_COLOUR_BLUR = 1 / 60  # by hand: window, of the width: about two voxels, the detail of the surface's colours
_LIGHT_BLUR = 1 / 3  # by hand: window, of the width: of the light, which is no contradiction
_STEP_PX = 2  # by hand, for time: between the pixels whose colours are compared
_LEAST_LEVEL = 8.0  # by hand: darker levels are noise
# Views are added while one adds this share of the surface that any view shows. Chosen on the four clips of
# `scopemap_bench.scripts.texture`: less adds seams, more leaves parts blurred.
_LEAST_ADDED = 0.01
MOST_VIEWS = 16
"""Most views of a texture: their pictures are in memory one at a time, their pieces all at once."""
_SMOOTHED = 12  # by hand: rounds in which the quality of a triangle is averaged with its neighbours'
_SMALLEST_PIECE = 40  # by hand: triangles; smaller pieces join a neighbour
_DUST = 4  # by hand: triangles; smaller pieces that no neighbour's view shows are left out: a chart costs more


def choose_views(mesh: trimesh.Trimesh, frames: Iterable[Frame]) -> tuple[list[int], np.ndarray]:
    """Return which frames the texture of a mesh is taken from, and of which of these each triangle takes its own.

    mesh : world mm, with vertex colours that are the tissue's own (`fusion/albedo.py`). frames : with pose and mask, of
    the surface alone. Returns numbers of frames, the most useful first, and (F,) int32, places in that list, -1: none
    shows the triangle.
    """
    corners, areas_mm2 = np.asarray(mesh.vertices)[mesh.faces], np.asarray(mesh.area_faces)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles = _Triangles(areas_mm2, corners.mean(axis=1), normals, np.linalg.norm(normals, axis=1))
    label, candidates = np.full(len(mesh.faces), -1, np.int32), list(frames)
    if not candidates or not len(mesh.faces):
        return [], label
    # Kernels, OpenCV and arithmetic of whole pictures run without Python's lock.
    with ThreadPoolExecutor(cpu_threads()) as pool:
        quality = np.stack(list(pool.map(partial(_quality, mesh, triangles), candidates)), axis=1)
    # Relative to the best view of each triangle: otherwise the nearest part alone would count.
    quality /= np.maximum(quality.max(axis=1, keepdims=True), np.float32(1e-9))
    chosen = _greedy(quality, areas_mm2)
    label = _labels(quality[:, chosen], np.asarray(mesh.face_adjacency))
    used = np.unique(label[label >= 0])
    place = np.full(len(chosen) + 1, -1, np.int32)
    place[used] = np.arange(len(used))
    return [candidates[chosen[one]].index for one in used], place[label]


class _Triangles(NamedTuple):
    """Areas (F,) and middles (F, 3) of triangles, mm; normals (F, 3) of any length, and their lengths (F,)."""

    areas_mm2: np.ndarray
    middles: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray


def _quality(mesh: trimesh.Trimesh, triangles: _Triangles, frame: Frame) -> np.ndarray:
    """Return what a frame is worth as texture of each triangle, (F,) float32: px per mm, times the frame's quality."""
    assert frame.T_world_camera is not None
    rendering = render_mesh(mesh, frame.camera, frame.T_world_camera)
    usable = usable_pixels(frame, rendering)
    in_camera = transform(inverse(frame.T_world_camera), np.asarray(mesh.vertices))
    pixels = frame.camera.project(in_camera)
    # Column by column: numpy reduces axes of two or three numbers slowly.
    x, y = np.moveaxis(pixels, -1, 0)
    seen = np.isfinite(x) & np.isfinite(y)
    column, row = (np.rint(np.where(seen, one, -1.0)).astype(int) for one in (x, y))
    seen &= (column >= 0) & (row >= 0) & (column < frame.camera.width) & (row < frame.camera.height)
    column, row = np.where(seen, column, 0), np.where(seen, row, 0)
    # Of the pixels around: on a steep surface depth changes from one to the next.
    in_front = cv2.dilate(np.nan_to_num(rendering.depth_mm, nan=np.inf), np.ones((3, 3), np.uint8))[row, column]
    seen &= usable[row, column] & (in_camera[:, 2] <= _HIDDEN * in_front)
    a, b, c = np.asarray(mesh.faces).T
    ux, uy, vx, vy = x[b] - x[a], y[b] - y[a], x[c] - x[a], y[c] - y[a]
    with np.errstate(invalid="ignore", divide="ignore"):
        per_mm = np.sqrt(np.abs(ux * vy - uy * vx) / 2 / triangles.areas_mm2)
    to_camera = frame.T_world_camera[:3, 3] - triangles.middles
    length = triangles.lengths * np.linalg.norm(to_camera, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", triangles.normals, to_camera)) / np.maximum(length, 1e-12)
    shown = seen[a] & seen[b] & seen[c] & (cosine > _LEAST_COSINE) & np.isfinite(per_mm)
    return np.where(shown, per_mm * max(frame.quality, 0.05), 0).astype(np.float32)


def usable_pixels(frame: Frame, rendering: Rendering) -> np.ndarray:
    """Return the pixels (H, W) bool of a frame that may give texture to the surface which is rendered from its pose.

    Borders of the mask and of the picture are left out, the farther side of depth edges, and what has other colours
    than the surface: instruments and highlights that no mask knows.
    """
    width = frame.camera.width
    border = max(1, round(_BORDER * width))
    nearest = cv2.erode(np.nan_to_num(rendering.depth_mm, nan=1e9), np.ones((2 * border + 1,) * 2, np.uint8))
    with np.errstate(invalid="ignore"):
        behind = rendering.depth_mm > _DEPTH_EDGE * nearest
    usable = frame.valid & ~_other_colours(frame, rendering)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * border + 1,) * 2)
    eroded = cv2.erode(usable.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return (eroded > 0) & ~behind


def _other_colours(frame: Frame, rendering: Rendering) -> np.ndarray:
    """Return the pixels (H, W) bool whose colours contradict the surface's, but for smooth light."""
    some = (slice(None, None, _STEP_PX),) * 2
    all_known = (frame.valid & np.isfinite(rendering.depth_mm)).astype(np.float32)
    known = all_known[some]
    if not known.any():
        return np.zeros_like(frame.valid)
    width = known.shape[1]
    ratios = np.zeros((*known.shape, 3), np.float32)
    for picture, sign in ((frame.rgb, 1), (rendering.rgb, -1)):
        levels = np.log(np.maximum(picture, _LEAST_LEVEL).astype(np.float32))
        small = _mean(levels, all_known, _STEP_PX)[some]
        ratios += sign * _mean(small, known, max(1, round(_COLOUR_BLUR * width)))
    ratios -= _mean(ratios, known, round(_LIGHT_BLUR * width))
    red, green, blue = cv2.split(np.abs(ratios))
    found = (np.maximum(np.maximum(red, green), blue) > _OTHER_COLOUR) & (known > 0)
    size = frame.camera.width, frame.camera.height
    return cv2.resize(found.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _mean(values: np.ndarray, known: np.ndarray, window_px: int) -> np.ndarray:
    """Return the local mean of values (H, W, 3) over the known pixels (H, W) float32."""
    window = (max(1, window_px),) * 2
    mean = cv2.blur(values * cv2.cvtColor(known, cv2.COLOR_GRAY2RGB), window)
    share = np.maximum(cv2.blur(known, window), np.float32(1e-6))
    return np.asarray(mean / cv2.cvtColor(share, cv2.COLOR_GRAY2RGB))


def _greedy(quality: np.ndarray, areas_mm2: np.ndarray) -> list[int]:
    """Return the columns of quality (F, N), 0..1, that add most to those before, weighted by areas (F,)."""
    best, chosen = np.zeros(len(quality), np.float32), list[int]()
    weight = areas_mm2.astype(np.float32)
    least = _LEAST_ADDED * float(weight @ quality.max(axis=1))
    while len(chosen) < min(MOST_VIEWS, quality.shape[1]):
        added = weight @ np.maximum(quality - best[:, None], 0)
        place = int(np.argmax(added))
        if added[place] <= least:
            break
        chosen.append(place)
        best = np.maximum(best, quality[:, place])
    return chosen


def _labels(quality: np.ndarray, adjacent: np.ndarray) -> np.ndarray:
    """Return the best column of quality (F, K) of each triangle, (F,) int32, in large pieces; -1: all are 0.

    adjacent : pairs of triangles (E, 2).
    """
    label = np.full(len(quality), -1, np.int32)
    if not quality.shape[1]:
        return label
    shows, smooth = quality > 0, quality
    mean = _mean_of_neighbours(len(quality), adjacent)
    # A triangle that a view does not show says nothing about the view's worth beside it.
    known = np.maximum(mean @ shows.astype(np.float32), np.float32(1e-6))
    for _ in range(_SMOOTHED):
        smooth = (mean @ smooth) / known * shows
    some = shows.any(axis=1)
    label[some] = np.argmax(np.where(shows, smooth, -1.0)[some], axis=1)
    return _joined(label, shows, adjacent)


def _mean_of_neighbours(count: int, adjacent: np.ndarray) -> sparse.csr_array:
    one, other = adjacent.T
    rows, columns = np.concatenate([one, other, np.arange(count)]), np.concatenate([other, one, np.arange(count)])
    return sparse.csr_array((np.ones(len(rows), np.float32), (rows, columns)), shape=(count, count))


def _joined(label: np.ndarray, shows: np.ndarray, adjacent: np.ndarray) -> np.ndarray:
    """Return labels (F,) whose small pieces have, where a neighbour's view shows them, the label of that."""
    for smallest in (_SMALLEST_PIECE // 8, _SMALLEST_PIECE // 2, _SMALLEST_PIECE):
        piece, count = pieces_of(label, adjacent)
        is_small = (np.bincount(piece, minlength=count) < smallest)[piece]
        left, right = adjacent[label[adjacent[:, 0]] != label[adjacent[:, 1]]].T
        inner, outer = np.concatenate([left, right]), np.concatenate([right, left])
        at = is_small[inner] & (label[inner] >= 0) & (label[outer] >= 0)
        inner, outer = inner[at], outer[at]
        # How often each view is next to each piece, and how many of the piece's triangles it shows.
        views = shows.shape[1]
        beside = np.bincount(piece[inner] * views + label[outer], minlength=count * views).reshape(count, views)
        sizes = np.bincount(piece, minlength=count)
        shown = np.stack([np.bincount(piece, shows[:, view], count) for view in range(views)], axis=1)
        score = np.where(shown >= sizes[:, None], beside, 0)
        best = np.argmax(score, axis=1).astype(np.int32)
        changes = is_small & (score.max(axis=1) > 0)[piece] & (label >= 0)
        label = np.where(changes, best[piece], label)
    piece, count = pieces_of(label, adjacent)
    return np.where((np.bincount(piece, minlength=count) < _DUST)[piece], np.int32(-1), label)


def pieces_of(label: np.ndarray, adjacent: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the number of the connected piece of one label (F,) that each triangle is in, (F,), and their count."""
    return connected_parts(adjacent[label[adjacent[:, 0]] == label[adjacent[:, 1]]], len(label))


def spread(numbers: Sequence[int], quality: Sequence[float], most: int) -> list[int]:
    """Return at most so many of the ascending numbers, spread over all, of each part the one with the best quality."""
    parts = np.array_split(np.arange(len(numbers)), max(1, min(most, len(numbers))))
    return [numbers[part[int(np.argmax(np.asarray(quality)[part]))]] for part in parts if len(part)]
