"""A training sample of the instrument head: a scene's buffers, made harder, with a layer of instruments over them.

The tissue is lit and painted by `light.py`, the layer by `instrument_looks.py`; they are put together in linear light,
with the layer's shadow, its blur, and tissue in front of it where it is nearer, and photographed by `sensor.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from scopemap.engine.depth.scopenet.planes import input_planes
from training.buffers import Buffers
from training.instrument_layers import Layer
from training.instrument_looks import light_of_instruments
from training.light import INSTRUMENT, Light, beam_shares, brightest, draw_light, shade
from training.samples import bounce_share, masked, told_rays
from training.scene import log_uniform
from training.sensor import motion_kernel, take_picture

_MASKED_SHARE, _ALWAYS_IN_FRONT, _MOVING = 0.8, 0.35, 0.25


@dataclass(frozen=True)
class InstrumentSample:
    """One picture with its truth.

    rgb : (H, W, 3) uint8. planes : (8, H, W) float32, the network's input.
    instruments : (H, W) float32, 0..1, how much of the pixel shows one. field : (H, W) bool, field of view.
    """

    rgb: np.ndarray
    planes: np.ndarray
    instruments: np.ndarray
    field: np.ndarray


def make_instrument_sample(
    buffers: Buffers, layer: Layer | None, rng: np.random.Generator, *, hard: bool = True
) -> InstrumentSample:
    """Return a random picture of a scene with a layer of its size over it; equal generators give equal samples.

    hard : with dyes, pale tissue and what else is taken for instruments, and strange as in `take_picture`.
    """
    light = draw_light(rng, buffers.kind)
    light = _harder(light, rng) if hard else light
    shares = (buffers.part >= INSTRUMENT).astype(np.float32)
    if layer is None:
        linear = shade(buffers, light, bounce_share(rng))
    else:
        linear, over = _composed(buffers, layer, light, rng)
        shares = np.maximum(shares * (1 - over), over)
    rgb, field = take_picture(linear, rng, strange=hard)
    valid = field & np.isfinite(buffers.log_distance)
    if rng.random() < _MASKED_SHARE:
        valid = masked(rgb)
    rays = buffers.rays
    for axis in (0, 1):
        if rng.random() < 0.5:
            rgb, valid, rays, shares, field = (np.flip(image, axis) for image in (rgb, valid, rays, shares, field))
            rays = rays * np.where(np.arange(3) == 1 - axis, np.float32(-1), np.float32(1))
    rgb = np.ascontiguousarray(rgb)
    planes = input_planes(rgb, told_rays(rays, rng), valid)
    return InstrumentSample(rgb, planes, np.where(field, shares, 0).astype(np.float32), field)


def _composed(buffers: Buffers, layer: Layer, light: Light, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Linear light (H, W, 3) with the layer in it, and its share (H, W) of each pixel."""
    height, width = buffers.size
    distance_mm = np.exp(buffers.log_distance)
    median_mm = float(np.nanmedian(distance_mm))
    scale = log_uniform(rng, 0.7, 1.25)
    in_front = np.ones(len(layer.pixel), bool)
    if rng.random() > _ALWAYS_IN_FRONT:
        there = np.nan_to_num(distance_mm.ravel()[layer.pixel], nan=np.inf)
        in_front = scale * median_mm * layer.distance < there
    over = np.zeros(height * width, np.float32)
    over[layer.pixel[in_front]] = 1
    over = over.reshape(height, width)
    shadowed = replace(buffers, lit=_shadowed(buffers, over, layer, scale, rng))
    linear = shade(shadowed, light, bounce_share(rng))
    seen = brightest(linear) > 0
    around = linear[seen].mean(0) if seen.any() else np.ones(3, np.float32)
    rays = buffers.rays.reshape(-1, 3)[layer.pixel]
    nearer = replace(layer, distance=scale * layer.distance)
    mine = light_of_instruments(nearer, rays, buffers.lamps_mm / median_mm, light, around, rng)
    mine *= beam_shares(buffers.rays, light.beams).reshape(-1, 1)[layer.pixel]
    instrument = np.zeros((height * width, 3), np.float32)
    instrument[layer.pixel] = mine
    # Premultiplied, so that a blur mixes what is there alone.
    instrument = instrument.reshape(height, width, 3) * over[..., None]
    instrument, over = _blurred(instrument, over, rng)
    return linear * (1 - over[..., None]) + instrument, over


def _shadowed(buffers: Buffers, over: np.ndarray, layer: Layer, scale: float, rng: np.random.Generator) -> np.ndarray:
    """What of the lamps' light arrives, (H, W, 2), behind a layer: its outline, moved away from each lamp."""
    lit = buffers.lit.copy()
    nearness = 1 / max(scale * float(np.median(layer.distance)), 0.05) - 1 / rng.uniform(0.9, 1.4)
    median_mm = float(np.exp(np.nanmedian(buffers.log_distance)))
    for n in np.flatnonzero(np.isfinite(buffers.lamps_mm).all(1)):
        offset = -buffers.lamps_mm[n, :2] / median_mm * nearness * buffers.camera[1]
        move = np.array([[1, 0, offset[0]], [0, 1, offset[1]]], np.float32)
        outline = cv2.warpAffine(over, move, over.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        soft = cv2.GaussianBlur(outline, (0, 0), 0.4 + abs(float(np.hypot(*offset))) * rng.uniform(0.02, 0.25))
        lit[..., n] *= 1 - rng.uniform(0.6, 1.0) * soft
    return lit


def _blurred(image: np.ndarray, over: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Soft edges, and now and then motion: instruments move faster than the camera does."""
    both = np.dstack([image, over])
    sigma = rng.uniform(0.35, 0.7) if rng.random() < 0.8 else rng.uniform(0.7, 2.5) * over.shape[1] / 320
    both = cv2.GaussianBlur(both, (0, 0), sigma)
    if rng.random() < _MOVING:
        kernel = motion_kernel(max(int(rng.uniform(1, 14) * over.shape[1] / 320), 1), rng)
        both = cv2.filter2D(both, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    return both[..., :3], np.clip(both[..., 3], 0, 1)


def _harder(light: Light, rng: np.random.Generator) -> Light:
    """Tissue that is taken for instruments: pale, greyish, dyed, under stool or bile, with scars and fibrin."""
    tints, stains = light.tints.copy(), light.stains.copy()
    if rng.random() < 0.15:
        pale = rng.uniform(0.35, 0.85, (1, 1)) * rng.uniform([1.0, 0.85, 0.75], [1.1, 0.97, 0.97])
        tints[:INSTRUMENT] += rng.uniform(0.3, 0.9) * (pale - tints[:INSTRUMENT])
    if rng.random() < 0.35:
        dyes = ([0.35, 0.6, 1.7], [0.5, 1.2, 1.4], [1.6, 2.6, 3.0], [1.3, 1.6, 1.6], [1.1, 1.0, 0.3], [0.5, 0.5, 0.2])
        rgb = np.array(dyes[rng.integers(len(dyes))]) * rng.uniform(0.8, 1.2, 3)
        stains[rng.integers(2)] = rng.uniform(-0.1, 0.45), rng.uniform(0.01, 0.2), *rgb
    return light._replace(tints=np.clip(tints, 0.01, 0.95), stains=stains)
