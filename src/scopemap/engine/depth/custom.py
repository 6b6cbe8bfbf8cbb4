"""Depth by a function of the caller, checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from scopemap.engine.depth.estimate import DepthEstimate, DepthKind
from scopemap.engine.errors import InputError, SettingsError
from scopemap.engine.frame import Frame

CustomKind = Literal["disparity", "metric", "measured"]
_KINDS: dict[str, DepthKind] = {"disparity": "disparity", "metric": "depth", "measured": "measured"}


class CustomDepth:
    """A function from a picture to its depth, as a depth estimator.

    function : takes (H, W, 3) uint8 sRGB, the rectified picture at the working size; returns (H, W) of a float dtype,
        NaN = unknown. It is called from one thread.
    kind : what it returns. "disparity": >= 0, larger is nearer, known up to scale and shift. "metric": predicted depth
        along the optical axis, mm, > 0, whose scale may change from frame to frame. "measured": depth, mm, > 0.
    name : how results name it.

    Raises `SettingsError` for another kind and for what is no function. `estimate` raises `InputError` where the
    function returns another shape or dtype, infinite or negative values.
    """

    def __init__(self, function: Callable[[np.ndarray], np.ndarray], kind: CustomKind, name: str = "own") -> None:
        if kind not in _KINDS:
            raise SettingsError(f"own depth of kind '{kind}': choose one of {', '.join(_KINDS)}")
        if not callable(function):
            raise SettingsError(f"custom depth: expected a function of a picture, got {type(function).__name__}")
        self.name, self._function, self._kind = name, function, kind

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return the function's depth of a frame."""
        values = np.asarray(self._function(frame.rgb))
        where = f"own depth '{self.name}' of frame {frame.index}"
        if values.shape != frame.valid.shape:
            raise InputError(f"{where}: expected an array of shape {frame.valid.shape}, got {values.shape}")
        if not np.issubdtype(values.dtype, np.floating):
            raise InputError(f"{where}: expected floats with NaN for unknown, got {values.dtype}")
        if np.isinf(values).any() or (values < 0).any():
            raise InputError(f"{where}: infinite or negative values; expected {self._kind}, NaN where unknown")
        return DepthEstimate(values.astype(np.float32), _KINDS[self._kind])

    def provenance(self) -> dict[str, str]:
        """Return the name and the kind."""
        return {"depth": f"{self.name} ({self._kind}, a function of the caller)"}
