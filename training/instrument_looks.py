"""What instruments are made of, at random, and how they look under the lamps of a scene.

A coat mirrors the lamps as on tissue; metal moreover mirrors the surroundings, as bands that are bright and dark. What
brushed metal, coated shafts, print, rings, holes, weave and blood have in common is that none of it is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from training.instrument_layers import Layer
from training.instrument_shapes import ACCENT, SHAFT, SOFT, TIP
from training.light import Light
from training.scene import log_uniform

_WORDS = ("SURGERY", "STORZ", "5 mm", "MEDICAL", "III", "OLYMP", "1234", "CE 0123", "GRASP", "<-->")
_BLOOD = np.array([0.75, 0.12, 0.10])
_BRIGHTEST = 12.0


@dataclass(frozen=True)
class _Material:
    """rgb : (3,) linear. diffuse, coat : shares of light. sharp : power of the coat's cosine. mirror : of metal.

    ring : (4,) begin, period, share and brightness of rings along the axis. grain : of noise along and around.
    """

    rgb: np.ndarray
    diffuse: float
    coat: float
    sharp: float
    mirror: float
    ring: np.ndarray
    grain: np.ndarray
    word: np.ndarray | None


def light_of_instruments(
    layer: Layer, rays: np.ndarray, lamps: np.ndarray, light: Light, around: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return linear light (n, 3) float32 at the layer's pixels, where tissue at its median distance is about 1.

    rays : (n, 3) unit, camera axes. lamps : (2, 3), NaN: none; 1 = the tissue's median distance. around : (3,) mean
    light of the tissue, which is mirrored.
    """
    out = np.zeros((len(layer.pixel), 3), np.float32)
    gain = np.exp(rng.normal(-0.35, 0.5))
    materials = layer.materials[layer.row]
    for key in np.unique(materials, axis=0):
        mine = (materials == key).all(1)
        out[mine] = gain * _shaded(layer, mine, rays[mine], lamps, light, around, _material(int(key[1]), rng), rng)
    return np.minimum(out, _BRIGHTEST)


def _shaded(
    layer: Layer,
    mine: np.ndarray,
    rays: np.ndarray,
    lamps: np.ndarray,
    light: Light,
    around: np.ndarray,
    made: _Material,
    rng: np.random.Generator,
) -> np.ndarray:
    normal, reach = layer.normal[mine], layer.distance[mine, None]
    along, turn = layer.along[mine], layer.around[mine]
    rgb = _painted(made, along, turn, rng)
    out = np.zeros_like(rgb)
    for n in range(2):
        towards = lamps[n] - reach * rays
        if not np.isfinite(towards).all():
            continue
        far = np.linalg.norm(towards, axis=1, keepdims=True)
        towards = towards / far
        half = towards - rays
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        power = light.lamps[n] * far ** -light.fall[0]
        cosine = np.maximum((normal * towards).sum(1, keepdims=True), light.fall[3])
        shine = made.coat * np.maximum((normal * half).sum(1, keepdims=True), 0) ** made.sharp
        tint = rgb / max(float(made.rgb.max()), 0.05) if made.mirror > 0 else 1.0
        out += power * (2.0 * made.diffuse * rgb * cosine ** light.fall[1] + shine * tint)
    if made.mirror > 0:
        mirrored = rays - 2 * (rays * normal).sum(1, keepdims=True) * normal
        waves = mirrored @ rng.normal(0, rng.uniform(1, 7), (3, 2)) + rng.uniform(0, 6.3, 2)
        bands = np.clip(0.5 + 0.35 * np.sin(waves).sum(1, keepdims=True), 0, 1.2) ** rng.uniform(0.7, 2.5)
        grey = rng.uniform(0.1, 0.9)
        out += made.mirror * bands * rgb * (grey * around.mean() + (1 - grey) * around)
    return out.astype(np.float32)


