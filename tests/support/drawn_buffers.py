"""Buffers of a sphere around the camera, as training scenes whose light is known in closed form."""

from dataclasses import replace

import numpy as np

from training.buffers import Buffers

HEIGHT, WIDTH = 48, 64


def sphere(distance_mm: float = 30.0) -> Buffers:
    """Every ray meets the wall head-on, equally far away; one lamp at the lens."""
    size = (HEIGHT, WIDTH)
    plain = Buffers(
        log_distance=np.full(size, np.log(distance_mm), np.float32),
        normal=np.zeros((*size, 3), np.float32),
        noise=np.zeros((*size, 8), np.float32),
        part=np.zeros(size, np.uint8),
        lit=np.stack([np.ones(size, np.float32), np.zeros(size, np.float32)], -1),
        lamps_mm=np.array([[0, 0, 0], [np.nan] * 3], np.float32),
        camera=np.array([0, 40.0, 40.0, 31.5, 23.5, WIDTH, HEIGHT], np.float32),
        scale_mm=1.0,
        kind=1,
    )
    return replace(plain, normal=-plain.rays)
