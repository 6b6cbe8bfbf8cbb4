"""MAPIS: depth that keeps its scale from frame to frame.

METHOD section MAPIS-Depth, steps 5-8. The previous depth is warped into the current frame along the flow, filtered, and
blended with the current estimate by a weight from their perceptual distance. The paper's text trusts the warped depth
where the images are alike, its equation does the reverse; `blend = "paper-equation"` is the latter, taken literally.

Where the estimator says how certain it is, the odds of that weight are multiplied by the ratio of inverse variances: a
pixel that was seen well and is now in glare keeps what was seen. Sigma is carried along as a share of depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import MapisSettings
from scopemap.depth.estimate import DepthKind
from scopemap.errors import check_shape
from scopemap.geometry.uncertainty import blended_share, by_variance, faded_share, sigma_share
from scopemap.geometry.warp import bilateral_filtered, moved_depth, pull

_LEAST_OVERLAP = 0.02  # share of the image that must be known in both depths for a scale to be fitted


@dataclass(frozen=True)
class Correspondence:
    """What links a frame to the one before it.

    Attributes
    ----------
    to_previous : (H, W, 2) float32 px, from the current frame. consistent : (H, W) bool, where it can be trusted.
    distance : (H, W) float32 perceptual distance of the two images, 0 = alike; constant where one score was asked for.
    usable_share : of the current image that shows tissue, so could be linked.
    """

    to_previous: np.ndarray
    consistent: np.ndarray
    distance: np.ndarray
    usable_share: float = 1.0


@dataclass(frozen=True)
class RefinedDepth:
    """Depth of one frame after the consistency stage.

    Attributes
    ----------
    depth_mm : (H, W) float32, NaN = unknown. scale : factor that was put on the raw depth.
    warped_share : share of the image that had a warped previous depth. sigma_mm : (H, W) float32, one standard
    deviation of the depth, NaN = nothing is said.
    """

    depth_mm: np.ndarray
    scale: float
    warped_share: float
    sigma_mm: np.ndarray


class _Carried(NamedTuple):
    """What the next frame takes over: depth (H, W) mm and its sigma as a share of it, NaN = unknown."""

    depth_mm: np.ndarray
    share: np.ndarray


class Mapis:
    """Refines the raw depth of one frame after the other; `forget` cuts the chain after a lost frame."""

    def __init__(self, settings: MapisSettings) -> None:
        self.settings = settings
        self._carried: _Carried | None = None
        self._scale = 1.0

    def refine(
        self,
        raw_mm: np.ndarray,
        kind: DepthKind,
        camera: PinholeCamera,
        link: Correspondence | None,
        T_current_previous: np.ndarray | None,
        *,
        sigma_mm: np.ndarray | None = None,
        anchored: bool = False,
    ) -> RefinedDepth:
        """Return the depth of a frame.

        `raw_mm` is (H, W) float32 and `sigma_mm` its standard deviation, NaN or None where nothing is said; `link` is
        None for the first frame. With a motion the previous depth is moved by it; with None its values are carried
        unchanged, as in the paper. A frame that was just `anchored` to a metric depth takes nothing from the past: the
        chain of scales starts anew with it.
        """
        check_shape("raw_mm", raw_mm, (camera.height, camera.width))
        if anchored:
            self._scale, link = 1.0, None
        share = sigma_share(raw_mm, sigma_mm)
        warped_mm, warped_share = self._warped(camera, link, T_current_previous, share)
        overlap = float(np.isfinite(warped_mm).mean())
        if self._scales(kind):
            self._scale = robust_scale(raw_mm, warped_mm, self._scale)
            if link is not None and self._carried is not None:
                self._scale = self._held(self._scale, overlap / max(link.usable_share, 1e-6))
        scaled_mm = raw_mm * np.float32(self._scale)
        depth_mm, refined_share = scaled_mm, share
        blend = self._blend(kind)
        if link is not None and blend != "none":
            weight = np.where(np.isfinite(warped_mm), self._weight(blend, link.distance), np.float32(0.0))
            weight = by_variance(weight, warped_share, share)
            depth_mm = np.where(weight > 0, weight * warped_mm + (1 - weight) * scaled_mm, scaled_mm)
            refined_share = blended_share(weight, warped_share, share)
        self._carried = (
            _Carried(depth_mm, refined_share) if self.settings.paper.recursive else _Carried(scaled_mm, share)
        )
        return RefinedDepth(depth_mm, self._scale, overlap, refined_share * depth_mm)

    def links(self, kind: DepthKind) -> bool:
        """Return whether depth of this kind is compared with the frame before it at all."""
        return self._scales(kind) or self._blend(kind) != "none"

    def forget(self) -> None:
        """Let the next frame start without a previous depth; the scale found last is held."""
        self._carried = None

    def _scales(self, kind: DepthKind) -> bool:
        frame_scale = self.settings.advanced.frame_scale
        return frame_scale == "robust" or (frame_scale == "auto" and kind != "measured")

    def _held(self, scale: float, linked_share: float) -> float:
        """Pull a chain of scales back to the estimator's own the more, the less of the tissue in view holds it.

        The links' errors add up, and where tissue rushes by they have a sign: depth would grow or shrink without end.
        """
        return float(scale ** (1 - self.settings.advanced.scale_pull * max(1 - linked_share, 0.0) ** 2))

    def _blend(self, kind: DepthKind) -> str:
        if self.settings.paper.blend != "auto":
            return self.settings.paper.blend
        return "none" if kind == "measured" else "linear"

    def _warped(
        self,
        camera: PinholeCamera,
        link: Correspondence | None,
        T_current_previous: np.ndarray | None,
        share: np.ndarray,
    ) -> _Carried:
        """Bring what the frame before knew to the current one, whose own sigma is `share` of its depth."""
        if link is None or self._carried is None:
            nothing = np.full((camera.height, camera.width), np.nan, np.float32)
            return _Carried(nothing, nothing)
        warped_mm = pull(self._carried.depth_mm, link.to_previous)
        warped_mm = np.where(link.consistent, warped_mm, np.float32(np.nan))
        if T_current_previous is not None:
            warped_mm = moved_depth(warped_mm, link.to_previous, camera, T_current_previous)
        filtered_mm = bilateral_filtered(
            warped_mm, self.settings.advanced.filter_sigma_px, self.settings.advanced.filter_sigma_mm
        )
        warped_share = pull(self._carried.share, link.to_previous)
        return _Carried(filtered_mm, faded_share(warped_share, share, self.settings.advanced.sigma_fading))

    def _weight(self, blend: str, distance: np.ndarray) -> np.ndarray:
        """Weight of the warped depth, (H, W) float32 in 0..1, from the perceptual distance S."""
        match blend:
            case "exponential":
                return np.exp(-distance / np.float32(self.settings.paper.tau))
            case "linear":
                return 1 - np.clip(distance, 0, 1)
            case "paper-equation":
                return np.clip(distance, 0, 1)
        return np.full_like(distance, self.settings.paper.constant_weight)


def robust_scale(raw_mm: np.ndarray, warped_mm: np.ndarray, otherwise: float) -> float:
    """Return the median ratio of the warped to the raw depth, or `otherwise` where too little of both is known.

    Only a scale: chaining a shift from frame to frame diverges.
    """
    both = np.isfinite(raw_mm) & np.isfinite(warped_mm) & (raw_mm > 0)
    if both.mean() < _LEAST_OVERLAP:
        return otherwise
    return float(np.exp(np.median(np.log(warped_mm[both] / raw_mm[both]))))
