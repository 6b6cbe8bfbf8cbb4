"""From linear light to the 8-bit picture of a real endoscope: air, lens, sensor, processor, coding, field of view."""

from __future__ import annotations

import cv2
import numpy as np

from scopemap.engine.geometry.srgb import srgb_picture
from training.light import brightest


def take_picture(light: np.ndarray, rng: np.random.Generator, *, strange: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture (H, W, 3) uint8 sRGB of linear light (H, W, 3), and its field of view (H, W) bool.

    Each effect is drawn on its own: most pictures have a few, some have none. With `strange` half of them also have
    what no light or tissue explains, and half have their colours mixed anew.
    """
    height, width = light.shape[:2]
    scale = width / 320
    light = light * _vignette(height, width, rng) * rng.uniform(0.8, 1.25, 3).astype(np.float32)
    if strange:
        if rng.random() < 0.5:
            light = light * _stranger(height, width, rng)
        if rng.random() < 0.5:
            light = _recoloured(light, rng)
    light = _exposed(light, rng)
    if rng.random() < 0.4:
        # Glare: the lens scatters a little of all light over the whole picture.
        light = light + np.float32(rng.uniform(0, 0.05)) * light.mean((0, 1))
    if rng.random() < 0.10:
        light = _smoke(light, rng)
    if rng.random() < 0.10:
        light = _bubbles(light, scale, rng)
    if rng.random() < 0.4:
        light = _bloom(light, scale, rng)
    light = _blurred(light, scale, rng)
    field = field_of_view(height, width, rng)
    rgb = _encoded(_noisy(light * field[..., None], rng), rng)
    if rng.random() < 0.7:
        # Processors paint the surround black; in the others it is only unlit.
        rgb = rgb * field[..., None]
    return _coded(rgb, rng), field


def field_of_view(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Return a random field of view (H, W) bool: full, disc, cut disc, octagon or rounded rectangle."""
    kind = rng.choice(["full", "disc", "octagon", "rounded"], p=[0.5, 0.25, 0.15, 0.1])
    if kind == "full":
        return np.ones((height, width), bool)
    v, u = np.mgrid[:height, :width].astype(np.float32)
    x = np.abs(u - width * rng.uniform(0.46, 0.54)) / (width / 2)
    y = np.abs(v - height * rng.uniform(0.46, 0.54)) / (height / 2)
    if kind == "disc":
        radius = rng.uniform(0.75, 1.2)
        return np.hypot(x * width, y * height) < radius * max(width, height)
    if kind == "octagon":
        return x + y < rng.uniform(1.3, 1.75)
    power = rng.uniform(3, 8)
    return x**power + y**power < rng.uniform(0.8, 1.2)


def _vignette(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    v, u = np.mgrid[:height, :width].astype(np.float32)
    square = ((u / width - 0.5) ** 2 + (v / height - 0.5) ** 2) / 0.5
    return (1.0 - rng.uniform(0, 0.6) * square)[..., None].astype(np.float32)


def _stranger(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """What no model of ours explains: smooth patches of the picture brighter or darker, by up to half, hardly coloured.

    Real tissue is painted and lit in ways that we did not think of; who has seen only ours takes every such patch for
    shape.
    """
    factor = np.zeros((height, width, 3), np.float32)
    for _ in range(rng.integers(1, 3)):
        cells = int(rng.integers(2, 12))
        field = rng.normal(0, rng.uniform(0.05, 0.25), (cells, cells + 1, 1)) * (1 + rng.normal(0, 0.1, 3))
        factor += cv2.resize(field.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return np.exp(factor)


def _recoloured(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Colours mixed anew, now and then to nearly none, grey left grey: depth must not be read off our tissues' hue."""
    mix = np.eye(3) + rng.normal(0, 0.12, (3, 3))
    if rng.random() < 0.2:
        grey = rng.uniform(0.5, 1.0)
        mix = (1 - grey) * mix + grey / 3
    mix = np.clip(mix, -0.2, 1.2)
    return np.maximum(light @ (mix / mix.sum(1, keepdims=True)).T.astype(np.float32), 0)


def _exposed(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Expose for a random share of the picture: in a third of them the near wall saturates, some are dark."""
    lit = brightest(light)
    lit = lit[lit > 0]
    if not lit.size:
        return light
    level = np.exp(rng.normal(np.log(0.55), 0.5))
    return light * np.float32(level / max(float(np.percentile(lit, rng.uniform(58, 96))), 1e-9))


def _smoke(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = light.shape[:2]
    clouds = cv2.resize(rng.random((4, 5), np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    thickness = (np.clip(clouds, 0, 1) * np.float32(rng.uniform(0.1, 0.6)))[..., None]
    grey = np.float32(rng.uniform(0.1, 0.5)) * rng.uniform(0.9, 1.1, 3).astype(np.float32)
    return light * (1 - thickness) + grey * thickness


def _bubbles(light: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    """Foam: rings that are dark inside their rim, with a mirrored lamp in each."""
    layer = np.ones(light.shape[:2], np.float32)
    shine = np.zeros(light.shape[:2], np.float32)
    height, width = light.shape[:2]
    middle = rng.uniform([0, 0], [width, height])
    for _ in range(rng.integers(3, 40)):
        x, y = (int(n) for n in middle + rng.normal(0, 40 * scale, 2))
        radius = max(int(np.exp(rng.uniform(0.5, 2.8)) * scale), 1)
        cv2.circle(layer, (x, y), radius, rng.uniform(0.5, 1.0), max(int(scale), 1), cv2.LINE_AA)
        cv2.circle(shine, (x - radius // 3, y - radius // 3), max(radius // 5, 1), rng.uniform(0.5, 2.0), -1)
    return light * layer[..., None] + shine[..., None]


def _bloom(light: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    over = np.clip(light - 0.8, 0, 6.0)
    if not over.any():
        return light
    sigma = rng.uniform(2.0, 8.0) * scale
    return light + np.float32(rng.uniform(0.05, 0.5)) * cv2.GaussianBlur(over, (0, 0), sigma)


def _blurred(light: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    sigma = rng.choice([rng.uniform(0.3, 0.8), rng.uniform(0.8, 2.5)], p=[0.75, 0.25]) * max(scale, 0.6)
    light = cv2.GaussianBlur(light, (0, 0), sigma)
    if rng.random() < 0.12:
        light = cv2.filter2D(light, -1, motion_kernel(max(int(rng.uniform(2, 10) * scale), 1), rng))
    if rng.random() < 0.3:
        # Processors sharpen; edges get halos.
        light = np.maximum(light + rng.uniform(0.2, 1.5) * (light - cv2.GaussianBlur(light, (0, 0), 1.2)), 0)
    return light.astype(np.float32)


def motion_kernel(reach: int, rng: np.random.Generator) -> np.ndarray:
    """Return the kernel (2 reach + 1, 2 reach + 1) of a motion in a random direction, of sum 1."""
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    angle = rng.uniform(0, np.pi)
    dx, dy = reach * np.cos(angle), reach * np.sin(angle)
    cv2.line(kernel, (round(reach - dx), round(reach - dy)), (round(reach + dx), round(reach + dy)), 1.0)
    return kernel / kernel.sum()


def _noisy(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    read = np.float32(np.exp(rng.uniform(np.log(0.0003), np.log(0.006))))
    grain = rng.standard_normal(light.shape, np.float32)
    if rng.random() < 0.4:
        grain = 2.0 * cv2.GaussianBlur(grain, (0, 0), 0.8)
    return light + read * np.sqrt(1.0 + 6.0 * np.clip(light, 0, 1)) * grain


def _encoded(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Tone curve and sRGB: a power of 0.42 to 1.08, mostly near 0.75, makes light fall as distance^-0.9 to -2.2."""
    knee = rng.uniform(0.4, 1.0)
    light = np.maximum(light, 0)
    power = np.float32(0.42 + 0.66 * rng.beta(2, 2))
    rest = 1 - knee + 1e-3
    light = np.where(light > knee, knee + rest * (1 - np.exp(np.minimum(knee - light, 0) / rest)), light)
    light = np.maximum(light, 1e-6)
    if rng.random() < 0.6:
        # On brightness alone: colours stay as deep as they are.
        light = light * brightest(light)[..., None] ** (power - 1)
    else:
        light = light**power
    grey = light.mean(-1, keepdims=True)
    light = grey + np.float32(rng.uniform(0.7, 1.5)) * (light - grey)
    light = light * rng.uniform(0.85, 1.15, 3).astype(np.float32) + np.float32(rng.uniform(0, 0.01))
    return srgb_picture(np.clip(light, 0, 1))


def _coded(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """JPEG or nothing, at the size itself or from a smaller picture."""
    if rng.random() < 0.15:
        height, width = rgb.shape[:2]
        share = rng.uniform(0.5, 0.9)
        small = cv2.resize(rgb, (max(int(width * share), 8), max(int(height * share), 8)), interpolation=cv2.INTER_AREA)
        rgb = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.5:
        _, data = cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(35, 97))])
        rgb = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return rgb
