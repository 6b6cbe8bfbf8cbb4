"""A training sample: buffers lit, painted and photographed anew each time they are used, and what is true of them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MaskSettings
from scopemap.engine.depth.scopenet.planes import input_planes
from scopemap.engine.frame import Frame
from scopemap.engine.masking.masker import Masker
from training.buffers import Buffers, Store, thinned
from training.light import INSTRUMENT, draw_light, shade
from training.sensor import take_picture

_RAYS_UNKNOWN_SHARE = 0.15
_MASKED_SHARE = 0.7
_FIELD_OF_VIEW_ERROR = 0.02


@dataclass(frozen=True)
class Sample:
    """One picture with its truth.

    rgb : (H, W, 3) uint8. valid : (H, W) bool, as the masker or the field of view says.
    rays : (H, W, 3) float32 true unit rays. given_rays : what the network is given of them, None = nothing.
    log_distance : (H, W) float32, ln of mm along the ray, NaN = unknown or outside the field of view.
    tissue : (H, W) bool, False where an instrument is seen.
    """

    rgb: np.ndarray
    valid: np.ndarray
    rays: np.ndarray
    given_rays: np.ndarray | None
    log_distance: np.ndarray
    tissue: np.ndarray

    @property
    def planes(self) -> np.ndarray:
        """The network's input (8, H, W) float32."""
        return input_planes(self.rgb, self.given_rays, self.valid)


class Batch(NamedTuple):
    """N samples of one size: planes (N, 8, H, W), log_distance (N, H, W), rays (N, 3, H, W), all float32."""

    planes: np.ndarray
    log_distance: np.ndarray
    rays: np.ndarray


def make_sample(buffers: Buffers, rng: np.random.Generator, *, strange: bool = True) -> Sample:
    """Return a random picture of a scene; equal generators give equal samples. `strange` : see `take_picture`."""
    rgb, field = take_picture(shade(buffers, draw_light(rng, buffers.kind), bounce_share(rng)), rng, strange=strange)
    valid = field & np.isfinite(buffers.log_distance)
    if rng.random() < _MASKED_SHARE:
        valid = masked(rgb)
    rays, log_distance = buffers.rays, np.where(field, buffers.log_distance, np.float32(np.nan))
    tissue = buffers.part != INSTRUMENT
    for axis in (0, 1):
        if rng.random() < 0.5:
            images = (rgb, valid, rays, log_distance, tissue)
            rgb, valid, rays, log_distance, tissue = (np.flip(image, axis) for image in images)
            rays = rays * np.where(np.arange(3) == 1 - axis, np.float32(-1), np.float32(1))
    return Sample(np.ascontiguousarray(rgb), valid, rays, told_rays(rays, rng), log_distance, tissue)


def masked(rgb: np.ndarray) -> np.ndarray:
    """Return the valid pixels (H, W) bool of a picture (H, W, 3) as a run finds them."""
    height, width, _ = rgb.shape
    camera = PinholeCamera(width, width, width / 2, height / 2, width, height)
    return Masker(MaskSettings())(Frame(0, 0.0, rgb, camera, np.ones((height, width), bool))).valid


def bounce_share(rng: np.random.Generator) -> float:
    """Return a random share of light that comes from other walls, as `shade` takes it."""
    return rng.uniform(0, 0.6) if rng.random() < 0.6 else 0.0


def told_rays(rays: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return rays (H, W, 3) as a user's calibration gives them: a little off, or None, not at all."""
    if rng.random() < _RAYS_UNKNOWN_SHARE:
        return None
    given = rays * np.array([1, 1, np.exp(rng.normal(0, _FIELD_OF_VIEW_ERROR))], np.float32)
    return given / np.linalg.norm(given, axis=-1, keepdims=True)


def make_batch(
    store: Store, indices: np.ndarray, seed: tuple[int, ...], pool: ThreadPoolExecutor, *, stride: int = 1
) -> Batch:
    """Return the batch of buffers `indices`, every `stride`-th pixel; sample n is drawn by (*seed, n)."""

    def sample(n: int) -> Sample:
        return make_sample(thinned(store[int(indices[n])], stride), np.random.default_rng((*seed, n)))

    rows = [(s.planes, s.log_distance, s.rays.transpose(2, 0, 1)) for s in pool.map(sample, range(len(indices)))]
    return Batch(*(np.stack(column) for column in zip(*rows, strict=True)))
