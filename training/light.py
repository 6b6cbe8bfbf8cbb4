"""From the bare buffers of a scene to linear light at the lens: tissue, paint, wetness and one or two lamps, at random.

Irradiance from a lamp beside the lens falls as cosine over squared distance, in a share of the scenes also beside the
axis of a narrow beam, which need not be the view's; in a share, tissue is darker the nearer it is. What comes back is a
diffuse part, a wet coat that mirrors the lamp (sharp where the film is calm, broad where it is not) and light that
bounced between walls.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit

from training.buffers import Buffers
from training.scene import COLON, LAPAROSCOPY, WALL, log_uniform

INSTRUMENT = 7
_PARTS = 8
# Shares of closed and of open scenes: in open ones the lamp's beam is seen to end, and organs lie before walls. Chosen,
# not measured: few enough that dark still means far more often than near.
_BEAM_SHARES, _DARK_NEAR_SHARES = (0.1, 0.3), (0.04, 0.2)
_TISSUES = np.array(
    [
        [0.64, 0.27, 0.17],
        [0.62, 0.36, 0.24],
        [0.52, 0.20, 0.16],
        [0.30, 0.07, 0.06],
        [0.66, 0.42, 0.18],
        [0.60, 0.44, 0.36],
        [0.70, 0.34, 0.30],
        [0.45, 0.13, 0.10],
        [0.72, 0.60, 0.50],
    ]
)


class Light(NamedTuple):
    """How a scene is lit and painted; drawn by `draw_light`.

    tints : (8, 3) linear RGB of each part. gloss : (8,) strength of mirroring of each part.
    mottling : (5,) strength of each period of noise. tone : (3,) how mottling colours.
    vessels : (2, 2) width (in units of the noise) and depth of colour. vessel_rgb : (3,).
    stains : (2, 5) threshold (in units of the noise, above 1: none), softness, RGB that it multiplies by.
    lamps : (2,) brightness. fall : (4,) powers of distance and cosine, of the lamp's own axis, least cosine.
    coat : (5,) sharpness and strength of the sharp, then of the broad coat; tilt of the film.
    beams : (2, 5) of each lamp: its axis's tilt to the right and down and the angle of half power, all as shares of the
        widest ray's angle; steepness (2: a Gaussian spot, 8: even within and dark beside, as a vignetted beam is);
        share of the light that goes everywhere. An angle of inf: no beam.
    near : (3,) share by which near tissue is darker; ln of the distance, as a share of the median, where half of that
        is reached; ln distance over which. A share of 0: nothing is.
    """

    tints: np.ndarray
    gloss: np.ndarray
    mottling: np.ndarray
    tone: np.ndarray
    vessels: np.ndarray
    vessel_rgb: np.ndarray
    stains: np.ndarray
    lamps: np.ndarray
    fall: np.ndarray
    coat: np.ndarray
    beams: np.ndarray
    near: np.ndarray


def draw_light(rng: np.random.Generator, kind: int = COLON) -> Light:
    """Return a random light and paint for a scene of that kind: mostly mild textures, seldom strong, wet and dry."""
    # From a stream of its own: what else is drawn of `rng`, here and later, does not change.
    aside, is_open = rng.spawn(1)[0], kind in (LAPAROSCOPY, WALL)
    base = _TISSUES[rng.integers(len(_TISSUES))] * rng.uniform(0.75, 1.25, 3)
    other = _TISSUES[rng.integers(len(_TISSUES), size=_PARTS)] * rng.uniform(0.7, 1.3, (_PARTS, 3))
    # Parts of one organ look alike, organs do not.
    alike = rng.random((_PARTS, 1)) if rng.random() < 0.5 else rng.uniform(0.7, 1.0, (_PARTS, 1))
    tints = alike * base + (1 - alike) * other
    tints[0] = base
    tints[INSTRUMENT] = _instrument(rng)
    wetness = rng.choice([0.0, rng.uniform(0, 1), rng.uniform(0.5, 2.0)], p=[0.15, 0.5, 0.35])
    gloss = wetness * rng.uniform(0.7, 1.3, _PARTS)
    gloss[INSTRUMENT] = rng.uniform(0.2, 3.0)
    strength = rng.choice([0.0, rng.uniform(0, 1.0), rng.uniform(1.0, 2.2)], p=[0.1, 0.65, 0.25])
    vessels = np.stack([rng.uniform(0.02, 0.12, 2), strength * rng.uniform(0, 1.0, 2) * (rng.random(2) < 0.7)], -1)
    broad = rng.uniform(0.0, 0.35) if rng.random() < 0.4 else 0.0
    return Light(
        tints=np.clip(tints, 0.01, 0.95),
        gloss=gloss,
        mottling=strength * rng.uniform(0, 1, 5) * np.array([0.5, 0.5, 0.4, 0.4, 0.4]),
        tone=rng.uniform(-0.3, 0.1, 3) * [0.2, 1, 1],
        vessels=vessels,
        vessel_rgb=rng.uniform([0.6, 0.25, 0.3], [0.9, 0.6, 0.7]),
        stains=np.stack([_blood(rng), _mucus(rng)]),
        lamps=np.array([1.0, rng.uniform(0.3, 1.0)]),
        fall=np.array([rng.uniform(1.8, 2.15), rng.uniform(0.6, 1.15), rng.uniform(0, 2.0), rng.uniform(0.0, 0.08)]),
        coat=np.array(
            [np.exp(rng.uniform(3.0, 7.3)), rng.uniform(0.3, 4.0), rng.uniform(2, 15), broad, rng.uniform(0.02, 0.5)]
        ),
        beams=_beams(aside, _BEAM_SHARES[is_open]),
        near=_dark_near(aside, _DARK_NEAR_SHARES[is_open]),
    )


def _beams(rng: np.random.Generator, share: float) -> np.ndarray:
    """Beams (2, 5) of both lamps, in a share of the scenes: spots and vignetted ones, also beside the view's axis."""
    beams = np.tile([0.0, 0.0, np.inf, 2.0, 0.0], (2, 1))
    if rng.random() >= share:
        return beams
    steepness = 2.0 if rng.random() < 0.5 else rng.uniform(2.0, 8.0)
    tilt = rng.normal(0, 0.3, 2) if rng.random() < 0.5 else np.zeros(2)
    beams[:] = *tilt, rng.uniform(0.3, 1.0), steepness, rng.uniform(0, 0.1) * (rng.random() < 0.5)
    # Two fibre bundles of one instrument differ little.
    beams[1, :2] += rng.normal(0, 0.05, 2)
    return beams


