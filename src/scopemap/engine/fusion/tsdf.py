"""The truncated signed distance field (TSDF): sparse voxel blocks, and the kernels that fuse a frame into them.

The field holds the distance to the surface in mm: positive in free space (the camera's side), negative behind the
surface, clipped to the truncation. Weighted running mean of Curless and Levoy, SIGGRAPH 1996, eq. 3-4; blocks of 8^3
voxels as Niessner et al., SIGGRAPH Asia 2013. Inverse depth is used throughout because it is linear in the pixel on a
plane: interpolated and differentiated, a slanted wall stays exact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from scopemap.engine.geometry.kernels import (
    Float32_2d,
    Float32_3d,
    Float32_4d,
    Float32_5d,
    Float64_1d,
    Float64_2d,
    Int64_1d,
    Int64_2d,
    inner_kernel,
    kernel,
)

BLOCK = 8  # voxels along an edge of a block: 8, as Niessner et al. 2013 hash them
_VOXELS = BLOCK**3
# 21 bits of a key for each block coordinate.
KEY_OFFSET = 1 << 20
_KEY_MASK = (1 << 21) - 1  # 21 bits for each of three numbers of a block
_RECENT = 1 << 15  # by hand, for time: entries of the table of blocks met last; a power of two
_PIECES = 16  # by hand, for time: of a ray, whose last blocks are remembered
_FEW_KEYS = 1 << 14  # by hand, for time: more need a second attempt
_F32 = np.float32
_SLOPE_STEP_PX = 3  # by hand: pixels to either side from which a slope is measured
_COLOUR_BAND_VOXELS = 2.0  # by hand: colours are integrated so near to the surface


class Voxels(NamedTuple):
    """N blocks: `tsdf` mm and `weight` (N, 8, 8, 8) float32; `colour` (N, 8, 8, 8, 4), weighted sums r g b 1."""

    tsdf: Float32_4d
    weight: Float32_4d
    colour: Float32_5d


class TsdfCamera(NamedTuple):
    """A pinhole camera in the world: rotation (3, 3) and translation (3,) mm from world to camera, focal lengths px."""

    R: Float64_2d
    t: Float64_1d
    fx: float
    fy: float
    cx: float
    cy: float


class MeasuredSurface(NamedTuple):
    """What a frame measures, (H, W) float32: inverse depth 1/mm or NaN; tangent plane's distance, mm; weight 0..1."""

    inverse_depth: Float32_2d
    plane_mm: Float32_2d
    weight: Float32_2d


class Grid(NamedTuple):
    """Voxel size and truncation in mm, and the largest relative change of depth per px that is one surface.

    The truncation at a pixel is the larger one of `truncation_mm` and `truncation_share` of its depth.
    full_weight_share : share of the truncation behind the surface from which on a voxel counts less and less.
    """

    voxel_mm: float
    truncation_mm: float
    largest_step: float
    truncation_share: float = 0.0
    full_weight_share: float = 0.2


@inner_kernel
def _slope(before: np.float32, here: np.float32, after: np.float32, most: np.float32) -> np.float32:
    """Change of inverse depth per px, mean of the sides that change by up to `most`; NaN where neither does."""
    back, ahead = here - before, after - here
    is_back, is_ahead = abs(back) <= most, abs(ahead) <= most
    total = (back if is_back else _F32(0)) + (ahead if is_ahead else _F32(0))
    return total / ((_F32(is_back) + _F32(is_ahead)) * _F32(_SLOPE_STEP_PX))