def _painted(made: _Material, along: np.ndarray, turn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Colour (n, 3) of the places of one material: rings, print, grain, blood."""
    rgb = np.repeat(made.rgb[None], len(along), 0)
    begin, period, share, bright = made.ring
    on_ring = (np.mod(along - begin, period) < share * period) if share > 0 else np.zeros(len(along), bool)
    rgb[on_ring] = bright
    if made.word is not None:
        height, width = made.word.shape
        column = np.mod(along * 16 + begin * 16, width).astype(int)
        line = ((turn + 0.5) * 3 * height).astype(int) % (2 * height)
        inked = (line < height) & (made.word[np.minimum(line, height - 1), column] > 0)
        rgb[inked] = bright
    noise = made.grain[0] * np.sin(along * rng.uniform(5, 60) + 3 * np.sin(along * rng.uniform(0.5, 4)))
    noise += made.grain[1] * np.sin(turn * 6.28 * rng.integers(3, 40) + rng.uniform(0, 6.3))
    noise += made.grain[0] * rng.normal(0, 0.5, len(along))
    rgb = np.clip(rgb * (1 + noise[:, None]), 0.004, 0.97)
    if rng.random() < 0.25:
        place = np.sin(along * rng.uniform(0.2, 3) + rng.uniform(0, 6.3)) + np.sin(turn * 6.28 + rng.uniform(0, 6.3))
        stain = np.clip((place - rng.uniform(0, 1.8)) * 3, 0, 1)[:, None] * rng.uniform(0.3, 1)
        rgb = rgb * (1 - stain) + stain * _BLOOD * rng.uniform(0.2, 0.9) * rgb.mean(1, keepdims=True) * 1.5
    return rgb


def _material(material: int, rng: np.random.Generator) -> _Material:
    kinds = ("metal", "black", "grey", "white", "coloured")
    likely = {
        SHAFT: (0.30, 0.25, 0.20, 0.07, 0.18),
        TIP: (0.80, 0.06, 0.05, 0.03, 0.06),
        ACCENT: (0.30, 0.30, 0.10, 0.10, 0.20),
        SOFT: (0.0, 0.10, 0.05, 0.60, 0.25),
    }[material]
    kind = str(rng.choice(kinds, p=likely))
    ring = np.array([rng.uniform(0, 10), log_uniform(rng, 0.5, 20), 0.0, rng.choice([0.02, 0.85])])
    if rng.random() < 0.15:
        ring[2] = rng.uniform(0.05, 0.5)
    worded = material == SHAFT and rng.random() < 0.2
    coat, sharp = (
        rng.choice([0.0, rng.uniform(0.05, 1.0), rng.uniform(0.5, 4.0)], p=[0.1, 0.5, 0.4]),
        log_uniform(rng, 5, 300),
    )
    grain = rng.uniform(0, 0.15, 2) * (rng.random(2) < 0.4)
    if material == SOFT:
        return _Material(_colour(kind, rng), 1.0, 0.05 * coat, 10.0, 0.0, ring, rng.uniform(0.0, 0.25, 2), None)
    if kind == "metal":
        shares = rng.uniform(0.1, 0.9), 1.5 * coat, log_uniform(rng, 4, 200), rng.uniform(0.2, 1.5)
    else:
        shares = 1.0, coat, sharp, 0.0
    return _Material(_colour(kind, rng), *shares, ring, grain, _printed(rng) if worded else None)


def _colour(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Linear colour (3,) of a kind of material; red, which tissue has, is rare."""
    if kind == "coloured":
        hue = rng.uniform(20, 150) if rng.random() < 0.9 else rng.uniform(-12, 20)
        hsv = np.array([[[hue % 180, rng.uniform(60, 255), rng.uniform(60, 250)]]]).astype(np.uint8)
        return (cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0] / 255.0) ** 2.2
    grey = {"metal": (0.15, 0.8), "black": (0.008, 0.06), "grey": (0.08, 0.5), "white": (0.55, 0.95)}[kind]
    tint = np.exp(rng.normal(0, 0.06, 3))
    if kind == "grey":
        tint *= np.array([1.0, rng.uniform(1.0, 1.1), rng.uniform(0.95, 1.35)])
    if kind == "metal" and rng.random() < 0.1:
        tint = np.array([1.1, 0.85, 0.5])  # brass
    return np.clip(rng.uniform(*grey) * tint, 0.005, 0.97)


def _printed(rng: np.random.Generator) -> np.ndarray:
    """Words as they are printed on shafts, (24, 220) uint8."""
    word = np.zeros((24, 220), np.uint8)
    cv2.putText(word, str(rng.choice(_WORDS)), (6, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2)
    return word
