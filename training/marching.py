"""The implicit function of a whole scene, and rays marched through it.

Sphere tracing (J. C. Hart, The Visual Computer 12, 1996), first for cones of 8 x 8 and 2 x 2 pixels, then for each ray
from where its cone got stuck. Bumps are evaluated only where they could reach (bounded relief).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from training.shapes import (
    BLEND,
    CENTRE,
    JOINS,
    OP,
    PART,
    REACH,
    RELIEF,
    bump,
    floor,
    shape_distance,
    sine,
    smooth_min,
    tube,
)

_FAR = 1e9
_EXACT = -1e9
# Share of the distance within which the chord is taken for the surface.
_CLOSE = 8e-4
_STUCK = 0.4
INSTRUMENT = 7


@njit(cache=True, nogil=True, error_model="numpy")
def _warp(warps, x, y, z):
    for n in range(warps.shape[0]):
        a, k = warps[n, 0], warps[n, 1]
        x += a * sine(k * y + warps[n, 2])
        y += a * sine(k * z + warps[n, 3])
        z += a * sine(k * x + warps[n, 4])
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def _add(state, group, carved, k):
    """Blend a finished group (distance, part, relief) over the length k into (free, part, relief)."""
    free, part, relief = state
    d, new_part, new_relief = group
    if carved:
        free = -free
    mix = min(max(0.5 + 0.5 * (free - d) / max(k, 0.5), 0.0), 1.0)
    if d < free:
        part = new_part
    relief = relief + (new_relief - relief) * mix
    free = smooth_min(free, d, k)
    return -free if carved else free, part, relief


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth_value(scene, x, y, z):
    """Free distance without bumps, part, and share of the bumps."""
    base, bends, folds, shapes = scene[0], scene[1], scene[2], scene[3]
    free, part, relief = -_FAR, 0.0, 1.0
    if base[0] == 0.0:
        free = tube(base, bends, folds, x, y, z)
    elif base[0] == 1.0:
        free = floor(base, x, y, z)
    n, count = 0, shapes.shape[0]
    while n < count:
        d, group_part, group_relief = _FAR, 0.0, 1.0
        carved, k = shapes[n, OP] == 0.0, shapes[n, BLEND]
        bound = k - free if carved else k + free
        first = n
        while n < count and (n == first or shapes[n, JOINS] == 1.0):
            reach = shapes[n, REACH] + bound + shapes[n, BLEND]
            cx, cy, cz = x - shapes[n, CENTRE], y - shapes[n, CENTRE + 1], z - shapes[n, CENTRE + 2]
            if reach > 0.0 and cx * cx + cy * cy + cz * cz < reach * reach:
                mine = shape_distance(shapes, n, x, y, z)
                if mine < d:
                    group_part, group_relief = shapes[n, PART], shapes[n, RELIEF]
                d = smooth_min(d, mine, shapes[n, BLEND]) if n > first else mine
            n += 1
        if d < _FAR:
            free, part, relief = _add((free, part, relief), (d, group_part, group_relief), carved, k)
    return free, part, relief


@njit(cache=True, nogil=True, error_model="numpy")
def _relief(rows, x, y, z, bound, free):
    """Height (mm) of all octaves of bumps: plain, ridged (mode 1) or creased (mode 2).

    Stops at an upper bound where the rest cannot reach a point that far (`free`) from the smooth surface.
    """
    height = 0.0
    for n in range(rows.shape[0]):
        if free - height > 2.0 * bound:
            return height + bound
        a, p = rows[n, 0], rows[n, 1]
        bound -= a
        value = bump(x / p, y / p, z / p, int(rows[n, 2]))
        if rows[n, 3] == 1.0:
            value = 1.0 - min(2.2 * np.sqrt(value * value + 0.003), 1.0)
            value *= value
        elif rows[n, 3] == 2.0:
            value = min(2.2 * np.sqrt(value * value + 0.002), 1.0) - 0.5
        height += a * value
    return height


@njit(cache=True, nogil=True, error_model="numpy")
def value_and_part(scene, x, y, z, exact):
    """Free distance (scene units; positive in free space, about the distance to tissue) and the part's number.

    Unless `exact`, far from the surface the bumps are not evaluated: as much is taken off as they could reach.
    """
    warps, relief, tools, bound = scene[4], scene[5], scene[6], scene[0][30]
    wx, wy, wz = _warp(warps, x, y, z)
    free, part, share = _smooth_value(scene, wx, wy, wz)
    # Twice the bound: less would come out as nearly 0 in free space, and a ray would take that for a hit.
    if free > 2.0 * bound and not exact:
        free -= bound
    elif free > -bound or exact:
        free -= share * _relief(relief, wx, wy, wz, bound, _EXACT if exact else free)
    for n in range(tools.shape[0]):
        reach = max(tools[n, REACH] + free, 0.0)
        cx, cy, cz = x - tools[n, CENTRE], y - tools[n, CENTRE + 1], z - tools[n, CENTRE + 2]
        if cx * cx + cy * cy + cz * cz < reach * reach:
            d = shape_distance(tools, n, x, y, z)
            if d < free:
                free, part = d, tools[n, PART]
    return free, part


@njit(cache=True, nogil=True, error_model="numpy")
def _at(scene, eye, d, t):
    """Free distance at distance t along the ray (eye, d)."""
    return value_and_part(scene, eye[0] + t * d[0], eye[1] + t * d[1], eye[2] + t * d[2], False)[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _between(scene, eye, d, near, f_near, far, f_far):
    """Root between `near` (free) and `far` (tissue): regula falsi, Illinois variant; the last chord is not checked."""
    side = 0
    for _ in range(12):
        t = (near * f_far - far * f_near) / (f_far - f_near)
        if far - near < 1e-3 * t or min(f_near, -f_far) < _CLOSE * t:
            return t
        f = _at(scene, eye, d, t)
        if f > 0.0:
            near, f_near = t, f
            if side == 1:
                f_far *= 0.5
            side = 1
        else:
            far, f_far = t, f
            if side == -1:
                f_near *= 0.5
            side = -1
    return 0.5 * (near + far)


@njit(cache=True, nogil=True, error_model="numpy")
def trace(scene, eye, d, start, step, far, slope):
    """Distance along the unit ray d (3,) from eye (3,) to the first surface, NaN if none within `far`; and the slope.

    `start` is a distance known to be free; `step` the share of the free distance that is safe to go; `slope` the fall
    of the free distance per length that a neighbouring ray found at its surface (0: not known), to go there at once.
    """
    t, before = start, start
    f = f_before = _at(scene, eye, d, t)
    if f <= 0.0:
        if start <= 0.0:
            return np.nan, 0.0
        t = before = 0.0
        f = f_before = _at(scene, eye, d, t)
    for _ in range(400):
        if f <= 0.0:
            fallen = (f_before - f) / max(t - before, 1e-12)
            return (_between(scene, eye, d, before, f_before, t, f) if t > before else np.nan), fallen
        if t > before:
            slope = (f_before - f) / (t - before)
        # A ray that grazes an edge must come nearer: it may yet miss.
        if slope > 0.05 and f < _CLOSE * t * min(1.0, 4.0 * slope * slope) and t > before:
            return t + f / slope, slope
        if f < 1e-4 * t:
            return t, slope
        go = max(step * f, 4e-4 * t)
        if f < 0.03 * t and slope > 0.0:
            # Near the surface go to where the chord meets it, but not through what is thin.
            go = max(go, min(f / slope, 3.0 * f if f < 0.006 * t else f))
        before, f_before = t, f
        t += go
        if t > far:
            return np.nan, 0.0
        f = _at(scene, eye, d, t)
    return np.nan, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_cone(scene, eye, d, spread, start, step, far):
    """Distance along d up to which the whole cone of half-angle `spread` (rad) is free."""
    t = start
    for _ in range(100):
        free = 0.9 * step * _at(scene, eye, d, t) - spread * t
        if free < _STUCK * spread * t or t > far:
            break
        t += free / (1.0 + spread)
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def _cone_level(scene, eye, rays, starts, size, step, far):
    """Advance the starts (H, W) of each block of size x size rays together."""
    d = np.empty(3)
    for top in range(0, rays.shape[0], size):
        for left in range(0, rays.shape[1], size):
            bottom, right = min(top + size, rays.shape[0]), min(left + size, rays.shape[1])
            middle = rays[(top + bottom - 1) // 2, (left + right - 1) // 2]
            spread = 0.0
            for row in (top, bottom - 1):
                for column in (left, right - 1):
                    other = rays[row, column]
                    chord = np.sqrt(((middle - other) ** 2).sum())
                    spread = max(spread, 1.02 * chord)
            d[:] = middle
            t = _trace_cone(scene, eye, d, spread, starts[top, left], step, far)
            starts[top:bottom, left:right] = 0.999 * t * (1.0 - spread)


@njit(cache=True, nogil=True, error_model="numpy")
def march_rays(scene, eye, rays, step, far):
    """Distances (H, W) float64 from eye (3,) along unit rays (H, W, 3) in scene axes; NaN where nothing is hit."""
    height, width = rays.shape[:2]
    out = np.zeros((height, width))
    if height >= 16:
        _cone_level(scene, eye, rays, out, 8, step, far)
        _cone_level(scene, eye, rays, out, 2, step, far)
    d = np.empty(3)
    for row in range(height):
        slope = 0.0
        for column in range(width):
            d[:] = rays[row, column]
            out[row, column], slope = trace(scene, eye, d, out[row, column], step, far, slope)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def gradient(scene, x, y, z, h, out):
    """Write the gradient of the free distance at a point into out (3,): tetrahedron rule with arms of length h.

    Returns the number of the nearest part.
    """
    out[:] = 0.0
    least, part = _FAR, 0.0
    for n in range(4):
        a = 1.0 if n == 0 or n == 3 else -1.0
        b = 1.0 if n == 1 or n == 3 else -1.0
        c = 1.0 if n == 2 or n == 3 else -1.0
        f, there = value_and_part(scene, x + a * h, y + b * h, z + c * h, True)
        if f < least:
            least, part = f, there
        out[0], out[1], out[2] = out[0] + a * f, out[1] + b * f, out[2] + c * f
    out /= 4.0 * h
    return part


@njit(cache=True, nogil=True, error_model="numpy")
def steepness(scene, eye, rays, distances, out):
    """Write the norm of the gradient a little before each hit into out (N,); NaN without hit. rays (N, 3)."""
    g = np.empty(3)
    for n in range(len(distances)):
        out[n] = np.nan
        t = distances[n] * (1.0 - 0.02 * (n % 5))
        if np.isfinite(t):
            gradient(scene, eye[0] + t * rays[n, 0], eye[1] + t * rays[n, 1], eye[2] + t * rays[n, 2], 2e-3 * t, g)
            out[n] = np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def _unit(g, ray):
    """Make g (3,) unit in place; return its product with the ray."""
    g /= np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2) + 1e-12
    return g[0] * ray[0] + g[1] * ray[1] + g[2] * ray[2]


@njit(cache=True, nogil=True, error_model="numpy")
def surface(scene, eye, rays, distances, pixel_rad, normal, part):
    """Write normals (H, W, 3), scene axes, towards the eye, and parts (H, W) at the hits."""
    g, ray = np.empty(3), np.empty(3)
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            t = distances[row, column]
            if not np.isfinite(t):
                continue
            ray[:] = rays[row, column]
            x, y, z = eye[0] + t * ray[0], eye[1] + t * ray[1], eye[2] + t * ray[2]
            arm = 0.3 * pixel_rad * t
            part[row, column] = int(gradient(scene, x, y, z, arm, g))
            facing = _unit(g, ray)
            if facing > -0.15:
                # At an edge long arms feel its far side.
                gradient(scene, x, y, z, 0.1 * arm, g)
                facing = _unit(g, ray)
            if facing > -0.02:
                g -= (facing + 0.02) * ray
                _unit(g, ray)
            normal[row, column] = g


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel(camera, x, y, z):
    """Row and column (int) of the pixel that sees a point in camera axes; row -1 if none does."""
    if camera[0] == 0.0:
        if z <= 1e-6:
            return -1, -1
        scale = 1.0 / z
    else:
        side = np.sqrt(x * x + y * y)
        scale = np.arctan2(side, z) / (side + 1e-12)
    column = int(np.floor(camera[1] * x * scale + camera[3] + 0.5))
    row = int(np.floor(camera[2] * y * scale + camera[4] + 0.5))
    if row < 0 or row >= camera[6] or column < 0 or column >= camera[5]:
        return -1, -1
    return row, column


@njit(cache=True, nogil=True, error_model="numpy")
def _maybe_shadowed(camera, distances, hit, lamp, nearest):
    """Whether anything that the camera sees may stand between a hit and the lamp (both in camera axes)."""
    hx, hy, hz = hit
    t = np.sqrt(hx * hx + hy * hy + hz * hz)
    lx, ly, lz = lamp[0] - hx, lamp[1] - hy, lamp[2] - hz
    more = 1.0 / nearest - 1.0 / t
    parallax = np.sqrt(lamp[0] ** 2 + lamp[1] ** 2 + lamp[2] ** 2) * more * camera[1]
    count = int(min(max(1.2 * parallax, 2.0), 40.0))
    for n in range(1, count + 1):
        s = 1.0 - 1.0 / (1.0 + t * more * n / count)
        x, y, z = hx + s * lx, hy + s * ly, hz + s * lz
        row, column = _pixel(camera, x, y, z)
        if row < 0:
            return False
        if distances[row, column] < 0.97 * np.sqrt(x * x + y * y + z * z):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _light_share(scene, start, lamp, step, soft):
    """Share (0..1) of a lamp's light that reaches a point, both in scene axes: a march with a soft edge."""
    towards = lamp - start
    length = np.sqrt((towards * towards).sum())
    towards /= length
    t, share = 0.0, 1.0
    for _ in range(80):
        f = _at(scene, start, towards, t)
        if f <= 0.0:
            return 0.0
        if t > 0.03 * length:
            share = min(share, soft * f / t)
        t += max(step * f, 3e-3 * length)
        if t > 0.97 * length:
            break
    return share if share > 0.02 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def shade_shadows(scene, view, buffers, lamp, step, soft, out):
    """Write the share of light (H, W) from a lamp (3,) in camera axes, scene units.

    view: eye (3,), rotation scene <- camera (3, 3), camera (7,). buffers: rays in camera axes (H, W, 3), distances
    (H, W), normals in camera axes. Only what the image says may be shadowed is marched.
    """
    eye, rotation, camera = view
    rays, distances, normals = buffers
    world_lamp = eye + rotation @ lamp
    nearest = np.nanmin(distances)
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            t = distances[row, column]
            if not np.isfinite(t):
                continue
            ray, normal = rays[row, column], normals[row, column]
            hx, hy, hz = t * ray[0], t * ray[1], t * ray[2]
            if normal[0] * (lamp[0] - hx) + normal[1] * (lamp[1] - hy) + normal[2] * (lamp[2] - hz) <= 0.0:
                continue
            out[row, column] = 1.0
            if _maybe_shadowed(camera, distances, (hx, hy, hz), lamp, nearest):
                start = eye + rotation @ (t * ray + 4e-3 * t * normal)
                out[row, column] = _light_share(scene, start, world_lamp, step, soft)
