"""An instrument that enters the view, works and leaves: a shaft and two jaws, as capsules beside the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scopemap.engine.cameras.camera import CameraModel
from scopemap_bench.phantom.march import SurfaceBuffers, rays_of

_METAL = np.array([0.50, 0.51, 0.53], np.float32)
_SHAFT = np.array([0.09, 0.09, 0.10], np.float32)
_GLOSS_SHARPNESS = 30.0
_GLOSS = 1.2
# Port and working point in camera axes, mm, radius, and how far the tip wanders; a rigid one beside the laparoscope,
# and forceps out of the endoscope's channel.
_RIGID = (np.array([55.0, 34.0, -20.0]), np.array([4.0, 4.0, 46.0]), 2.5, 9.0)
_FORCEPS = (np.array([5.0, 5.0, -2.0]), np.array([1.0, 2.0, 17.0]), 1.1, 3.0)
_JAWS_MM = (11.0, 4.0)
_OPEN_RAD = 0.35
_CLOSED_RAD = 0.08


@dataclass(frozen=True)
class Capsules:
    """Capsules in camera axes: `ends` (K, 2, 3) mm, `radii` (K,) mm, `colours` (K, 3) linear RGB."""

    ends: np.ndarray
    radii: np.ndarray
    colours: np.ndarray


def instrument(
    time: float, first: int, last: int, rigid: bool, seed: int, held: tuple[np.ndarray, bool] | None = None
) -> Capsules | None:
    """Return the instrument at a time in frames: it enters early in `first` to `last` and leaves late.

    held : the point (3,), camera axes, mm, that its tip goes to instead of working at will, and whether its jaws are
    closed.
    """
    share = (time - first) / max(last - first, 1)
    if not 0 <= share <= 1:
        return None
    port, work, radius, wander = _RIGID if rigid else _FORCEPS
    out = 1 - np.clip(min(share, 1 - share) * (3 if held is None else 4), 0, 1)
    phase = np.random.default_rng((seed, 9)).uniform(0, 2 * np.pi, 3)
    sway = wander * np.sin(time * np.array([0.11, 0.083, 0.06]) + phase)
    reach = (work + sway if held is None else held[0]) - port
    along = reach / np.linalg.norm(reach)
    tip = port + (1 - out) * reach
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    jaw, angle = _JAWS_MM[0 if rigid else 1], _OPEN_RAD * (0.6 + 0.4 * np.sin(0.2 * time))
    angle = _CLOSED_RAD if held is not None and held[1] else angle
    hinge = tip - jaw * along
    jaws = [[hinge, hinge + jaw * (np.cos(angle) * along + sign * np.sin(angle) * side)] for sign in (-1, 1)]
    ends = np.array([[port - 40 * along, hinge - jaw * along], [hinge - jaw * along, hinge], *jaws])
    return Capsules(ends, radius * np.array([1.0, 0.9, 0.45, 0.45]), np.stack([_SHAFT, _METAL, _METAL, _METAL]))


def insert(
    tool: Capsules | None,
    radiance: np.ndarray,
    surface: SurfaceBuffers,
    camera: CameraModel,
    sent: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, SurfaceBuffers]:
    """Return light (H, W, 3) and surface of a view with an instrument in front; the depth that it hides is unknown.

    sent : of the lamp along each ray, as `shading.beam` returns it.
    """
    if tool is None:
        return radiance, surface
    rays = rays_of(camera).astype(np.float32)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    nearest, normal = np.full(rays.shape[:2], np.inf), np.zeros_like(rays)
    colour = np.zeros_like(radiance)
    for ends, radius, shade in zip(tool.ends, tool.radii, tool.colours, strict=True):
        distance, outward = _hit(rays, ends, float(radius))
        front = distance < nearest
        nearest[front], normal[front], colour[front] = distance[front], outward[front], shade
    hides = nearest < np.nan_to_num(surface.distance_mm, nan=np.inf)
    facing = np.clip(-(normal * rays).sum(-1), 0, 1)
    light = (colour * facing[..., None] + _GLOSS * facing[..., None] ** _GLOSS_SHARPNESS) / nearest[..., None] ** 2
    unknown = replace(
        surface,
        depth_mm=np.where(hides, np.nan, surface.depth_mm).astype(np.float32),
        distance_mm=np.where(hides, np.nan, surface.distance_mm).astype(np.float32),
        normal=np.where(hides[..., None], np.nan, surface.normal).astype(np.float32),
        rest_mm=np.where(hides[..., None], np.nan, surface.rest_mm).astype(np.float32),
    )
    return np.where(hides[..., None], light * sent, radiance).astype(np.float32), unknown


def _hit(rays: np.ndarray, ends: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance (H, W), mm, inf where it misses, and outward normal (H, W, 3) of a capsule along `rays`."""
    start, axis = ends[0], ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    axis = axis / length
    across = rays - (rays @ axis)[..., None] * axis
    offset = start - (start @ axis) * axis
    a, b, c = (across**2).sum(-1), across @ offset, float(offset @ offset) - radius**2
    with np.errstate(invalid="ignore", divide="ignore"):
        distance = (b - np.sqrt(b**2 - a * c)) / a
        along = distance * (rays @ axis) - start @ axis
        distance = np.where((distance > 0) & (along >= 0) & (along <= length), distance, np.inf)
        for end in ends:
            ahead = rays @ end
            ball = ahead - np.sqrt(ahead**2 - float(end @ end) + radius**2)
            distance = np.fmin(distance, np.where(ball > 0, ball, np.inf))
    points = np.where(np.isfinite(distance), distance, 0.0)[..., None] * rays - start
    foot = np.clip(points @ axis, 0, length)[..., None] * axis
    return distance, (points - foot) / radius
