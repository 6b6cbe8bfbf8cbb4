"""Optical flow by a function of the caller's own, checked at the door."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from scopemap.errors import InputError, SettingsError
from scopemap.flow.estimator import FlowEstimator


class OwnFlow(FlowEstimator):
    """A function from two pictures to the flow between them, as a flow estimator for any thread.

    function : takes two (H, W, 3) uint8 pictures of one size; returns (H, W, 2) floats, px (x, y): pixel p of the first
        is seen at p + flow(p) in the second. It is called from several threads, one after the other.

    Raises `SettingsError` for what is no function. `estimate` raises `InputError` where it returns another shape or
    dtype, or values that are not finite.
    """

    name = "own"

    def __init__(self, function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        if not callable(function):
            raise SettingsError(f"own flow: expected a function of two pictures, got {type(function).__name__}")
        self._function, self._calling = function, Lock()

    def estimate(self, rgb_from: np.ndarray, rgb_to: np.ndarray) -> np.ndarray:
        """Return the function's flow (H, W, 2) float32, px."""
        with self._calling:
            flow = np.asarray(self._function(rgb_from, rgb_to))
        wanted = (*rgb_from.shape[:2], 2)
        if flow.shape != wanted or not np.issubdtype(flow.dtype, np.floating):
            raise InputError(f"own flow: expected floats of shape {wanted}, got {flow.dtype} of shape {flow.shape}")
        if not np.isfinite(flow).all():
            raise InputError("own flow: values that are not finite; extrapolate where it is unknown")
        return flow.astype(np.float32)

    def provenance(self) -> dict[str, str]:
        """Return the name."""
        return {"flow": "own (a function of the caller)"}
