"""How good is a network on phantom scenes that it never saw: by kind of scene, scaled and unscaled, and its spread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.stats import spearmanr

from training.buffers import Store, thinned
from training.network import ScopeNet
from training.samples import make_sample

_SEED = 77
_LEAST_PIXELS = 100
_POOLED_PIXELS = 500


class PictureScore(NamedTuple):
    """Figures of one picture.

    kind : of its scene. abs_rel, delta : after median scaling. tissue : abs_rel where no instrument is seen. unscaled :
    abs_rel of the millimetres as given. rank : Spearman's correlation of error and spread. errors, spreads : (n,), of
    pixels drawn at random.
    """

    kind: int
    abs_rel: float
    delta: float
    tissue: float
    unscaled: float
    rank: float
    errors: np.ndarray
    spreads: np.ndarray


@dataclass(frozen=True)
class Summary:
    """Means over pictures; `pooled_rank` is the correlation of error and spread over the pixels of all of them."""

    abs_rel: float
    delta: float
    tissue: float
    unscaled: float
    rank: float
    pooled_rank: float
    pictures: int

    @classmethod
    def of(cls, scores: list[PictureScore]) -> Summary:
        """Return the means."""
        names = ("abs_rel", "delta", "tissue", "unscaled", "rank")
        means = {name: float(np.nanmean([getattr(score, name) for score in scores])) for name in names}
        errors, spreads = (np.concatenate([getattr(s, name) for s in scores]) for name in ("errors", "spreads"))
        return cls(**means, pooled_rank=_rank(errors, spreads), pictures=len(scores))


class Look(NamedTuple):
    """How held-out scenes are looked at: every `stride`-th pixel, and with what nothing explains or without it."""

    stride: int = 1
    strange: bool = True


def score_pictures(
    network: ScopeNet, store: Store, look: Look, device: str = "cpu", limit: int | None = None
) -> list[PictureScore]:
    """Return the score of every held-out picture, drawn by a fixed seed, rays known as the trainer tells them."""

    def score(index: int) -> PictureScore | None:
        buffers, rng = thinned(store[index], look.stride), np.random.default_rng((_SEED, index))
        sample = make_sample(buffers, rng, strange=look.strange)
        with torch.inference_mode():
            planes = torch.from_numpy(sample.planes)[None].to(device, memory_format=torch.channels_last)
            log_distance, log_spread = network(planes)[0].float().cpu().numpy()
        known = np.isfinite(sample.log_distance) & sample.valid
        if known.sum() < _LEAST_PIXELS:
            return None
        off = (log_distance - sample.log_distance)[known]
        ratio = np.exp(off - np.median(off))
        error, spread, tissue = np.abs(ratio - 1), log_spread[known], off[sample.tissue[known]]
        some = rng.integers(len(error), size=_POOLED_PIXELS)
        return PictureScore(
            buffers.kind,
            float(error.mean()),
            float((np.maximum(ratio, 1 / ratio) < 1.25).mean()),
            float(np.abs(np.exp(tissue - np.median(tissue)) - 1).mean()) if len(tissue) > _LEAST_PIXELS else np.nan,
            float(np.abs(np.exp(off) - 1).mean()),
            _rank(error, spread),
            error[some],
            spread[some],
        )

    indices = np.linspace(0, len(store) - 1, min(limit or len(store), len(store))).astype(int)
    return [found for found in map(score, indices) if found is not None]


def evaluate(network: ScopeNet, store: Store, look: Look, device: str = "cpu", limit: int | None = None) -> Summary:
    """Return the means over the held-out pictures, or over `limit` of them spread evenly."""
    return Summary.of(score_pictures(network, store, look, device, limit))


def _rank(errors: np.ndarray, spreads: np.ndarray) -> float:
    """Spearman's correlation, NaN where there is none."""
    varied = min(np.ptp(errors), np.ptp(spreads)) > 0
    return float(spearmanr(errors, spreads).statistic) if varied else float("nan")
