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
def _whole_cells(inverse_depth: np.ndarray, largest_step: float) -> np.ndarray:
    """Return whether a pixel, its right, its lower and its diagonal neighbour are one surface, (H, W) bool."""
    height, width = inverse_depth.shape
    whole = np.zeros((height, width), np.bool_)
    for row in range(height - 1):
        for col in range(width - 1):
            a, b = inverse_depth[row, col], inverse_depth[row, col + 1]
            c, d = inverse_depth[row + 1, col], inverse_depth[row + 1, col + 1]
            low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
            known = a > 0 and b > 0 and c > 0 and d > 0
            # A cell's diagonal is sqrt(2) px long.
            whole[row, col] = known and high - low <= 1.5 * largest_step * low
    return whole


@inner_kernel
def _sample(inverse_depth: np.ndarray, whole: np.ndarray, u: float, v: float) -> float:
    """Bilinear inverse depth where the four neighbours are one surface, else the nearest pixel's (NaN: none)."""
    # Clamped, so that the outer half of a border pixel continues the cell inside it.
    col = min(max(int(u), 0), inverse_depth.shape[1] - 2)
    row = min(max(int(v), 0), inverse_depth.shape[0] - 2)
    if whole[row, col]:
        s, t = u - col, v - row
        upper = (1 - s) * inverse_depth[row, col] + s * inverse_depth[row, col + 1]
        return (1 - t) * upper + t * ((1 - s) * inverse_depth[row + 1, col] + s * inverse_depth[row + 1, col + 1])
    return inverse_depth[int(v + 0.5), int(u + 0.5)]


@inner_kernel
def _integrate_block(
    voxels: Voxels,
    corner: np.ndarray,
    surface: MeasuredSurface,
    whole: np.ndarray,
    picture: np.ndarray,
    projection: np.ndarray,
    grid: Grid,
) -> None:
    """Fuse a frame into the voxels of one block; the pixel of a point (x, y, z) mm is `projection` @ (x, y, z, 1)."""
    # Outside the loop: numba counts references of arrays that are read from a tuple.
    tsdf, weights, colour = voxels.tsdf, voxels.weight, voxels.colour
    inverse_depths, plane_mm, pixel_weight = surface.inverse_depth, surface.plane_mm, surface.weight
    height, width = inverse_depths.shape
    p, voxel_mm = projection, grid.voxel_mm
    step_u, step_v, step_depth = voxel_mm * p[0, 2], voxel_mm * p[1, 2], voxel_mm * p[2, 2]
    z = corner[2] * voxel_mm
    for line in range(BLOCK * BLOCK):
        i, j = line // BLOCK, line % BLOCK
        x, y = (corner[0] + i) * voxel_mm, (corner[1] + j) * voxel_mm
        first_u = p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]
        first_v = p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]
        first_depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
        for k in range(BLOCK):
            depth = first_depth + k * step_depth
            if depth <= 0:
                continue
            u, v = (first_u + k * step_u) / depth, (first_v + k * step_v) / depth
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            row, col = int(v + 0.5), int(u + 0.5)
            weight = pixel_weight[row, col]
            if weight == 0:
                continue
            inverse_depth = _sample(inverse_depths, whole, u, v)
            # Relative to the depth of the voxel's pixel: how far in front of the surface, and the truncation.
            gap, share = 1.0 - depth * inverse_depth, max(grid.truncation_mm * inverse_depth, grid.truncation_share)
            if gap <= -share:
                continue
            if gap < 0:
                weight *= min(1.0, (1.0 + gap / share) / (1.0 - grid.full_weight_share))
            truncation = share / inverse_depth
            distance = min(max(gap * plane_mm[row, col], -truncation), truncation)
            total = weights[i, j, k] + weight
            tsdf[i, j, k] += (distance - tsdf[i, j, k]) * weight / total
            weights[i, j, k] = total
            if abs(distance) <= _COLOUR_BAND_VOXELS * voxel_mm:
                weight *= picture[row, col, 3]
                for channel in range(3):
                    colour[i, j, k, channel] += weight * picture[row, col, channel]
                colour[i, j, k, 3] += weight


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
    whole = _whole_cells(surface.inverse_depth, grid.largest_step)
    for n in range(len(slots)):
        block = Voxels(voxels.tsdf[slots[n]], voxels.weight[slots[n]], voxels.colour[slots[n]])
        _integrate_block(block, corners[n], surface, whole, picture, projection, grid)
