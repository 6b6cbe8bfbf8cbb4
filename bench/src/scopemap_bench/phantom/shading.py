"""Shading of a surface to linear light, and the camera's 8-bit image of it.

The light is at the camera: irradiance falls as cosine over squared distance, and a wet spot that faces it reflects it.
"""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap_bench.phantom.march import SurfaceBuffers, rays_of
from scopemap_bench.phantom.spec import EventName
from scopemap_bench.phantom.volume import noise_at

_FILM_TILT = 0.3
_HIGHLIGHT_SHARPNESS = 350.0
_HIGHLIGHT_STRENGTH = 1.6
_VIGNETTE = 0.35
_KNEE = 0.6
_OPTICS_SIGMA_PX = 0.55
_EXPOSED_SHARE = 80.0
_EXPOSED_LEVEL = 0.48
_SHOT_NOISE = 2.5
_BLUR_PX = 13
_WATER_PX = 5.0
_WATER_LENGTH_PX = 40.0
_WATER_FRAMES = 7.0
_WATER_RGB = np.array([0.55, 0.45, 0.22], np.float32)
_SMOKE_GREY = np.array([0.42, 0.43, 0.44], np.float32)


def shade(
    surface: SurfaceBuffers,
    albedo: np.ndarray,
    ripple: np.ndarray,
    film: np.ndarray,
    camera: CameraModel,
    indirect: float = 0.0,
) -> np.ndarray:
    """Return linear radiance (H, W, 3) float32, per mm^2 of distance, before exposure; 0 where nothing is seen.

    `albedo` (H, W, 3) linear RGB, `ripple` (H, W, 3) tilt of the fluid film, `film` (H, W) strength of reflection.
    `indirect` : share of the lamp's light that reaches every point alike after scattering in the cavity.
    """
    rays = rays_of(camera).astype(np.float32)
    towards = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    light = 1.0 / surface.distance_mm[..., None] ** 2
    cosine = np.clip((surface.normal * towards).sum(-1, keepdims=True), 0, 1)
    irradiance = cosine * light
    if indirect > 0 and np.isfinite(irradiance).any():
        irradiance = irradiance + indirect * np.nanmean(irradiance)
    radiance = albedo * irradiance
    if film.any():
        wet = surface.normal + _FILM_TILT * ripple
        wet /= np.linalg.norm(wet, axis=-1, keepdims=True)
        mirrored = np.clip((wet * towards).sum(-1, keepdims=True), 0, 1) ** _HIGHLIGHT_SHARPNESS
        radiance = radiance + film[..., None] * _HIGHLIGHT_STRENGTH * mirrored * light
    return np.nan_to_num(radiance, nan=0.0, posinf=0.0).astype(np.float32)


def vignette(camera: CameraModel) -> np.ndarray:
    """Return the lens's transmission (H, W, 1) float32: 1 at the centre, less towards the corners."""
    # By the place in the image: a fisheye's widest rays have no end on the plane z = 1.
    squared = (camera.central.rays[..., :2] ** 2).sum(-1, keepdims=True)
    return 1.0 - _VIGNETTE * squared / squared.max()


def exposure_for(radiance: np.ndarray) -> float:
    """Return the gain that exposes `radiance` (H, W, 3) well: its 80th percentile at level 0.48."""
    lit = radiance.max(-1)
    lit = lit[lit > 0]
    return _EXPOSED_LEVEL / float(np.percentile(lit, _EXPOSED_SHARE)) if lit.size else 1.0


def disturb(linear: np.ndarray, kinds: set[EventName], rng: np.random.Generator, index: int = 0) -> np.ndarray:
    """Return exposed light (H, W, 3) of frame `index` seen through water, with smoke, with blur, or all black."""
    if "fluid" in kinds:
        linear = _fluid(linear, index)
    if "smoke" in kinds:
        linear = _smoke(linear, rng)
    if "blur" in kinds:
        linear = _blur(linear, rng)
    return np.zeros_like(linear) if "black" in kinds else linear


def develop(linear: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Return the 8-bit sRGB picture (H, W, 3) of exposed light: optics, sensor noise, highlight knee, sRGB curve.

    `noise` is the read noise as a share of the linear range; shot noise grows with the root of the signal.
    """
    signal = cv2.GaussianBlur(linear, (0, 0), _OPTICS_SIGMA_PX)
    if noise > 0:
        deviation = noise * np.sqrt(1.0 + _SHOT_NOISE**2 * np.clip(signal, 0, 1))
        signal = signal + deviation * rng.standard_normal(signal.shape, np.float32)
    signal = np.where(signal > _KNEE, _KNEE + 0.45 * (1 - np.exp((_KNEE - signal) / 0.45)), signal)
    signal = np.clip(signal, 0, 1)
    encoded = np.where(signal <= 0.0031308, 12.92 * signal, 1.055 * np.maximum(signal, 1e-6) ** (1 / 2.4) - 0.055)
    return np.rint(255 * encoded).astype(np.uint8)


def _fluid(linear: np.ndarray, index: int) -> np.ndarray:
    """Bend the view by water that runs over the lens, and cloud it where it carries something along."""
    height, width = linear.shape[:2]
    px = width / 320
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    points = np.stack([x, y - 6.0 * px * index, np.full_like(x, index * _WATER_LENGTH_PX * px / _WATER_FRAMES)], -1)
    bend = [_WATER_PX * px * noise_at(points, _WATER_LENGTH_PX * px, seed).astype(np.float32) for seed in (71, 72)]
    bent = cv2.remap(linear, x + bend[0], y + bend[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    thickness = np.clip(1.4 * noise_at(points, 2 * _WATER_LENGTH_PX * px, 73), 0, 0.7)[..., None].astype(np.float32)
    return bent * (1 - thickness) + float(linear.mean()) * _WATER_RGB / _WATER_RGB.mean() * thickness


def _smoke(linear: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = linear.shape[:2]
    clouds = cv2.resize(
        rng.uniform(0.55, 0.9, (4, 5)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    thickness = np.clip(clouds, 0, 1)[..., None]
    return linear * (1 - thickness) + _SMOKE_GREY * thickness


def _blur(linear: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Smear along a random direction, then defocus; lengths are given for 320 px and grow with the picture."""
    scale = linear.shape[1] / 320
    length = max(int(_BLUR_PX * scale), 3)
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    angle = rng.uniform(0, np.pi)
    for step in np.linspace(-length, length, 4 * length):
        kernel[round(length + step * np.sin(angle)), round(length + step * np.cos(angle))] = 1.0
    return cv2.GaussianBlur(cv2.filter2D(linear, -1, kernel / kernel.sum()), (0, 0), 3.0 * scale)