def _dark_near(rng: np.random.Generator, share: float) -> np.ndarray:
    """How much darker near tissue is, (3,), in a share of the scenes."""
    # Down to an eighth, as the green of liver against that of fat in `_TISSUES`, and half that where blood is on it.
    strength = 1 - log_uniform(rng, 0.06, 0.5) if rng.random() < share else 0.0
    return np.array([strength, rng.uniform(-0.5, 0.3), rng.uniform(0.03, 0.2)])


def shade(buffers: Buffers, light: Light, bounce: float) -> np.ndarray:
    """Return linear light (H, W, 3) float32 before exposure, the median of what is lit being about 1; 0 = nothing hit.

    bounce : share of the light that comes from other walls, 0..0.6.
    """
    distance_mm = np.exp(buffers.log_distance)
    out = np.zeros((*distance_mm.shape, 3), np.float32)
    albedo = np.zeros_like(out)
    axes, spreads = _axes_and_spreads(buffers.rays, light.beams)
    _shade(
        distance_mm,
        buffers.rays,
        buffers.normal,
        buffers.noise,
        buffers.part,
        buffers.lit,
        buffers.lamps_mm.astype(np.float64),
        light,
        (axes, spreads, _median(distance_mm)),
        out,
        albedo,
    )
    lit = brightest(out)
    level = float(np.median(lit[lit > 0])) if (lit > 0).any() else 1.0
    out /= np.float32(max(level, 1e-12))
    if bounce > 0:
        out += np.float32(bounce) * albedo * _bounced(out)
    return out


