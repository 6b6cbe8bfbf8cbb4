"""Motion during the exposure, and gains that follow the scene late: what a real camera adds to still pictures."""

from __future__ import annotations

import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap.geometry.se3 import inverse, mean_near, transform
from scopemap_bench.phantom.march import SurfaceBuffers, rays_of

MAX_SAMPLES = 8
"""Of light within one exposure."""

_SHIFT_PERCENTILE = 95
_PX_PER_SAMPLE = 2.0


def pose_at(poses: np.ndarray, time: float) -> np.ndarray:
    """Return the pose (4, 4) at a time in frames, between the poses (N, 4, 4) before and after; held at the ends."""
    first = int(np.clip(np.floor(time), 0, max(len(poses) - 2, 0)))
    share = float(np.clip(time - first, 0, 1))
    last = min(first + 1, len(poses) - 1)
    return poses[first] if share == 0 else mean_near(poses[first], [poses[last]], [share])


def exposure_times(
    index: int, shutter: float, poses: np.ndarray, surface: SurfaceBuffers, camera: CameraModel
) -> list[float]:
    """Return the times, in frames, at which the light of frame `index` is sampled; `[index]` where nothing moves.

    The shutter is open for a share `shutter` of the interval between frames, centred at the frame's pose. There is
    one sample for every 2 px that most pixels move while it is open, 8 at most.
    """
    start, end = (pose_at(poses, index + half) for half in (-0.5 * shutter, 0.5 * shutter))
    rows, columns = np.arange(0, camera.height, 4), np.arange(0, camera.width, 4)
    seen = surface.depth_mm[np.ix_(rows, columns)].astype(np.float64)
    points = transform(poses[index], (rays_of(camera)[np.ix_(rows, columns)] * seen[..., None])[np.isfinite(seen)])
    pixels = []
    for pose in (start, end):
        local = transform(inverse(pose), points)
        pixels.append(camera.project(local))
    shift_px = np.linalg.norm(pixels[1] - pixels[0], axis=1)
    shift_px = shift_px[np.isfinite(shift_px)]
    wanted = float(np.percentile(shift_px, _SHIFT_PERCENTILE)) if len(shift_px) else 0.0
    samples = int(np.clip(np.ceil(wanted / _PX_PER_SAMPLE), 1, MAX_SAMPLES))
    return [index + shutter * ((n + 0.5) / samples - 0.5) for n in range(samples)]


def lagging_gains(wanted: np.ndarray, lag_frames: float) -> np.ndarray:
    """Return gains (N,) that follow those wanted (N,) with a time constant in frames, as a camera's control does.

    The logarithm of the gain is filtered: a control loop works in stops.
    """
    share = 1 - np.exp(-1 / lag_frames) if lag_frames > 0 else 1.0
    log = np.log(np.asarray(wanted, np.float64))
    for n in range(1, len(log)):
        log[n] = log[n - 1] + share * (log[n] - log[n - 1])
    return np.exp(log)
