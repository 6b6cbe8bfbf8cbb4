"""Where the camera stands in a scene, what camera it is, and the instruments that come in from the border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from training.buffers import camera_rays
from training.marching import INSTRUMENT, march_rays, steepness, value_and_part
from training.scene import AIRWAY, COLON, LAPAROSCOPY, WALL, Arrays, Scene, log_uniform, rotation_to
from training.scene_tubes import wall_point
from training.shapes import CONE, ELLIPSOID, shape_row

_PROBE = (20, 24)
FAR = 1500.0
_LEAST_SPREAD, _MOST_SPREAD = 1.3, 20.0
# Share of the plain views (spread below 1.8) that are turned down.
_PLAIN, _TURNED_DOWN = 1.8, 0.6
_MOST_MISSED = 0.02
# Laparoscopes and exoscopes can be as narrow as this; in this share of the views of open scenes.
_NARROW_DEG, _NARROW_SHARE = (35.0, 50.0), 0.2


@dataclass(frozen=True)
class SceneView:
    """A camera in a scene.

    camera : (7,) as in `Buffers.camera`.
    eye : (3,) in scene units.
    rotation : (3, 3) rotation, scene <- camera.
    step : share of the free distance that a ray may safely go.
    median : median distance that the probe found, scene units.
    """

    camera: np.ndarray
    eye: np.ndarray
    rotation: np.ndarray
    step: float
    median: float


def random_camera(rng: np.random.Generator, width: int, height: int, narrow: float = 0.0) -> np.ndarray:
    """Return a random camera (7,): pinhole of 50 to 115 degrees across, or (15 %) a fisheye of up to 140.

    narrow : share of them that are pinholes of 35 to 50 degrees instead.
    """
    # From a stream of its own: what else is drawn of `rng` does not change.
    aside = rng.spawn(1)[0]
    fisheye = rng.random() < 0.15
    if fisheye:
        focal = 0.5 * width / (0.5 * np.deg2rad(rng.uniform(80, 140)))
    else:
        focal = 0.5 * width / np.tan(0.5 * np.deg2rad(rng.uniform(50, 115)))
    if aside.random() < narrow:
        fisheye, focal = False, 0.5 * width / np.tan(0.5 * np.deg2rad(aside.uniform(*_NARROW_DEG)))
    shift = np.clip(rng.normal(0, 0.025, 2), -0.06, 0.06) * width
    centre = 0.5 * (width - 1) + shift[0], 0.5 * (height - 1) + shift[1]
    return np.array([fisheye, focal, focal * rng.uniform(0.98, 1.02), *centre, width, height], np.float32)


def random_view(scene: Scene, rng: np.random.Generator, width: int, height: int) -> SceneView | None:
    """Return a random view of a scene, or None where the draw is no good: draw again."""
    camera = random_camera(rng, width, height, _NARROW_SHARE if scene.kind in (LAPAROSCOPY, WALL) else 0.0)
    arrays = scene.arrays()
    ahead: np.ndarray | None
    if scene.kind == COLON:
        eye, ahead = _in_colon(scene, rng)
    elif scene.kind in (LAPAROSCOPY, WALL):
        eye, ahead = _above_floor(scene, rng)
    else:
        eye, ahead = _in_cavity(scene, arrays, rng)
    if ahead is None or value_and_part(arrays, *eye, False)[0] < 0.4:
        return None
    rotation = np.roll(rotation_to(ahead, rng), -1, axis=0).T
    least = _PLAIN if rng.random() < _TURNED_DOWN else _LEAST_SPREAD
    return _probed(arrays, camera, np.ascontiguousarray(eye), np.ascontiguousarray(rotation), least)


def _probed(
    arrays: Arrays, camera: np.ndarray, eye: np.ndarray, rotation: np.ndarray, least: float
) -> SceneView | None:
    """March few rays: whether the view is closed, deep and wide enough, and how far a ray may step."""
    rays = rotated(probe_rays(camera), rotation)
    found = march_rays(arrays, eye, rays, 0.5, FAR)
    if np.isnan(found).mean() > _MOST_MISSED or not found_well(found, least):
        return None
    steep = np.empty(found.size)
    steepness(arrays, eye, rays.reshape(-1, 3), found.ravel(), steep)
    slope = max(1.0, float(np.nanpercentile(steep, 95)))
    return SceneView(camera, eye, rotation, max(0.9 / slope, 0.25), float(np.nanmedian(found)))


def probe_rays(camera: np.ndarray) -> np.ndarray:
    """Return few unit rays (20, 24, 3) in camera axes over the image of a camera (7,)."""
    rows, columns = _PROBE
    shrink = np.array([columns / camera[5], rows / camera[6]])
    small = camera.astype(np.float64)
    small[1:3] *= shrink
    small[3:5] = (small[3:5] + 0.5) * shrink - 0.5
    small[5:7] = columns, rows
    return camera_rays(small)


def rotated(rays: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) turned by a rotation (3, 3); not by BLAS, whose threads would fight the other worker."""
    return np.ascontiguousarray(np.einsum("...j,ij->...i", rays, rotation))


def found_well(distances: np.ndarray, least: float = _LEAST_SPREAD) -> bool:
    """Whether distances (H, W) spread by `least` to 20 times, and nothing sticks to the lens."""
    low, middle, high = np.nanpercentile(distances, (5, 50, 95))
    return bool(least <= high / low <= _MOST_SPREAD and np.nanmin(distances) > 0.03 * middle)