@kernel
def measure_surface(
    inverse_depth: Float32_2d, camera: TsdfCamera, largest_step: float, min_incidence: float, max_depth_mm: float
) -> MeasuredSurface:
    """Return tangent plane and weight of every pixel of `inverse_depth` (H, W) float32, 1/mm, NaN = unknown.

    On the plane n.X = 1 the inverse depth is n.(x, y, 1), so its slopes give n, and 1/|n| is the plane's distance from
    the camera. Weight = cos(incidence) / (1 + (2 distance / max_depth)^2): 1 for a frontal surface at the lens,
    falling with the square of the distance. Pixels without a slope or with cos(incidence) < `min_incidence` become NaN.
    """
    height, width = inverse_depth.shape
    planes = np.empty((3, height, width), np.float32)
    kept, plane_mm, weight = planes[0], planes[1], planes[2]
    # In single precision and without branches, so that it is compiled to vector instructions: an eighth of the time.
    fx, fy, cx, cy = _F32(camera.fx), _F32(camera.fy), _F32(camera.cx), _F32(camera.cy)
    share, least, nearness = _F32(_SLOPE_STEP_PX * largest_step), _F32(min_incidence), _F32(2.0 / max_depth_mm)
    step, nan = _SLOPE_STEP_PX, _F32(np.nan)
    for row in range(height):
        y = (_F32(row) - cy) / fy
        for col in range(width):
            here, x = inverse_depth[row, col], (_F32(col) - cx) / fx
            left = inverse_depth[row, col - step] if col >= step else nan
            right = inverse_depth[row, col + step] if col + step < width else nan
            above = inverse_depth[row - step, col] if row >= step else nan
            below = inverse_depth[row + step, col] if row + step < height else nan
            nx, ny = fx * _slope(left, here, right, share * here), fy * _slope(above, here, below, share * here)
            nz = here - nx * x - ny * y
            plane = _F32(1) / np.sqrt(nx * nx + ny * ny + nz * nz)
            distance = np.sqrt(x * x + y * y + _F32(1)) / here
            far = nearness * distance
            is_kept = here > 0 and plane >= least * distance
            kept[row, col] = here if is_kept else nan
            plane_mm[row, col] = plane if is_kept else _F32(0)
            weight[row, col] = plane / distance / (_F32(1) + far * far) if is_kept else _F32(0)
    return MeasuredSurface(kept, plane_mm, weight)


@inner_kernel
def pack(x: int, y: int, z: int) -> int:
    """Return the int64 key of a block coordinate."""
    return ((x + KEY_OFFSET) << 42) | ((y + KEY_OFFSET) << 21) | (z + KEY_OFFSET)


def unpack(keys: np.ndarray) -> np.ndarray:
    """Return the (N, 3) int64 block coordinates of (N,) keys."""
    return np.stack([(keys >> 42) & _KEY_MASK, (keys >> 21) & _KEY_MASK, keys & _KEY_MASK], -1) - KEY_OFFSET