def beam_shares(rays: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """Return the share (H, W) float32, 0..1, of its axis's light that the first lamp of `Light.beams` sends along rays.

    rays : (H, W, 3) unit, of a view. The lamp is taken to be at the lens: it is near, against what it lights.
    """
    axes, spreads = _axes_and_spreads(rays, beams)
    out = np.empty(rays.shape[:2], np.float32)
    _send(rays, axes[0], spreads[0], out)
    return out


def _axes_and_spreads(rays: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes (2, 3), unit, of the lamps, and (2, 3) angle of half power, rad, steepness and share sent everywhere."""
    widest = float(np.arccos(np.clip(rays[..., 2].min(), -1, 1)))
    tilt = widest * beams[:, :2]
    angle = np.linalg.norm(tilt, axis=1, keepdims=True)
    axes = np.hstack([tilt * np.sinc(angle / np.pi), np.cos(angle)])
    return axes, np.column_stack([widest * beams[:, 2], beams[:, 3:]])


def _median(distance_mm: np.ndarray) -> float:
    return float(np.nanmedian(distance_mm)) if np.isfinite(distance_mm).any() else 1.0


def brightest(light: np.ndarray) -> np.ndarray:
    """Return the largest channel (H, W) of (H, W, 3); numpy's own maximum along a short axis is slow."""
    return np.maximum(np.maximum(light[..., 0], light[..., 1]), light[..., 2])


def _bounced(light: np.ndarray) -> np.ndarray:
    """Light that arrives from the walls around, (H, W, 3): a wide mean of what they send out."""
    height, width = light.shape[:2]
    small = cv2.resize(np.minimum(light, 8.0), (max(width // 8, 4), max(height // 8, 4)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), 2.5), (width, height), interpolation=cv2.INTER_LINEAR)


def _instrument(rng: np.random.Generator) -> np.ndarray:
    """Black plastic, bare metal, or coated shafts, which are bluish as often as not."""
    grey = rng.choice([rng.uniform(0.02, 0.1), rng.uniform(0.1, 0.8)])
    return grey * rng.uniform([0.7, 0.85, 0.95], [1.1, 1.1, 1.5])


def _blood(rng: np.random.Generator) -> np.ndarray:
    threshold = rng.uniform(0.05, 0.5) if rng.random() < 0.12 else 2.0
    return np.array([threshold, rng.uniform(0.05, 0.3), 0.55, rng.uniform(0.05, 0.2), rng.uniform(0.04, 0.15)])


def _mucus(rng: np.random.Generator) -> np.ndarray:
    threshold = rng.uniform(0.1, 0.5) if rng.random() < 0.2 else 2.0
    return np.array([threshold, rng.uniform(0.02, 0.3), 1.15, rng.uniform(1.2, 2.0), rng.uniform(0.8, 2.2)])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _paint(noise, part, light, rgb):  # type: ignore[no-untyped-def]
    """Write the albedo of a pixel into rgb (3,)."""
    mottling = 0.0
    for k in range(5):
        mottling += light.mottling[k] * noise[k]
    red, brightness = noise[0] + noise[1], np.exp(mottling)
    for c in range(3):
        rgb[c] = light.tints[part, c] * brightness * max(1.0 + light.tone[c] * red, 0.2)
    if part == INSTRUMENT:
        for c in range(3):
            rgb[c] = light.tints[part, c]
        return
    for k in range(2):
        width, depth = light.vessels[k, 0], light.vessels[k, 1]
        if depth > 0:
            away = noise[5 + k] / width
            if abs(away) < 2.5:
                stain = depth * np.exp(-away * away) * min(max(0.5 + 2.0 * noise[1 - k], 0.0), 1.0)
                for c in range(3):
                    rgb[c] *= 1.0 - min(stain, 1.0) * (1.0 - light.vessel_rgb[c])
    for k in range(2):
        here = (noise[1] if k == 0 else noise[7]) + 0.5 * noise[2] + 0.25 * noise[3]
        share = min(max((here - light.stains[k, 0]) / light.stains[k, 1], 0.0), 1.0)
        if share > 0:
            for c in range(3):
                rgb[c] *= 1.0 + share * (light.stains[k, 2 + c] - 1.0)
    for c in range(3):
        rgb[c] = min(rgb[c], 0.98)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _mirrored(normal, noise, tilt, view, towards):  # type: ignore[no-untyped-def]
    """Cosine between the wavy film's normal and the direction halfway between the eye and the lamp."""
    total, square, length = 0.0, 0.0, 0.0
    for c in range(3):
        wavy = normal[c] + tilt * (noise[2 + c] + noise[(3 + 2 * c) % 5])
        half = towards[c] - view[c]
        total, square, length = total + wavy * half, square + wavy * wavy, length + half * half
    return max(total / np.sqrt(square * length + 1e-12), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _sent(cosine, spread):  # type: ignore[no-untyped-def]
    """Share of its axis's light that a lamp sends at an angle to it; spread (3,) as `_axes_and_spreads` has it."""
    angle = np.arccos(min(max(cosine, -1.0), 1.0)) / spread[0]
    return spread[2] + (1.0 - spread[2]) * np.exp2(-(angle ** spread[1]))


@njit(cache=True, nogil=True, error_model="numpy")
def _send(rays, axis, spread, out):  # type: ignore[no-untyped-def]
    """Fill out (H, W) with what is sent along unit rays (H, W, 3)."""
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            ray = rays[row, column]
            out[row, column] = _sent(ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2], spread)


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(distance, rays, normals, noises, parts, lit, lamps_mm, light, beams, out, albedo):  # type: ignore[no-untyped-def]
    """Fill out and albedo (H, W, 3); beams: axes, spreads, median distance."""
    towards = np.empty(3)
    axes, spreads, median_mm = beams
    for row in range(distance.shape[0]):
        for column in range(distance.shape[1]):
            reach = distance[row, column]
            if not reach > 0:
                continue
            view, normal, noise = rays[row, column], normals[row, column], noises[row, column]
            part, rgb = parts[row, column], albedo[row, column]
            _paint(noise, part, light, rgb)
            if light.near[0] > 0 and part != INSTRUMENT:
                nearer = 1.0 / (1.0 + np.exp((np.log(reach / median_mm) - light.near[1]) / light.near[2]))
                for c in range(3):
                    rgb[c] *= 1.0 - light.near[0] * nearer
            wet = light.gloss[part] * min(max(0.4 + 2.0 * noise[7], 0.0), 1.5)
            for n in range(2):
                seen = lit[row, column, n] * light.lamps[n]
                if seen <= 0:
                    continue
                square, cosine = 0.0, 0.0
                for c in range(3):
                    towards[c] = lamps_mm[n, c] - reach * view[c]
                    square += towards[c] * towards[c]
                to_lamp = np.sqrt(square)
                for c in range(3):
                    towards[c] /= to_lamp
                    cosine += towards[c] * normal[c]
                axis = max(-towards[2], 0.05)
                power = seen * np.exp(light.fall[2] * np.log(axis) - light.fall[0] * np.log(to_lamp))
                if np.isfinite(spreads[n, 0]):
                    along = 0.0
                    for c in range(3):
                        along -= towards[c] * axes[n, c]
                    power *= _sent(along, spreads[n])
                diffuse = power * max(cosine, light.fall[3]) ** light.fall[1]
                mirror = 0.0
                if wet > 0:
                    logarithm = np.log(_mirrored(normal, noise, light.coat[4], view, towards) + 1e-6)
                    if light.coat[0] * logarithm > -8:
                        mirror = light.coat[1] * np.exp(light.coat[0] * logarithm)
                    if light.coat[3] > 0:
                        mirror += light.coat[3] * np.exp(light.coat[2] * logarithm)
                for c in range(3):
                    out[row, column, c] += diffuse * rgb[c] + power * wet * mirror
