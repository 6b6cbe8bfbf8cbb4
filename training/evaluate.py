"""How good is a network on phantom scenes that it never saw: by kind of scene, scaled and unscaled, and its spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import spearmanr

from scopemap.depth.scopenet.network import ScopeNet
from training.buffers import Store
from training.samples import make_sample

_SEED = 77


@dataclass(frozen=True)
class PictureScore:
    """Figures of one picture: after median scaling, without any, and how uncertainty ranks with error."""

    kind: int
    abs_rel: float
    delta: float
    unscaled: float
    rank: float


@dataclass(frozen=True)
class Summary:
    """Means over pictures."""

    abs_rel: float
    delta: float
    unscaled: float
    rank: float
    pictures: int

    @classmethod
    def of(cls, scores: list[PictureScore]) -> Summary:
        """Return the means."""
        mean = {name: float(np.mean([getattr(s, name) for s in scores])) for name in ("abs_rel", "delta", "unscaled")}
        return cls(**mean, rank=float(np.nanmean([s.rank for s in scores])), pictures=len(scores))


def score_pictures(
    network: ScopeNet, store: Store, device: str = "cpu", limit: int | None = None
) -> list[PictureScore]:
    """Return the score of every held-out picture, drawn by a fixed seed, rays known as the trainer tells them."""

    def score(index: int) -> PictureScore:
        buffers = store[index]
        sample = make_sample(buffers, np.random.default_rng((_SEED, index)))
        with torch.inference_mode():
            planes = torch.from_numpy(sample.planes)[None].to(device, memory_format=torch.channels_last)
            log_distance, log_spread = network(planes)[0].float().cpu().numpy()
        known = np.isfinite(sample.log_distance) & sample.valid
        if known.sum() < 100:
            return PictureScore(buffers.kind, np.nan, np.nan, np.nan, np.nan)
        error = (log_distance - sample.log_distance)[known]
        ratio = np.exp(error - np.median(error))
        rank = spearmanr(np.abs(ratio - 1), log_spread[known]).statistic
        return PictureScore(
            buffers.kind,
            float(np.abs(ratio - 1).mean()),
            float((np.maximum(ratio, 1 / ratio) < 1.25).mean()),
            float(np.abs(np.exp(error) - 1).mean()),
            float(rank),
        )

    indices = np.linspace(0, len(store) - 1, min(limit or len(store), len(store))).astype(int)
    return [found for found in map(score, indices) if np.isfinite(found.abs_rel)]


def evaluate(network: ScopeNet, store: Store, device: str = "cpu", limit: int | None = None) -> Summary:
    """Return the means over the held-out pictures, or over `limit` of them spread evenly."""
    return Summary.of(score_pictures(network, store, device, limit))
