"""The protocols of depth estimators and of perceptual distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from scopemap.engine.errors import check_shape
from scopemap.engine.frame import Frame

DepthKind = Literal["disparity", "depth", "measured"]


@dataclass(frozen=True)
class DepthEstimate:
    """Depth or disparity of one frame.

    values : (H, W) float32, NaN = unknown; meaning and unit by `kind`.
    kind : "disparity": unitless, larger is nearer, known up to a scale and a shift; "depth": predicted, mm along the
        optical axis, with a scale that may change from frame to frame; "measured": mm, reliable.
    focal_px : focal length that the estimator found in the image, px of this frame's width, or None.
    sigma : (H, W) float32, one standard deviation of `values`, in their unit, NaN = unknown; None: not
        estimated.
    instruments : (H, W) float32, 0..1, the probability that a pixel shows an instrument; None: not looked for.
    """

    values: np.ndarray
    kind: DepthKind
    focal_px: float | None = None
    sigma: np.ndarray | None = None
    instruments: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_shape("DepthEstimate.values", self.values, (None, None))
        if self.sigma is not None:
            check_shape("DepthEstimate.sigma", self.sigma, np.shape(self.values))
        if self.instruments is not None:
            check_shape("DepthEstimate.instruments", self.instruments, np.shape(self.values))


class DepthEstimator(Protocol):
    """Depth from one frame."""

    name: str

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Return the estimate for a frame, of the frame's size."""
        ...

    def provenance(self) -> dict[str, str]:
        """Return what the result depends on, as text: names, versions, hashes."""
        ...


@runtime_checkable
class ScaleFixed(Protocol):
    """An estimator that fixes its scale, mm, on the first usable frame (None until then), for a resumed run, too."""

    scale_mm: float | None


@runtime_checkable
class Releasable(Protocol):
    """A network whose memory can be had back; Depth Pro holds 4 GB, and serves the anchor alone."""

    def release(self) -> None:
        """Free the memory; nothing can be estimated any more."""
        ...


@dataclass(frozen=True)
class PerceptualResult:
    """How different two images look.

    Attributes
    ----------
    map : (H, W) float32 >= 0, the distance around each pixel; 0 = alike.
    score : the distance of the whole images, the mean of `map`.
    """

    map: np.ndarray
    score: float


class PerceptualDistance(Protocol):
    """Perceptual distance between two images."""

    name: str

    def compare(self, rgb_a: np.ndarray, rgb_b: np.ndarray) -> PerceptualResult:
        """Compare two (H, W, 3) uint8 images of one size; the order does not matter."""
        ...

    def provenance(self) -> dict[str, str]:
        """Return what the result depends on, as text: names, versions, hashes."""
        ...
