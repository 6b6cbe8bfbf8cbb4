"""The protocol of optical flow estimators, the simplest ones, and the forward-backward consistency check."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Protocol

import numpy as np

from scopemap.engine.errors import InputError, SettingsError, check_shape
from scopemap.engine.geometry.warp import pull

FlowPair = tuple[np.ndarray, np.ndarray]
"""Flow from one image to another, and back, (H, W, 2) float32 px each."""


class FlowEstimator(Protocol):
    """Optical flow between two images: pixel p of the first is seen at p + flow(p) in the second."""

    name: str
    enough_px: int | None = None
    """Longest side of images in which corners are found well enough to align their patches; None: no image is larger
    than needed."""

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32, px (x, y), of two (H, W, 3) uint8 images of one size."""
        ...

    def estimate_small(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the flow, as `estimate` does, of images that are nearly alike: an estimator may spend less on it."""
        return self.estimate(rgb_from, rgb_to)

    def estimate_both(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> FlowPair:
        """Return the flows a to b and b to a; an estimator that can share work between them overrides this."""
        return self.estimate(rgb_a, rgb_b), self.estimate(rgb_b, rgb_a)

    def estimate_checked(self, rgb_from: np.ndarray, rgb_to: np.ndarray, start: FlowPair | None = None) -> FlowPair:
        """Return the flow from one image to another, and one back that serves only to check it."""
        return self.estimate_both(rgb_from, rgb_to)

    def provenance(self) -> dict[str, str]:
        """Return what the result depends on, as text: names, versions, hashes."""
        ...


class NoFlow(FlowEstimator):
    """Zero flow everywhere: the previous image is taken as it is."""

    name = "none"

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return (H, W, 2) float32 zeros."""
        return np.zeros((*rgb_from.shape[:2], 2), np.float32)

    def provenance(self) -> dict[str, str]:
        """Return the name."""
        return {"flow": self.name}


class CustomFlow(FlowEstimator):
    """A function of the caller from two pictures to the flow between them, as a flow estimator for any thread.

    function : takes two (H, W, 3) uint8 pictures of one size; returns (H, W, 2) floats, px (x, y): pixel p of the first
        is seen at p + flow(p) in the second. It is called from several threads, one after the other.

    Raises `SettingsError` for what is no function. `estimate` raises `InputError` where it returns another shape or
    dtype, or values that are not finite.
    """

    name = "own"

    def __init__(self, function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        if not callable(function):
            raise SettingsError(f"custom flow: expected a function of two pictures, got {type(function).__name__}")
        self._function, self._calling = function, Lock()

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the function's flow (H, W, 2) float32, px."""
        with self._calling:
            flow = np.asarray(self._function(rgb_from, rgb_to))
        wanted = (*rgb_from.shape[:2], 2)
        if flow.shape != wanted or not np.issubdtype(flow.dtype, np.floating):
            raise InputError(f"custom flow: expected floats of shape {wanted}, got {flow.dtype} of shape {flow.shape}")
        if not np.isfinite(flow).all():
            raise InputError("own flow: values that are not finite; extrapolate where it is unknown")
        return flow.astype(np.float32)

    def provenance(self) -> dict[str, str]:
        """Return the name."""
        return {"flow": "own (a function of the caller)"}


@dataclass(frozen=True)
class Flow:
    """Optical flow between the previous and the current frame.

    to_previous : (H, W, 2) float32, px: pixel p of the current frame is seen at p + to_previous(p) in the previous.
    consistent : (H, W) bool on the current frame's grid: True where the forward-backward error is small.
    """

    to_previous: np.ndarray
    consistent: np.ndarray


def pair_flow(
    estimator: FlowEstimator, rgb_previous: np.ndarray, rgb_current: np.ndarray, consistency_px: float
) -> Flow:
    """Return the flow from a frame (H, W, 3) uint8 to the previous one, checked both ways to `consistency_px`.

    Where that is 0 the flow back is not computed, and all that stays in the image is consistent.
    """
    check_shape("rgb_previous", rgb_previous, (None, None, 3))
    check_shape("rgb_current", rgb_current, rgb_previous.shape)
    if not consistency_px:
        to_previous = estimator.estimate(rgb_current, rgb_previous)
        return Flow(to_previous, agree(to_previous, np.zeros_like(to_previous), math.inf))
    to_previous, to_current = estimator.estimate_checked(rgb_current, rgb_previous)
    return Flow(to_previous, agree(to_previous, to_current, consistency_px))


def agree(forth: np.ndarray, back: np.ndarray, consistency_px: float) -> np.ndarray:
    """Return (H, W) bool: True where the flow `forth` (H, W, 2) stays in the image and is consistent with `back`."""
    x_px, y_px = np.moveaxis(forth + pull(back, forth), -1, 0)
    return x_px * x_px + y_px * y_px <= consistency_px**2