def _tilted(rng: np.random.Generator, axis: np.ndarray, angle: float) -> np.ndarray:
    """`axis` (3,) turned by `angle` towards a random side."""
    rotation = rotation_to(axis, rng)
    return np.cos(angle) * rotation[0] + np.sin(angle) * rotation[1]


def _in_colon(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Along the axis, across it or obliquely close to a wall, or at the blind end."""
    low, high = scene.base[17], scene.base[18]
    mode = rng.choice(3, p=(0.42, 0.33, 0.25))
    u = high - rng.uniform(10, 75) if mode == 2 else rng.uniform(low + 20, high - 25)
    share = 0.85 * np.sqrt(rng.random()) if mode == 1 else 0.7 * rng.random()
    at = (u, rng.uniform(0, 2 * np.pi), share)
    eye = wall_point(scene.base, scene.bends, at)
    tangent = wall_point(scene.base, scene.bends, (u + 2.0, at[1], share)) - eye
    if mode != 2 and rng.random() < 0.5:
        tangent = -tangent
    angle = np.deg2rad(rng.uniform(35, 100) if mode == 1 else min(abs(rng.normal(0, 18)), 50))
    return eye, _tilted(rng, tangent, angle)


def _above_floor(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """At a place on the floor, from a random height and obliquity, aimed a little beside it."""
    stray = scene.spots[0, 3]
    place = np.array([*rng.normal(0, 0.6 * stray, 2), rng.uniform(0, 0.1 * stray)])
    wide = scene.kind == LAPAROSCOPY
    tilt = np.deg2rad(rng.uniform(0, 70) if wide else 76 * np.sqrt(rng.random()))
    distance = log_uniform(rng, 28, 120) if wide else log_uniform(rng, 9, 70)
    back = _tilted(rng, np.array([0.0, 0.0, 1.0]), tilt)
    ahead = _tilted(rng, -back, np.deg2rad(abs(rng.normal(0, 6))))
    return place + distance * back, ahead


def _in_cavity(scene: Scene, arrays: Arrays, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
    """Anywhere free near a spot, looking anywhere, more often to where it is deep."""
    spot = scene.spots[int(rng.integers(len(scene.spots)))]
    offset = rng.normal(size=3)
    eye = spot[:3] + offset / np.linalg.norm(offset) * spot[3] * np.cbrt(rng.random())
    choices = 6 if scene.kind == AIRWAY else int(rng.choice([1, 4]))
    ways = rng.normal(size=(choices, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    depths = march_rays(arrays, eye, ways[None], 0.5, FAR)[0]
    if np.isnan(depths).any():
        return eye, None
    return eye, ways[int(depths.argmax())]


def random_tools(scene: Scene, view: SceneView, rng: np.random.Generator) -> np.ndarray:
    """Return 0 to 2 instruments as shapes (n, COLUMNS): shafts from the border towards the tissue, with two jaws."""
    wanted = rng.random() < (0.5 if scene.kind == LAPAROSCOPY else 0.15)
    count = int(rng.integers(1, 3)) if wanted else 0
    rows = [row for _ in range(count) for row in _tool(view, rng)]
    return np.array(rows).reshape(-1, 25)


def _tool(view: SceneView, rng: np.random.Generator) -> list[np.ndarray]:
    rays = probe_rays(view.camera)
    rows, columns = rays.shape[:2]
    tip_ray = rays[rng.integers(rows // 5, rows - rows // 5), rng.integers(columns // 5, columns - columns // 5)]
    angle = rng.uniform(0, 2 * np.pi)
    edge = np.array([np.cos(angle), np.sin(angle)])
    edge *= 1.35 / max(
        abs(edge[0]) / abs(rays[0, -1, 0] / rays[0, -1, 2]), abs(edge[1]) / abs(rays[-1, 0, 1] / rays[-1, 0, 2])
    )
    border = np.array([*edge, 1.0])
    tip = view.median * rng.uniform(0.35, 0.95) * tip_ray
    start = view.median * rng.uniform(0.25, 0.7) * border / np.linalg.norm(border)
    start += 0.4 * (start - tip)
    radius = view.median * log_uniform(rng, 0.012, 0.06)
    axis = tip - start
    length = float(np.linalg.norm(axis))
    nearest = np.linalg.norm(start + np.clip(-start @ axis / length**2, 0, 1) * axis)
    if nearest < radius + 0.13 * view.median:
        return []
    made = [_piece(view, start, axis, (length, radius, radius))]
    jaw, spread = radius * rng.uniform(2.5, 6.0), np.deg2rad(rng.uniform(0, 30))
    rotation = rotation_to(axis, rng)
    made.append(_piece(view, tip, axis, (0.8 * radius, 1.0 * radius, 0.7 * radius)))
    for sign in (-1.0, 1.0):
        heading = np.cos(spread) * rotation[0] + sign * np.sin(spread) * rotation[1]
        root = tip + sign * 0.35 * radius * rotation[1]
        made.append(_piece(view, root, heading, (jaw, 0.45 * radius, 0.2 * radius)))
    if rng.random() < 0.3:
        ball = shape_row(ELLIPSOID, view.eye + view.rotation @ tip, np.eye(3), (1.15 * radius,) * 3, part=INSTRUMENT)
        made.append(ball)
    return made


def _piece(view: SceneView, start: np.ndarray, axis: np.ndarray, size: tuple[float, float, float]) -> np.ndarray:
    """A cone of an instrument from camera to scene coordinates."""
    return shape_row(CONE, view.eye + view.rotation @ start, rotation_to(view.rotation @ axis), size, part=INSTRUMENT)