@inner_kernel
def _depth_ranges(inverse_depth: np.ndarray, largest_step: float) -> np.ndarray:
    """Return the nearest and the farthest depth of each 2 by 2 pixels, (4, rows, columns, 2), mm; 0: none."""
    height, width = inverse_depth.shape
    ranges = np.zeros((4, (height + 1) // 2, (width + 1) // 2, 2))
    for row in range(ranges.shape[1]):
        for col in range(ranges.shape[2]):
            low, high = np.inf, 0.0
            for n in range(4):
                i, j = 2 * row + n // 2, 2 * col + n % 2
                if i < height and j < width and inverse_depth[i, j] > 0:
                    low, high = min(low, inverse_depth[i, j]), max(high, inverse_depth[i, j])
                    ranges[n, row, col] = 1.0 / inverse_depth[i, j]
            if 0 < high <= (1.0 + 2.0 * largest_step) * low:
                ranges[:, row, col] = 0.0
                ranges[0, row, col, 0], ranges[0, row, col, 1] = 1.0 / high, 1.0 / low
    return ranges


def touched_blocks(inverse_depth: np.ndarray, camera: TsdfCamera, grid: Grid) -> np.ndarray:
    """Return keys, some of them repeated, of all blocks within the truncation of a measured pixel (H, W).

    The rays of 2 by 2 pixels are cut into pieces of half a block; the box around a piece, widened by the footprint of
    these pixels, names the blocks: no voxel that the frame can see near the surface is missed.
    """
    # By the middle of four pixels, col and row of 2 by 2, to the blocks: origin and direction of a ray, in voxels.
    centre_x, centre_y = (0.5 - camera.cx) / camera.fx, (0.5 - camera.cy) / camera.fy
    by_pixel = np.array([[2 / camera.fx, 0, centre_x], [0, 2 / camera.fy, centre_y], [0, 0, 1]])
    rays = np.column_stack([camera.R.T @ by_pixel, -camera.R.T @ camera.t]) / grid.voxel_mm
    # From the middle of the four pixels to the corner of one of them.
    footprint = 1.5 / min(camera.fx, camera.fy) / grid.voxel_mm
    keys = np.empty(_FEW_KEYS, np.int64)
    while (count := _touched_blocks(keys, inverse_depth, rays, footprint, grid)) > len(keys):
        keys = np.empty(count, np.int64)
    return keys[:count]


@kernel
def _touched_blocks(keys: Int64_1d, inverse_depth: Float32_2d, rays: Float64_2d, footprint: float, grid: Grid) -> int:
    """Put the keys of the touched blocks into `keys`, as many as it holds; return how many there are.

    rays : (3, 4), directions and origin of the rays of 2 by 2 pixels, in voxels. footprint : of these per mm of depth.
    """
    block_mm, truncation_mm, share = BLOCK * grid.voxel_mm, grid.truncation_mm, grid.truncation_share
    # By piece: the first and the last block of the pixels before, which are most often these pixels' as well.
    recent, last_box, count = np.zeros(_RECENT, np.int64), np.zeros((_PIECES, 2), np.int64), 0
    low, high, ray = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    ranges = _depth_ranges(inverse_depth, grid.largest_step)
    for row in range(ranges.shape[1]):
        for n in range(4 * ranges.shape[2]):
            col = n // 4
            nearest, farthest = ranges[n % 4, row, col, 0], ranges[n % 4, row, col, 1]
            if nearest == 0:
                continue
            for axis in range(3):
                ray[axis] = rays[axis, 0] * col + rays[axis, 1] * row + rays[axis, 2]
            first_mm = nearest - max(truncation_mm, share * nearest)
            last_mm = farthest + max(truncation_mm, share * farthest)
            pieces = math.ceil(2.0 * (last_mm - first_mm) / block_mm)
            piece_mm = (last_mm - first_mm) / pieces
            for piece in range(pieces):
                near = max(first_mm + piece * piece_mm, 0.0)
                far = max(near, first_mm + (piece + 1) * piece_mm)
                for axis in range(3):
                    a, b = rays[axis, 3] + near * ray[axis], rays[axis, 3] + far * ray[axis]
                    low[axis] = math.floor(min(a, b) - footprint * far) >> 3
                    high[axis] = math.ceil(max(a, b) + footprint * far) >> 3
                first, last, box = pack(low[0], low[1], low[2]), pack(high[0], high[1], high[2]), piece % _PIECES
                if first == last_box[box, 0] and last == last_box[box, 1]:
                    continue
                last_box[box, 0], last_box[box, 1] = first, last
                for i in range(low[0], high[0] + 1):
                    for j in range(low[1], high[1] + 1):
                        for k in range(low[2], high[2] + 1):
                            key = pack(i, j, k)
                            place = (i * 73856093 ^ j * 19349663 ^ k * 83492791) & (_RECENT - 1)
                            if recent[place] != key:
                                recent[place] = key
                                if count < len(keys):
                                    keys[count] = key
                                count += 1
    return count


@inner_kernel
def _pixel_table(surface: MeasuredSurface, largest_step: float) -> np.ndarray:
    """Return what a voxel looks up at a pixel, (2, H W + 1, 4) float32; the last place is for voxels outside.

    First the inverse depth of the pixel, its right, its lower and its diagonal neighbour, the first NaN where they are
    not one surface; then its inverse depth, plane and weight.
    """
    inverse_depth, plane_mm, weight = surface.inverse_depth, surface.plane_mm, surface.weight
    height, width = inverse_depth.shape
    table = np.zeros((2, height * width + 1, 4), np.float32)
    table[0, :, 0] = np.nan
    for row in range(height):
        for col in range(width):
            a, place = inverse_depth[row, col], row * width + col
            table[1, place, 0], table[1, place, 1], table[1, place, 2] = a, plane_mm[row, col], weight[row, col]
            if row == height - 1 or col == width - 1:
                continue
            b, c, d = inverse_depth[row, col + 1], inverse_depth[row + 1, col], inverse_depth[row + 1, col + 1]
            low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            known = a > 0 and b > 0 and c > 0 and d > 0
            # A cell's diagonal is sqrt(2) px long.
            if known and high - low <= 1.5 * largest_step * low:
                table[0, place, 0], table[0, place, 1], table[0, place, 2], table[0, place, 3] = a, b, c, d
    return table


@inner_kernel
def _project(corner: np.ndarray, projection: np.ndarray, voxel_mm: float, at: np.ndarray) -> None:
    """Put into `at` (3, 512) column and row, px, each times depth, and depth, mm, of the voxels of a block."""
    p, z = projection, corner[2] * voxel_mm
    step_u, step_v, step_depth = voxel_mm * p[0, 2], voxel_mm * p[1, 2], voxel_mm * p[2, 2]
    for line in range(BLOCK * BLOCK):
        x, y = (corner[0] + line // BLOCK) * voxel_mm, (corner[1] + line % BLOCK) * voxel_mm
        first_u = p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]
        first_v = p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]
        first_depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
        for k in range(BLOCK):
            at[0, BLOCK * line + k] = first_u + k * step_u
            at[1, BLOCK * line + k] = first_v + k * step_v
            at[2, BLOCK * line + k] = first_depth + k * step_depth


@inner_kernel
def _locate(at: np.ndarray, places: np.ndarray, width: float, height: float) -> None:
    """Put into `places` (2, 512) where voxels look up their cell and their pixel; in `at`, the place in that cell."""
    last_row, last_col = max(height - 2.0, 0.0), max(width - 2.0, 0.0)
    for n in range(_VOXELS):
        depth = at[2, n]
        u, v = at[0, n] / depth, at[1, n] / depth
        inside = (depth > 0) & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
        u, v = u if inside else 0.0, v if inside else 0.0
        row, col = float(np.int32(v + 0.5)), float(np.int32(u + 0.5))
        places[1, n] = np.int32(row * width + col if inside else height * width)
        # Clamped, so that the outer half of a border pixel continues the cell inside it.
        above, left = float(np.int32(v)), float(np.int32(u))
        above, left = above if above < last_row else last_row, left if left < last_col else last_col
        places[0, n] = np.int32(above * width + left)
        at[0, n], at[1, n] = u - left, v - above


@inner_kernel
def _look_up(table: np.ndarray, places: np.ndarray, seen: np.ndarray) -> None:
    """Put into `seen` (7, 512) what voxels look up: four inverse depths of the cell; inverse depth, plane, weight."""
    for n in range(_VOXELS):
        cell, pixel = np.uint64(places[0, n]), np.uint64(places[1, n])
        # Read before they are written: the compiler does not know that the arrays are apart.
        a, b, c, d = table[0, cell, 0], table[0, cell, 1], table[0, cell, 2], table[0, cell, 3]
        inverse_depth, plane_mm, weight = table[1, pixel, 0], table[1, pixel, 1], table[1, pixel, 2]
        seen[0, n], seen[1, n], seen[2, n], seen[3, n] = a, b, c, d
        seen[4, n], seen[5, n], seen[6, n] = inverse_depth, plane_mm, weight


@inner_kernel
def _average(tsdf: np.ndarray, weights: np.ndarray, at: np.ndarray, seen: np.ndarray, grid: Grid) -> None:
    """Fuse what voxels have looked up into their distances and weights (512,); both, of the frame, are put into `at`.

    The inverse depth is bilinear where the four neighbours are one surface, else the nearest pixel's.
    """
    truncation_mm, truncation_share, full = grid.truncation_mm, grid.truncation_share, 1.0 - grid.full_weight_share
    for n in range(_VOXELS):
        s, t = at[0, n], at[1, n]
        upper, lower = (1 - s) * seen[0, n] + s * seen[1, n], (1 - s) * seen[2, n] + s * seen[3, n]
        smooth, nearest = (1 - t) * upper + t * lower, float(seen[4, n])
        inverse_depth = smooth if smooth == smooth else nearest
        # Relative to the depth of the voxel's pixel: how far in front of the surface, and the truncation.
        gap, share = 1.0 - at[2, n] * inverse_depth, truncation_mm * inverse_depth
        share = share if share > truncation_share else truncation_share
        fading, truncation = (1.0 + gap / share) / full, share / inverse_depth
        weight = seen[6, n] * (fading if gap < 0 and fading < 1.0 else 1.0)
        weight = weight if gap > -share else 0.0
        distance = gap * seen[5, n]
        distance = distance if distance > -truncation else -truncation
        distance = distance if distance < truncation else truncation
        total = weights[n] + weight
        change = (distance - tsdf[n]) * weight / total
        tsdf[n] += change if weight > 0 else 0.0
        weights[n] = total
        at[0, n], at[1, n] = distance, weight


@inner_kernel
def _colour(colour: np.ndarray, picture: np.ndarray, at: np.ndarray, pixels: np.ndarray, band_mm: float) -> None:
    """Add the colours of `pixels` (512,) of a picture (H W, 4) to the voxels (512, 4) that are near the surface."""
    near, count = np.empty(_VOXELS, np.int32), 0
    # Listed first, without a branch, of which most would be guessed wrong.
    for n in range(_VOXELS):
        near[np.uint64(count)] = n
        count += (at[1, n] > 0) & (abs(at[0, n]) <= band_mm)
    for m in range(count):
        voxel = np.uint64(near[m])
        pixel = np.uint64(pixels[voxel])
        weight = at[1, voxel] * picture[pixel, 3]
        for channel in range(3):
            colour[voxel, channel] += weight * picture[pixel, channel]
        colour[voxel, 3] += weight


def integrate_blocks(
    voxels: Voxels,
    slots: np.ndarray,
    corners: np.ndarray,
    surface: MeasuredSurface,
    picture: np.ndarray,
    camera: TsdfCamera,
    grid: Grid,
) -> None:
    """Fuse one frame into the blocks `slots` (N,), whose first voxels are `corners` (N, 3), in voxels.

    picture : (H, W, 4) float32, r g b and the weight of each pixel's colour beside that of the surface.
    The distance of a voxel is the one to the tangent plane of the surface that its pixel sees. Voxels farther behind
    the surface than the truncation, along the optical axis, stay unchanged; towards there the weight falls to 0
    (Oleynikova et al., IROS 2017, eq. 6). Changes `voxels`.
    """
    projection = np.column_stack([camera.R, camera.t])
    projection[0] = camera.fx * projection[0] + camera.cx * projection[2]
    projection[1] = camera.fy * projection[1] + camera.cy * projection[2]
    _integrate_blocks(voxels, slots, corners, surface, picture, projection, grid)


@kernel
def _integrate_blocks(
    voxels: Voxels,
    slots: Int64_1d,
    corners: Int64_2d,
    surface: MeasuredSurface,
    picture: Float32_3d,
    projection: Float64_2d,
    grid: Grid,
) -> None:
    # Step by step for all voxels of a block, without branches: so that most steps are compiled to vector instructions.
    height, width = surface.inverse_depth.shape
    table, picture = _pixel_table(surface, grid.largest_step), picture.reshape(-1, 4)
    at, places, seen = np.empty((3, _VOXELS)), np.empty((2, _VOXELS), np.int32), np.empty((7, _VOXELS), np.float32)
    tsdf, weight = voxels.tsdf.reshape(-1, _VOXELS), voxels.weight.reshape(-1, _VOXELS)
    colour = voxels.colour.reshape(-1, _VOXELS, 4)
    for n in range(len(slots)):
        _project(corners[n], projection, grid.voxel_mm, at)
        _locate(at, places, float(width), float(height))
        _look_up(table, places, seen)
        _average(tsdf[slots[n]], weight[slots[n]], at, seen, grid)
        _colour(colour[slots[n]], picture, at, places[1], _COLOUR_BAND_VOXELS * grid.voxel_mm)
