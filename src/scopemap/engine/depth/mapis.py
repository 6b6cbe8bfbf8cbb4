"""MAPIS: depth that keeps its scale from frame to frame.

Equations 2 to 4 of arXiv 2508.11282, section "MAPIS-Depth Module": the previous depth is warped along the flow,
filtered (2), and blended (4) with the current estimate by a weight from their perceptual distance (3), by the paper's
text; `blend = "paper-equation"` takes equation 4 literally, which does the reverse. The weight's odds are multiplied
by the ratio of inverse variances, where known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MapisSettings
from scopemap.engine.depth.estimate import DepthKind, PerceptualDistance
from scopemap.engine.errors import check_shape
from scopemap.engine.flow.estimator import FlowEstimator, pair_flow
from scopemap.engine.geometry.uncertainty import blended_sigma, by_variance, faded_sigma, relative_sigma
from scopemap.engine.geometry.warp import bilateral_filtered, moved_depth, pull

# Share of the image that must be known in both depths for a scale to be fitted; across a cut 0.06 is so by chance.
_MIN_OVERLAP = 0.2
# Share of ln of a frame's scale that is removed where no pixel has a warped depth; it decreases with the square of the
# warped share.
_SCALE_PULL = 0.1  # by hand
_SIGMA_FADING = 0.3  # by hand: growth of the warped depth's variance per frame, share of its gap to the frame's
_TAU = 0.15  # plausible, not searched; the paper gives none: distance at which an exponential weight is 1/e
FILTER_SIGMA_MM = 2.0  # plausible, not searched; the paper gives none: sigma_r of the bilateral filter
_CONSTANT_WEIGHT = 0.5  # by hand, for the ablation without LPIPS


@dataclass(frozen=True)
class DenseCorrespondence:
    """Dense correspondence of a frame with the previous one.

    to_previous : (H, W, 2) float32 px, from the current frame. consistent : (H, W) bool, flow check passed.
    distance : (H, W) float32 perceptual distance of the two images, 0 = alike; constant for a single score.
    usable_share : share of the current image that shows tissue.
    """

    to_previous: np.ndarray
    consistent: np.ndarray
    distance: np.ndarray
    usable_share: float = 1.0


class DenseMatcher:
    """Matches masked images, in order, with the previous one."""

    _previous: tuple[np.ndarray, np.ndarray] | None = None

    def __init__(self, settings: MapisSettings, flow: FlowEstimator, perceptual: PerceptualDistance) -> None:
        self._settings, self._flow, self._perceptual = settings, flow, perceptual

    def match(self, rgb: np.ndarray, valid: np.ndarray, *, wanted: bool = True) -> DenseCorrespondence | None:
        """Return the correspondence of an image (H, W, 3) uint8 to the previous one; None without or not `wanted`."""
        previous, self._previous = self._previous, (rgb, valid)
        if previous is None or not wanted:
            return None
        rgb_previous, valid_previous = previous
        flow = pair_flow(self._flow, rgb_previous, rgb, self._settings.consistency_px)
        # Masked pixels of either image show no tissue.
        seen = pull(valid_previous.astype(np.float32), flow.to_previous) > 0.5
        if self._settings.previous == "raw":
            score = self._perceptual.compare(rgb_previous, rgb)
            distance = np.full_like(score.map, score.score)
        else:
            distance = self._perceptual.compare(pull(rgb_previous, flow.to_previous), rgb).map
        consistent = flow.consistent & seen & valid
        return DenseCorrespondence(flow.to_previous, consistent, distance, float(valid.mean()))

    def reset(self) -> None:
        """Let the next image have no previous one."""
        self._previous = None


@dataclass(frozen=True)
class RefinedDepth:
    """Depth of one frame after the consistency stage.

    depth_mm : (H, W) float32, NaN = unknown. scale : factor applied to the raw depth.
    warped_share : share of the image with a warped previous depth. sigma_mm : (H, W) float32, one standard
    deviation of the depth, NaN = unknown.
    """

    depth_mm: np.ndarray
    scale: float
    warped_share: float
    sigma_mm: np.ndarray


class _Propagated(NamedTuple):
    """Depth (H, W) mm for the next frame, and its relative standard deviation, NaN = unknown."""

    depth_mm: np.ndarray
    relative_sigma: np.ndarray


class Mapis:
    """Refines the raw depth of frames in order (equations 2 to 4); `reset` starts a new chain after a lost frame."""

    _propagated: _Propagated | None = None

    def __init__(self, settings: MapisSettings) -> None:
        self.settings, self._scale = settings, 1.0

    def refine(
        self,
        raw_mm: np.ndarray,
        kind: DepthKind,
        camera: PinholeCamera,
        correspondence: DenseCorrespondence | None,
        T_current_previous: np.ndarray | None,
        *,
        sigma_mm: np.ndarray | None = None,
    ) -> RefinedDepth:
        """Return the depth of a frame.

        raw_mm : (H, W) float32; sigma_mm : its standard deviation, NaN or None where unknown. correspondence : None for
        the first frame. T_current_previous : transforms the previous depth; None: it is warped unchanged, as in the
        paper.
        """
        check_shape("raw_mm", raw_mm, (camera.height, camera.width))
        sigma = relative_sigma(raw_mm, sigma_mm)
        warped_mm, warped_sigma = self._warped(camera, correspondence, T_current_previous, sigma)
        overlap = float(np.isfinite(warped_mm).mean())
        if self._scales(kind):
            self._scale = robust_scale(raw_mm, warped_mm, self._scale)
            if correspondence is not None and self._propagated is not None:
                self._scale = self._pulled_back(self._scale, overlap / max(correspondence.usable_share, 1e-6))
        scaled_mm = raw_mm * np.float32(self._scale)
        depth_mm, refined_sigma = scaled_mm, sigma
        blend = self._blend(kind)
        if correspondence is not None and blend != "none":
            weight = np.where(np.isfinite(warped_mm), self._weight(blend, correspondence.distance), np.float32(0.0))
            weight = by_variance(weight, warped_sigma, sigma)
            depth_mm = np.where(weight > 0, weight * warped_mm + (1 - weight) * scaled_mm, scaled_mm)
            refined_sigma = blended_sigma(weight, warped_sigma, sigma)
        is_raw = self.settings.previous == "raw"
        self._propagated = _Propagated(scaled_mm, sigma) if is_raw else _Propagated(depth_mm, refined_sigma)
        return RefinedDepth(depth_mm, self._scale, overlap, refined_sigma * depth_mm)

    def needs_previous(self, kind: DepthKind) -> bool:
        """Return whether depth of this kind is compared with the previous frame at all."""
        return self._scales(kind) or self._blend(kind) != "none"

    def reset(self) -> None:
        """Let the next frame start without a previous depth; the last scale is kept."""
        self._propagated = None

    def rescale(self, scale: float) -> None:
        """Let the next frame start with a scale that is known."""
        self._propagated, self._scale = None, scale

    def resume_after(self, depth_mm: np.ndarray, sigma_mm: np.ndarray | None) -> None:
        """Go on after a frame that was refined before the run was resumed: its depth (H, W) mm, and sigma of that."""
        self._propagated = _Propagated(depth_mm, relative_sigma(depth_mm, sigma_mm))

    def _scales(self, kind: DepthKind) -> bool:
        frame_scale = self.settings.frame_scale
        return frame_scale == "robust" or (frame_scale == "auto" and kind != "measured")

    def _pulled_back(self, scale: float, matched_share: float) -> float:
        """Return the scale pulled back towards 1, the more the fewer pixels are matched to the previous frame."""
        return float(scale ** (1 - _SCALE_PULL * max(1 - matched_share, 0.0) ** 2))

    def _blend(self, kind: DepthKind) -> str:
        if self.settings.blend != "auto":
            return self.settings.blend
        return "none" if kind == "measured" else "linear"

    def _warped(
        self,
        camera: PinholeCamera,
        correspondence: DenseCorrespondence | None,
        T_current_previous: np.ndarray | None,
        sigma: np.ndarray,
    ) -> _Propagated:
        """Warp the previous depth and its uncertainty to the current frame, whose own relative sigma is `sigma`."""
        if correspondence is None or self._propagated is None:
            nothing = np.full((camera.height, camera.width), np.nan, np.float32)
            return _Propagated(nothing, nothing)
        warped_mm = pull(self._propagated.depth_mm, correspondence.to_previous)
        warped_mm = np.where(correspondence.consistent, warped_mm, np.float32(np.nan))
        if T_current_previous is not None:
            warped_mm = moved_depth(warped_mm, correspondence.to_previous, camera, T_current_previous)
        filtered_mm = bilateral_filtered(warped_mm, self.settings.filter_sigma_px, FILTER_SIGMA_MM)
        warped_sigma = pull(self._propagated.relative_sigma, correspondence.to_previous)
        return _Propagated(filtered_mm, faded_sigma(warped_sigma, sigma, _SIGMA_FADING))

    def _weight(self, blend: str, distance: np.ndarray) -> np.ndarray:
        """Weight of the warped depth in equation 4, (H, W) float32 in 0..1, from the perceptual distance S."""
        match blend:
            case "exponential":
                return np.exp(-distance / np.float32(_TAU))
            case "linear":
                return 1 - np.clip(distance, 0, 1)
            case "paper-equation":
                return np.clip(distance, 0, 1)
        return np.full_like(distance, _CONSTANT_WEIGHT)


def robust_scale(raw_mm: np.ndarray, warped_mm: np.ndarray, otherwise: float) -> float:
    """Return the median ratio of warped to raw depth, or `otherwise` where they overlap too little."""
    both = np.isfinite(raw_mm) & np.isfinite(warped_mm) & (raw_mm > 0)
    if both.mean() < _MIN_OVERLAP:
        return otherwise
    return float(np.exp(np.median(np.log(warped_mm[both] / raw_mm[both]))))
