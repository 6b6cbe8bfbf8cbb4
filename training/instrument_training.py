"""The head that finds instruments: pictures drawn for it, its training on a trunk at rest, threshold, figures."""

from __future__ import annotations

import math
import time
import tomllib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from scopemap.engine.config import MaskSettings
from scopemap.engine.masking.masker import Masker
from training.buffers import Store, cropped, open_store, thinned
from training.instrument_layers import LayerStore, part_of, render_layers
from training.instrument_samples import InstrumentSample, make_instrument_sample
from training.network import InstrumentHead, ScopeNet
from training.render import counted, render_store

Say = Callable[[str], None]


@dataclass(frozen=True)
class Recipe:
    """Settings: sets of scenes and layers (320x256 px), and the training; each may be changed by a TOML file.

    scenes, layers : rendered to train on. held_out : of both, with other seeds. steps : batches that are drawn. again :
    updates on older batches after each of them, of which `kept` are. rate, warm_up, decay, ema : of AdamW with a cosine
    and averaged weights. tissue_alone : share of the pictures without a layer. hard : of those that
    `make_instrument_sample` calls so. false_share : of the tissue's pixels that may lie above the threshold. pictures :
    that it and the figures are of.
    """

    seed: int = 0
    scene_seed: int = 2001
    layer_seed: int = 3001
    scenes: int = 240
    layers: int = 400
    held_out: int = 60
    steps: int = 650
    again: int = 3
    kept: int = 150
    rate: float = 4e-3
    warm_up: int = 50
    decay: float = 0.01
    ema: float = 0.997
    tissue_alone: float = 0.35
    hard: float = 1.0
    false_share: float = 0.005
    pictures: int = 120

    @classmethod
    def read(cls, file: Path) -> Recipe:
        """Return the recipe of a file that names some of the settings."""
        return cls(**tomllib.loads(file.read_text(encoding="utf-8")))


SIZE = (256, 320)
# Height, width, stride and batch of what is looked at, and its share of the steps: whole, every second pixel, a part.
_LOOKS = (((256, 320), 1, 4, 0.3), ((128, 160), 2, 16, 0.45), ((128, 160), 1, 16, 0.25))
_OUTSIDE = 0.3  # weight of what is outside the field of view
_BINS = np.linspace(-12, 12, 961)


class Pictures:
    """Draws samples of scenes with layers; equal seeds give equal samples."""

    def __init__(self, scenes: Store, layers: LayerStore, tissue_alone: float, hard: float) -> None:
        self._scenes, self._layers, self._alone, self._hard = scenes, layers, tissue_alone, hard

    def draw(self, seed: tuple[int, ...], size: tuple[int, int], stride: int) -> InstrumentSample:
        """Return a sample of that size, every `stride`-th pixel of what was rendered."""
        rng = np.random.default_rng(seed)
        top, left = (int(rng.integers(whole - stride * side + 1)) for whole, side in zip(SIZE, size, strict=True))
        buffers = self._scenes[int(rng.integers(len(self._scenes)))]
        buffers = thinned(cropped(buffers, top, left, (size[0] * stride, size[1] * stride)), stride)
        if not np.isfinite(buffers.log_distance).any():
            return self.draw((*seed, 1), size, stride)
        layer = None
        if rng.random() >= self._alone:
            layer = part_of(self._layers[int(rng.integers(len(self._layers)))], top, left, size, stride)
            layer = layer if len(layer.pixel) else None
        hard = bool(np.random.default_rng((*seed, 9)).random() < self._hard)
        return make_instrument_sample(buffers, layer, rng, hard=hard)


def rendered(recipe: Recipe, folder: Path, workers: int, say: Say, name: str) -> tuple[Store, LayerStore]:
    """Return the scenes and layers "train" or "held-out", rendered where the folder does not hold them."""
    n = ("train", "held-out").index(name)
    scenes, layers = (recipe.held_out, recipe.held_out) if n else (recipe.scenes, recipe.layers)
    progress = counted("layers", 200, say)
    shown = render_layers(folder / f"{name}-layers.npz", layers, SIZE, recipe.layer_seed + n, progress)
    progress = counted("scenes", 200, say)
    render_store(folder / name, scenes, SIZE, recipe.scene_seed + n, workers=workers, progress=progress)
    return open_store(folder / name), shown


def train_head(network: ScopeNet, pictures: Pictures, recipe: Recipe, say: Say) -> InstrumentHead:
    """Return the trained head (averaged weights); nothing else of the network is changed.

    A picture costs more to draw, and the trunk to run, than the head to train: batches of features are kept, and each
    new one is followed by updates on older ones.
    """
    head = network.instruments
    assert head is not None
    averaged = AveragedModel(head, multi_avg_fn=get_ema_multi_avg_fn(recipe.ema), use_buffers=True)
    optimiser = torch.optim.AdamW(head.parameters(), lr=recipe.rate, weight_decay=recipe.decay)
    half, began, losses, kept = torch.cpu._is_avx512_bf16_supported(), time.perf_counter(), [], deque[_Batch]()
    network.eval()
    head.train()
    for step in range(recipe.steps):
        for group in optimiser.param_groups:
            group["lr"] = recipe.rate * _share_of_rate(step, recipe)
        rng = np.random.default_rng((recipe.seed, 1, step))
        fresh = _batch(network, pictures, (recipe.seed, 2, step), rng, half=half)
        again = [kept[int(n)] for n in rng.integers(len(kept), size=recipe.again)] if kept else []
        for batch in (fresh, *again):
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                logits = head(batch.planes, batch.scales)
            loss = _loss(logits.float(), batch)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(head.parameters(), 1.0)
            optimiser.step()
            averaged.update_parameters(head)
            if batch is fresh:
                losses.append(float(loss.detach()))
        kept.append(fresh)
        if len(kept) > recipe.kept:
            kept.popleft()
        if (step + 1) % 50 == 0:
            say(f"step {step + 1} of {recipe.steps}: loss {np.mean(losses):.4f}, {time.perf_counter() - began:.0f} s")
            losses = []
    trained: InstrumentHead = averaged.module.eval()
    return trained


