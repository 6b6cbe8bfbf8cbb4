"""What the network is trained to: distance up to one factor, its edges and slopes, and a weak hold on millimetres."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

GRADIENT_SCALES = (1, 2, 4, 8)


class Weights(NamedTuple):
    """How much each part of the loss counts."""

    likelihood: float = 1.0
    gradient: float = 1.0
    normal: float = 0.2
    scale: float = 0.05


def loss_parts(prediction: Tensor, log_distance: Tensor, rays: Tensor) -> dict[str, Tensor]:
    """Return the parts of the loss, each a mean over the known pixels of the batch.

    prediction : (N, 2, H, W) as `ScopeNet` gives it. log_distance : (N, H, W), NaN = unknown. rays : (N, 3, H, W).

    likelihood : Laplace negative log likelihood of the error of ln distance after the image's median error is taken
    off. gradient : multi-scale differences of that error. normal : 1 - cosine of the surface normals. scale : the
    median error itself.
    """
    known = torch.isfinite(log_distance)
    truth = torch.where(known, log_distance, torch.zeros_like(log_distance))
    error = prediction[:, 0] - truth
    shift = _median(error.detach(), known)
    offset = _median_of(error, known)
    aligned = error - shift[:, None, None]
    log_spread = prediction[:, 1]
    likelihood = aligned.abs() * torch.exp(-log_spread) + log_spread
    return {
        "likelihood": _mean(likelihood, known),
        "l1": _mean(aligned.abs(), known),
        "gradient": _gradient(error, known),
        "normal": _normal(prediction[:, 0], truth, known, rays),
        "scale": offset.abs().clamp(max=1.5).mean(),
    }


def total(parts: dict[str, Tensor], weights: Weights) -> Tensor:
    """Return the weighted sum; the plain L1 keeps far and uncertain tissue in the game."""
    return (
        weights.likelihood * (0.5 * parts["likelihood"] + 2.0 * parts["l1"])
        + weights.gradient * parts["gradient"]
        + weights.normal * parts["normal"]
        + weights.scale * parts["scale"]
    )


def _mean(values: Tensor, known: Tensor) -> Tensor:
    return (values * known).sum() / known.sum().clamp(min=1)


def _median(values: Tensor, known: Tensor) -> Tensor:
    """Median (N,) over the known pixels of each image; 0 where nothing is known."""
    flat = values.masked_fill(~known, float("nan")).flatten(1)
    return torch.nan_to_num(flat.nanmedian(1).values)


def _median_of(values: Tensor, known: Tensor) -> Tensor:
    """The same with a gradient: the mean of the values close to the median."""
    median = _median(values.detach(), known)[:, None, None]
    near = known & ((values.detach() - median).abs() < 0.1)
    return (values * near).sum((1, 2)) / near.sum((1, 2)).clamp(min=1)


def _gradient(error: Tensor, known: Tensor) -> Tensor:
    """Mean absolute difference of the error between pixels 1, 2, 4 and 8 apart: an edge in the right place costs 0."""
    terms = []
    for step in GRADIENT_SCALES:
        for axis in (1, 2):
            size = error.shape[axis] - step
            both = known.narrow(axis, 0, size) & known.narrow(axis, step, size)
            terms.append(_mean((error.narrow(axis, step, size) - error.narrow(axis, 0, size)).abs(), both))
    return torch.stack(terms).mean()


def _normal(log_distance: Tensor, truth: Tensor, known: Tensor, rays: Tensor) -> Tensor:
    """1 - cosine between normals from the predicted and the true distance; the factor of distance cancels."""
    estimated, true = _normals(log_distance, rays), _normals(truth, rays)
    whole = known[:, 1:-1, 1:-1] & known[:, :-2, 1:-1] & known[:, 2:, 1:-1] & known[:, 1:-1, :-2] & known[:, 1:-1, 2:]
    return _mean(1 - (estimated * true).sum(1), whole)


def _normals(log_distance: Tensor, rays: Tensor) -> Tensor:
    """Unit normals (N, 3, H-2, W-2) of the surface exp(log_distance) * rays, by central differences."""
    middle = log_distance[:, 1:-1, 1:-1]

    def relative(rows: slice, columns: slice) -> tuple[Tensor, ...]:
        # Over the middle's own distance: ln differences stay small, exponentials safe.
        nearness = torch.exp((log_distance[:, rows, columns] - middle).clamp(-1.5, 1.5))
        return tuple(nearness * rays[:, axis, rows, columns] for axis in range(3))

    inner, before, after = slice(1, -1), slice(0, -2), slice(2, None)
    ax, ay, az = (b - a for a, b in zip(relative(inner, before), relative(inner, after), strict=True))
    bx, by, bz = (b - a for a, b in zip(relative(before, inner), relative(after, inner), strict=True))
    # Axis by axis: torch's cross product and norm along a short axis take twice as long on a CPU.
    normal = torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 1)
    return normal * torch.rsqrt((normal * normal).sum(1, keepdim=True) + 1e-12)
