"""The texture of a surface: pieces of the video's own frames, at the video's resolution, in one picture.

A piece, a chart, is what one frame shows of connected triangles, without any resampling, so that vessels stay as sharp
as in the frame. `fusion/texture_views.py` chooses the frames, `fusion/texture_levels.py` evens the brightness, and
rectpack places the charts in the picture. What no frame shows has the colours of the vertices there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from PIL import Image
from rectpack import SORT_LSIDE, GuillotineBssfSas, PackingBin, PackingMode, newPacker

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.texture_alignment import shifts_px
from scopemap.engine.fusion.texture_levels import ChartVertices, chart_vertices, level_gains
from scopemap.engine.fusion.texture_views import pieces_of
from scopemap.engine.geometry.kernels import Float32_3d, Float64_3d, Int32_2d, UInt8_2d, UInt8_3d, kernel
from scopemap.engine.geometry.mesh_faces import without_unused
from scopemap.engine.geometry.rendering import vertex_colours
from scopemap.engine.geometry.se3 import inverse, transform
from scopemap.engine.models.device import cpu_threads

LARGEST_PX = 4096
"""Largest side of a texture: what every graphics card of the last ten years shows (WebGL 2 on phones, too)."""
_BLEED_PX = 4  # by hand: around each chart its border goes on, for a viewer that shrinks the texture by up to 4
_CELL_PX = 4  # what linear interpolation at the three corners of a cell of 1 px looks at, and a pixel around it
MOST_UNSEEN = LARGEST_PX**2 // (2 * _CELL_PX**2)
"""Most triangles without a view: the cells of more would leave too little of the largest texture for the charts."""
_GROWN = 1.06  # by hand: of the texture's side, from one attempt to place all charts to the next
_SHRUNK = 0.85  # by hand: of the pictures, where charts do not fit into the largest texture
_SMALLEST_PX = 64  # by hand: side of the smallest texture
_SAMPLE_SHARE = 0.5  # by hand: sigma of the mean of levels at a vertex, over the median edge
_MOST_SAMPLES = 30_000  # OpenCV's remap takes fewer than 32767 in a row
_OUTSIDE = -1e-6  # rounding: a pixel on the edge of two triangles belongs to both

_NOTHING = np.zeros((0, 0, 3), np.uint8)

Pictures = Callable[[Sequence[int], PinholeCamera], Iterable[tuple[int, np.ndarray]]]
"""Yields, for numbers of frames, each number with its picture, (H, W, 3) uint8 sRGB, as a camera sees it; any order."""


class _Layout(NamedTuple):
    """Where charts are.

    camera : of their pictures. pixels : (N, 2) of the charts' vertices there. first, size, place : (C, 2) int, of each
    chart, its first pixel there, width and height, and first pixel in the texture. cells : (U, 2) int, first pixels of
    the cells in the texture. extent : width and height of the texture.
    """

    camera: PinholeCamera
    pixels: np.ndarray
    first: np.ndarray
    size: np.ndarray
    place: np.ndarray
    cells: np.ndarray
    extent: tuple[int, int]


def textured_mesh(
    mesh: trimesh.Trimesh,
    label: np.ndarray,
    frames: Sequence[Frame],
    others: Sequence[Frame],
    pictures: Pictures,
    longest_px: int,
) -> trimesh.Trimesh:
    """Return the mesh with a texture; its triangles are those of `mesh`, in their order, vertices are split at seams.

    mesh : world mm, with vertex colours. label : (F,) int, the place in `frames` of the frame that each triangle takes
    its texture from, -1: none, as `choose_views` returns it. frames, others : with pose and mask; others that show the
    surface, by which those are aligned. longest_px : longer side of the video.
    The result has `trimesh.visual.TextureVisuals` with a material whose image is the texture, and vertex normals.
    """
    faces = np.asarray(mesh.faces)
    piece, _ = pieces_of(label, np.asarray(mesh.face_adjacency))
    some, chart = label >= 0, np.full(len(faces), -1)
    _, chart[some] = np.unique(piece[some], return_inverse=True)
    places = chart_vertices(faces, chart)
    view = np.zeros(int(chart.max(initial=-1)) + 1, int)
    view[chart[some]] = label[some]
    pixels = _shown_at(mesh, places, view, frames, others)
    layout = _placed(pixels, places.chart, frames[0].camera, longest_px, int((~some).sum()))
    colours = vertex_colours(mesh)[:, :3][places.vertex].astype(np.float32)
    crops, shown = _cut(layout, places, view, frames, pictures)
    gains = level_gains(places, shown, colours)
    width, height = layout.extent
    texture = np.zeros((height, width, 3), np.uint8)
    by_chart = np.argsort(chart, kind="stable")
    ends = np.searchsorted(chart[by_chart], np.arange(len(crops) + 1))

    def paint(number: int) -> None:
        corners = places.of_corner[by_chart[ends[number] : ends[number + 1]]]
        at = layout.pixels[corners] - layout.first[number]
        (x, y), (across, down) = layout.place[number], layout.size[number]
        texture[y : y + down, x : x + across] = _painted(crops[number], at, gains[corners])
        crops[number] = _NOTHING  # all of them take as much memory as the texture

    # Most of it runs without Python's lock, and charts do not overlap.
    with ThreadPoolExecutor(cpu_threads()) as pool:
        list(pool.map(paint, range(len(crops))))
    uv = np.zeros((len(faces), 3, 2))
    inside = chart[some]
    uv[some] = layout.pixels[places.of_corner[some]] + (layout.place - layout.first)[inside][:, None]
    uv[~some] = _draw_cells(texture, layout.cells, colours[places.of_corner[~some]])
    return _split(mesh, places, chart, (uv + 0.5) / [width, height], texture)


def _shown_at(
    mesh: trimesh.Trimesh, places: ChartVertices, view: np.ndarray, frames: Sequence[Frame], others: Sequence[Frame]
) -> np.ndarray:
    """Return where the frames show the vertices of their charts, (N, 2), px of the frames."""
    pixels, vertices = np.zeros((len(places.vertex), 2)), np.asarray(mesh.vertices)
    for number, (frame, shift_px) in enumerate(zip(frames, shifts_px(mesh, frames, others), strict=True)):
        assert frame.T_world_camera is not None
        own = np.flatnonzero((places.chart >= 0) & (view[places.chart] == number))
        at = frame.camera.project(transform(inverse(frame.T_world_camera), vertices[places.vertex[own]]))
        pixels[own] = at + _sampled(shift_px, at)
    return pixels


def _sampled(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return an image (H, W, C) float32 or uint8 at pixels (N, 2), (N, C), between pixels linear."""
    parts = np.array_split(at.astype(np.float32), -(-max(len(at), 1) // _MOST_SAMPLES))
    found = [
        cv2.remap(image, part[:, :1], part[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in parts
        if len(part)
    ]
    return np.concatenate(found)[:, 0] if found else np.zeros((0, image.shape[2]), image.dtype)


def _placed(pixels: np.ndarray, chart: np.ndarray, working: PinholeCamera, longest_px: int, unseen: int) -> _Layout:
    """Place all charts, and a cell for each unseen triangle, in the smallest texture; shrink the pictures if needed.

    pixels : (N, 2) of the charts' vertices in pictures of the working camera. chart : (N,).
    """
    free, count = chart >= 0, int(chart.max(initial=-1)) + 1
    columns = int(np.ceil(np.sqrt(unseen)))
    cells = np.array([_CELL_PX * columns, _CELL_PX * int(np.ceil(unseen / max(columns, 1)))])
    scale = longest_px / max(working.width, working.height)
    while True:
        camera = working.resized(round(scale * working.width), round(scale * working.height))
        at = (pixels + 0.5) * [camera.width / working.width, camera.height / working.height] - 0.5
        low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
        np.minimum.at(low, chart[free], at[free])
        np.maximum.at(high, chart[free], at[free])
        first = np.floor(low).astype(int) - _BLEED_PX
        size = np.ceil(high).astype(int) + _BLEED_PX + 1 - first
        packed = _packed(np.concatenate([size, cells[None]]) if unseen else size)
        if packed is not None:
            place, extent = packed
            grid = np.stack(np.divmod(np.arange(unseen), max(columns, 1))[::-1], axis=1) * _CELL_PX
            return _Layout(camera, at, first, size, place[:count], grid + (place[-1] if unseen else 0), extent)
        scale *= _SHRUNK


def _packed(sizes: np.ndarray) -> tuple[np.ndarray, tuple[int, int]] | None:
    """Return places (C, 2) of rectangles of sizes (C, 2), px, in a small one, and its width and height.

    None: they do not fit into `LARGEST_PX`.
    """
    least = max(_SMALLEST_PX, int(sizes.max()), int(_GROWN * np.sqrt(np.prod(sizes, axis=1).sum())))
    side = min(least, LARGEST_PX)
    if least > LARGEST_PX:
        return None
    while True:
        # A third of the time of skylines on 900 charts, and the same side.
        packer = newPacker(PackingMode.Offline, PackingBin.BFF, GuillotineBssfSas, SORT_LSIDE, rotation=False)
        packer.add_bin(side, side)
        for number, (width, height) in enumerate(sizes.tolist()):
            packer.add_rect(width, height, number)
        packer.pack()
        if len(packer.rect_list()) == len(sizes):
            place = np.zeros((len(sizes), 2), int)
            for _, x, y, _, _, number in packer.rect_list():
                place[number] = x, y
            width, height = (place + sizes).max(axis=0).tolist()
            return place, (width, height)
        if side == LARGEST_PX:
            return None
        side = min(int(_GROWN * side) + 1, LARGEST_PX)


def _cut(
    layout: _Layout, places: ChartVertices, view: np.ndarray, frames: Sequence[Frame], pictures: Pictures
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return what the pictures show of each chart, (h, w, 3) uint8, and at the charts' vertices, (N, 3) levels.

    A picture is forgotten before the next one is read.
    """
    crops = [_NOTHING] * len(view)
    shown = np.zeros((len(places.vertex), 3), np.float32)
    number_of = {frame.index: number for number, frame in enumerate(frames)}
    corners = layout.pixels[places.of_corner[places.chart[places.of_corner[:, 0]] >= 0]]
    edge_px = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1))) if len(corners) else 1.0
    for index, picture in pictures([frame.index for frame in frames], layout.camera):
        number = number_of[index]
        # The mean around a vertex needs no full resolution.
        small = max(1, round(_SAMPLE_SHARE * edge_px))
        mean = cv2.resize(picture, (picture.shape[1] // small, picture.shape[0] // small), interpolation=cv2.INTER_AREA)
        own = np.flatnonzero((places.chart >= 0) & (view[places.chart] == number))
        shares = np.array(mean.shape[1::-1]) / picture.shape[1::-1]
        shown[own] = _sampled(cv2.GaussianBlur(mean, (0, 0), 1.0), (layout.pixels[own] + 0.5) * shares - 0.5)
        for chart in np.flatnonzero(view == number):
            (x, y), (width, height) = layout.first[chart], layout.size[chart]
            columns = np.clip(np.arange(x, x + width), 0, picture.shape[1] - 1)
            rows = np.clip(np.arange(y, y + height), 0, picture.shape[0] - 1)
            inside = picture[max(y, 0) : y + height, max(x, 0) : x + width]
            is_whole = min(x, y) >= 0 and inside.shape[:2] == (height, width)
            crops[chart] = inside.copy() if is_whole else picture[rows[:, None], columns]
    return crops, shown


def _painted(crop: np.ndarray, corners: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return a chart (h, w, 3) uint8: its triangles with their gains; outside of them the colour of the nearest pixel.

    corners : (F, 3, 2), px in the crop. gains : (F, 3, 3), of each corner by colour.
    """
    levels, covered = np.zeros(crop.shape, np.uint8), np.zeros(crop.shape[:2], np.uint8)
    _paint(crop, corners, gains, levels, covered)
    if not covered.any():  # thinner than a pixel: nothing of it shows
        return crop
    nearest = cv2.distanceTransformWithLabels(1 - covered, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    _fill_gaps(levels, covered, np.asarray(nearest), int(nearest.max()))
    return levels


@kernel
def _paint(crop: UInt8_3d, corners: Float64_3d, gains: Float32_3d, levels: UInt8_3d, covered: UInt8_2d) -> None:
    """Multiply the pixels inside of triangles (F, 3, 2) by their gains, linear inside each. Changes the last two."""
    height, width = covered.shape
    for face in range(len(corners)):
        ua, va = corners[face, 0, 0], corners[face, 0, 1]
        ub, vb = corners[face, 1, 0], corners[face, 1, 1]
        uc, vc = corners[face, 2, 0], corners[face, 2, 1]
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0:
            continue
        first_row, last_row = int(max(0, np.ceil(min(va, vb, vc)))), int(min(height - 1, np.floor(max(va, vb, vc))))
        first_col, last_col = int(max(0, np.ceil(min(ua, ub, uc)))), int(min(width - 1, np.floor(max(ua, ub, uc))))
        for row in range(first_row, last_row + 1):
            for col in range(first_col, last_col + 1):
                at_a = ((ub - col) * (vc - row) - (vb - row) * (uc - col)) / area
                at_b = ((uc - col) * (va - row) - (vc - row) * (ua - col)) / area
                at_c = 1.0 - at_a - at_b
                if at_a < _OUTSIDE or at_b < _OUTSIDE or at_c < _OUTSIDE:
                    continue
                covered[row, col] = 1
                for channel in range(3):
                    gain = (
                        at_a * gains[face, 0, channel] + at_b * gains[face, 1, channel] + at_c * gains[face, 2, channel]
                    )
                    level = np.rint(np.float32(crop[row, col, channel] * gain))
                    levels[row, col, channel] = min(abs(level), 255)


@kernel
def _fill_gaps(levels: UInt8_3d, covered: UInt8_2d, nearest: Int32_2d, count: int) -> None:
    """Give each pixel that is not covered the colour of the nearest one that is: `nearest` numbers these 1 to count."""
    height, width = covered.shape
    place = np.zeros((count + 1, 2), np.int32)
    for row in range(height):
        for col in range(width):
            if covered[row, col]:
                place[nearest[row, col], 0], place[nearest[row, col], 1] = row, col
    for row in range(height):
        for col in range(width):
            if not covered[row, col]:
                number = nearest[row, col]
                for channel in range(3):
                    levels[row, col, channel] = levels[place[number, 0], place[number, 1], channel]


def _draw_cells(texture: np.ndarray, cells: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Draw a cell for each of some triangles, changing the texture; return their corners (U, 3, 2), px in the texture.

    cells : (U, 2), first pixels. colours : (U, 3, 3), of each corner; linear interpolation between three pixels is what
    vertex colours look like.
    """
    across, down = (colours[:, 1] - colours[:, 0])[:, None, None], (colours[:, 2] - colours[:, 0])[:, None, None]
    steps = np.arange(_CELL_PX) - 1.0
    levels = colours[:, None, None, 0] + steps[:, None, None] * down + steps[:, None] * across
    row, column = cells[:, 1, None, None] + np.arange(_CELL_PX)[:, None], cells[:, 0, None, None] + np.arange(_CELL_PX)
    texture[row, column] = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    found: np.ndarray = cells[:, None] + np.array([[1, 1], [2, 1], [1, 2]])
    return found


def _split(
    mesh: trimesh.Trimesh, places: ChartVertices, chart: np.ndarray, uv: np.ndarray, texture: np.ndarray
) -> trimesh.Trimesh:
    """Return the mesh with its vertices split. uv : (F, 3, 2), 0..1, of the corners, from the texture's upper left."""
    faces = places.of_corner.copy()
    unseen = chart < 0
    vertex, count = [places.vertex], len(places.vertex)
    # Triangles that no view shows have cells, and so vertices, of their own.
    faces[unseen] = count + np.arange(3 * int(unseen.sum())).reshape(-1, 3)
    vertex.append(np.asarray(mesh.faces)[unseen].ravel())
    uv_of = np.zeros((count + len(vertex[1]), 2))
    uv_of[faces] = uv
    used, packed = without_unused(faces, len(uv_of))
    of_mesh = np.concatenate(vertex)[used]
    at = uv_of[used] * [1, -1] + [0, 1]  # trimesh counts from the lower left
    material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(texture))
    return trimesh.Trimesh(
        np.asarray(mesh.vertices)[of_mesh],
        packed,
        vertex_normals=np.asarray(mesh.vertex_normals)[of_mesh],
        visual=trimesh.visual.TextureVisuals(uv=at, material=material),
        process=False,
    )