def _share_of_rate(step: int, recipe: Recipe) -> float:
    """Warm-up, then a cosine to 0.5 %."""
    way = max(step - recipe.warm_up, 0) / max(recipe.steps - recipe.warm_up, 1)
    return min((step + 1) / recipe.warm_up, 0.005 + 0.995 * 0.5 * (1 + math.cos(math.pi * way)))


class _Batch(NamedTuple):
    """Planes, features of the trunk, truth (N, 1, H/2, W/2) and its weight."""

    planes: Tensor
    scales: list[Tensor]
    truth: Tensor
    weight: Tensor


def _batch(
    network: ScopeNet, pictures: Pictures, seed: tuple[int, ...], rng: np.random.Generator, *, half: bool
) -> _Batch:
    size, stride, count, _ = _LOOKS[rng.choice(len(_LOOKS), p=[look[-1] for look in _LOOKS])]
    samples = [pictures.draw((*seed, n), size, stride) for n in range(count)]
    planes = torch.from_numpy(np.stack([s.planes for s in samples])).to(memory_format=torch.channels_last)
    with torch.autocast("cpu", torch.bfloat16, enabled=half), torch.no_grad():
        scales = network.features(planes)
    truth = torch.from_numpy(np.stack([s.instruments for s in samples]))[:, None]
    field = torch.from_numpy(np.stack([s.field for s in samples]).astype(np.float32))[:, None]
    weight = _OUTSIDE + (1 - _OUTSIDE) * functional.avg_pool2d(field, 2)
    return _Batch(planes, scales, functional.avg_pool2d(truth, 2), weight)


def _loss(logits: Tensor, batch: _Batch) -> Tensor:
    """Cross entropy and 1 - soft IoU, at half the resolution."""
    entropy = functional.binary_cross_entropy_with_logits(logits, batch.truth, batch.weight)
    probability = torch.sigmoid(logits)
    both = (probability * batch.truth).sum()
    either = (probability + batch.truth - probability * batch.truth).sum()
    return entropy + 0.3 * (1 - (both + 50) / (either + 50))


def fit_threshold(network: ScopeNet, scenes: Store, recipe: Recipe, false_share: float) -> float:
    """Return the logit that a share of the pixels lie above, on pictures of scenes without instruments."""
    pictures, counts = Pictures(scenes, LayerStore.empty(), 1.0, recipe.hard), np.zeros(len(_BINS) + 1)
    for n in range(recipe.pictures):
        sample = pictures.draw((88, n), SIZE, 1)
        if not sample.instruments.any():
            counts += np.bincount(np.digitize(_logits(network, sample).ravel(), _BINS), minlength=len(_BINS) + 1)
    above = np.cumsum(counts[::-1])[::-1][1:] / counts.sum()
    return float(_BINS[int(np.argmax(above <= false_share))])


def _logits(network: ScopeNet, sample: InstrumentSample) -> np.ndarray:
    assert network.instruments is not None
    with torch.inference_mode():
        planes = torch.from_numpy(sample.planes)[None]
        logits = network.instruments(planes, network.features(planes))
    found: np.ndarray = logits[0, 0].numpy()
    return found


def figures(network: ScopeNet, scenes: Store, layers: LayerStore, recipe: Recipe) -> dict[str, float]:
    """Return IoU on held-out pictures with instruments, and the share of pixels taken for one on those without.

    Masks are those of a run, with their rim, of single pictures.
    """
    found = {}
    for name, size, stride in (("320x256", (256, 320), 1), ("160x128", (128, 160), 2)):
        both, either, ious, wrong = 0.0, 0.0, [], []
        for pictures, seed in (
            (Pictures(scenes, layers, 0.0, recipe.hard), 91),
            (Pictures(scenes, LayerStore.empty(), 1.0, recipe.hard), 92),
        ):
            for n in range(recipe.pictures):
                sample = pictures.draw((seed, n), size, stride)
                probability = 1 / (1 + np.exp(-cv2.resize(_logits(network, sample), size[::-1])))
                mask = Masker(MaskSettings(instruments="auto")).instruments(probability)
                truth = sample.instruments > 0.5
                assert mask is not None
                if truth.any():
                    shared, whole = np.count_nonzero(mask & truth), np.count_nonzero(mask | truth)
                    both, either = both + shared, either + whole
                    ious.append(shared / whole)
                elif seed == 92:
                    wrong.append(mask.mean())
        found |= {
            f"IoU {name}": both / max(either, 1),
            f"IoU {name}, median of pictures": float(np.median(ious)) if ious else np.nan,
            f"false {name}": float(np.mean(wrong)) if wrong else np.nan,
        }
    return found
