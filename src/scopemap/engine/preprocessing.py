"""What needs no motion: masks, raw metric depth, and the correspondence with the previous frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.depth.anchor import AnchoredDepth, depth_downscale
from scopemap.engine.depth.estimate import DepthEstimator, DepthKind, PerceptualDistance
from scopemap.engine.depth.mapis import DenseCorrespondence, DenseMatcher, Mapis
from scopemap.engine.faults import StageFaults
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.warp import pull, resampled
from scopemap.engine.kept import Kept
from scopemap.engine.masking.masker import Masker, StoredMasks, without_instruments
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.features import FeatureDetector, SiftFeatures
from scopemap.engine.tracking.pyramid import texture
from scopemap.engine.tracking.sharpness import LEAST_QUALITY, PictureQuality
from scopemap.engine.tracking.track import FrameTracker, TrackingLoss, unusable

# So many frames in a row with too little texture are looked at: motion blur is shorter.
_MOST_LOW_TEXTURE = 10


@dataclass(frozen=True)
class Estimators:
    """The interchangeable parts that look at images; a flow is not thread-safe, so each thread has its own."""

    depth: Kept[DepthEstimator]
    anchor: Kept[AnchoredDepth]
    flow: FlowEstimator  # between successive frames
    corner_flow: FlowEstimator  # of the keyframe's corners, in tracking
    keyframe_flow: FlowEstimator  # between keyframes, in mapping
    perceptual: PerceptualDistance
    masks: Kept[StoredMasks | None] = None
    features: FeatureDetector = field(default_factory=SiftFeatures)
    tracker: Callable[[], FrameTracker] | None = None  # makes what tracks in place of `Tracker`


@dataclass(frozen=True)
class PreprocessedFrame:
    """Results that need no motion: `frame` is masked, with raw depth of `kind`; `anchored`: fixed the scale.

    small : the frame at the size of the depth estimate and of `correspondence`, that of `frame` over `depth_downscale`.
    depth_note : that most of its depth is beyond the limit; else "". fault : why it could not be processed.
    skipped : whether nothing was estimated, because the tracker refuses it anyway; its depth is unknown.
    propagated : whether its depth is that of the frame before, by flow, and not the network's.
    """

    frame: Frame
    small: Frame
    kind: DepthKind
    correspondence: DenseCorrespondence | None
    anchored: bool
    depth_note: str = ""
    fault: TrackingLoss | None = None
    skipped: bool = False
    propagated: bool = False


class Preprocessing:
    """Masks frames and estimates their raw depth, in order, each once."""

    _masker: Kept[Masker]
    _quality: Kept[PictureQuality]
    estimators: Kept[Estimators]
    faults: Kept[StageFaults]
    skipped: Kept[Counter[str]]
    """How many frames were skipped, by the cause of their loss."""
    propagated: Kept[int] = 0
    """How many frames got the depth of the one before."""
    _low_texture: Kept[int] = 0
    _turn: Kept[int] = 0
    _kind: Kept[DepthKind | None] = None  # of what the network said last; None: it looks at the next frame

    def __init__(self, config: Config, estimators: Estimators) -> None:
        self._config, self.estimators = config, estimators
        self._masker, self._quality = Masker(config.mask, estimators.masks), PictureQuality()
        self.faults = StageFaults("depth")
        self.skipped = Counter()
        from_files = config.depth.backend.startswith("files:") or config.mask.instruments == "auto"
        self._every, self._needs_previous = config.depth.constants.network_every, Mapis(config.mapis).needs_previous
        self._every = 1 if from_files else self._every

    @property
    def notices(self) -> list[Notice]:
        """Which frames were skipped, and how many got the depth of the one before, so far."""
        causes = ", ".join(f"{count} {cause}" for cause, count in self.skipped.most_common())
        found = [Notice("frames-skipped", {"frames": self.skipped.total(), "causes": causes})] if causes else []
        return found + [Notice("depth-propagated", {"frames": self.propagated, "every": self._every})] * bool(
            self.propagated
        )

    def estimate(self, frame: Frame) -> PreprocessedFrame:
        """Mask a frame and estimate its raw depth; a frame with which that fails has no usable pixel, and is lost."""
        try:
            return self._estimate(frame)
        except Exception as error:
            fault = TrackingLoss(LossCause.OTHER, self.faults.noted(frame.index, error))
            return self._without_estimate(without_depth(frame), fault)

    def _estimate(self, frame: Frame) -> PreprocessedFrame:
        self.faults.frames += 1
        frame, constants = self._masker(frame), self._config.tracking.constants
        # A frame that the tracker refuses must not fix the scale of depth, and is not worth the networks.
        if frame.valid.mean() < constants.min_valid_share:
            return self._skipped(frame, unusable(frame))
        found = texture(frame, self._config.tracking) if constants.min_texture else math.inf
        self._low_texture = self._low_texture + 1 if found < constants.min_texture else 0
        if self._low_texture > _MOST_LOW_TEXTURE:
            bare = TrackingLoss(LossCause.NO_TEXTURE, f"{found:.2f} of texture, noise has 0.32: contact, blur or fluid")
            return self._skipped(without_depth(frame), bare)
        frame = replace(frame, quality=self._quality(frame.rgb, frame.valid))
        small = frame.downscaled(depth_downscale(self._config.depth, max(frame.valid.shape)))
        if self._kind is not None and self._turn + 1 < self._every:
            self._turn, self.propagated = self._turn + 1, self.propagated + 1
            frame, small = with_unknown_depth(frame), with_unknown_depth(small)
            return PreprocessedFrame(frame, small, self._kind, None, False, propagated=True)
        estimate = self.estimators.depth.estimate(small)
        if estimate.kind != "measured" and not np.isfinite(estimate.values).any():
            self.faults.has_no_depth(frame.index)
        fault, instruments = None, self._masker.instruments(estimate.instruments)
        if instruments is not None:
            # An instrument's depth is of no use, and what is behind it is not known.
            unknown = np.where(instruments, np.float32(np.nan), np.float32(1))
            sigma = None if estimate.sigma is None else estimate.sigma * unknown
            estimate = replace(estimate, values=estimate.values * unknown, sigma=sigma)
            frame, small = (without_instruments(seen, instruments) for seen in (frame, small))
            if frame.valid.mean() < constants.min_valid_share:
                left = f"only {frame.valid.mean():.0%} of the image is usable"
                fault = TrackingLoss(LossCause.VIEW_COVERED, f"{left}: instruments cover {instruments.mean():.0%}")
        raw, is_followed = self.estimators.anchor.metric(estimate, small), self._needs_previous(estimate.kind)
        self._turn, self._kind = 0, estimate.kind if is_followed and self.estimators.anchor.conversion else None
        small = replace(small, depth_mm=raw.depth_mm, depth_sigma_mm=raw.sigma_mm, views=None)
        frame, fitted = with_depth(frame, raw.depth_mm, raw.sigma_mm), self.estimators.anchor.just_fitted
        return PreprocessedFrame(frame, small, estimate.kind, None, fitted, raw.limit_note, fault)

    def _skipped(self, frame: Frame, why: TrackingLoss) -> PreprocessedFrame:
        self.skipped[str(why.cause)] += 1
        return replace(self._without_estimate(frame, why), skipped=True)

    def _without_estimate(self, frame: Frame, fault: TrackingLoss) -> PreprocessedFrame:
        self._masker.instruments(None)
        self._kind = None
        frame = replace(with_unknown_depth(frame), quality=LEAST_QUALITY)
        small = frame.downscaled(depth_downscale(self._config.depth, max(frame.valid.shape)))
        return PreprocessedFrame(frame, with_unknown_depth(small), "measured", None, False, fault=fault)


class Matching:
    """Finds the correspondence of each frame with the one before, where its depth is to be refined with it."""

    _matcher: Kept[DenseMatcher]
    _before: Kept[Frame | None] = None
    faults: Kept[StageFaults]

    def __init__(self, config: Config, estimators: Estimators) -> None:
        self._matcher = DenseMatcher(config.mapis, estimators.flow, estimators.perceptual)
        self._needs_previous = Mapis(config.mapis).needs_previous
        self.faults = StageFaults("flow")

    def match(self, estimated: PreprocessedFrame) -> PreprocessedFrame:
        """Add the correspondence of a frame with the one before, where its depth is to be refined with it."""
        frame, wanted = estimated.small, self._needs_previous(estimated.kind)
        before, self._before = self._before, None
        self.faults.frames += 1
        if estimated.skipped:
            self._matcher.reset()
            return estimated
        try:
            found = self._matcher.match(frame.rgb, frame.valid, wanted=wanted)
            if estimated.propagated and before is not None and found is not None:
                estimated = _with_carried_depth(estimated, before, found)
            self._before = estimated.small
            return replace(estimated, correspondence=found)
        except Exception as error:
            fault = TrackingLoss(LossCause.OTHER, self.faults.noted(frame.index, error))
            return replace(estimated, fault=fault)


def _with_carried_depth(estimated: PreprocessedFrame, before: Frame, found: DenseCorrespondence) -> PreprocessedFrame:
    """Return a frame with the raw depth of the one before, where flow is consistent; MAPIS corrects it by motion."""
    depth_mm, sigma_mm = (
        None if values is None else np.where(found.consistent, pull(values, found.to_previous), np.float32(np.nan))
        for values in (before.depth_mm, before.depth_sigma_mm)
    )
    assert depth_mm is not None
    small = replace(estimated.small, depth_mm=depth_mm, depth_sigma_mm=sigma_mm)
    return replace(estimated, frame=with_depth(estimated.frame, depth_mm, sigma_mm), small=small)


def without_depth(frame: Frame) -> Frame:
    """Return a frame without a usable pixel, and with unknown depth."""
    return with_unknown_depth(replace(frame, valid=np.zeros_like(frame.valid)))


def with_unknown_depth(frame: Frame) -> Frame:
    """Return a frame with the same usable pixels, and with unknown depth."""
    unknown_mm = np.full(frame.valid.shape, np.nan, np.float32)
    return replace(frame, depth_mm=unknown_mm, depth_sigma_mm=None, views=None)


def with_depth(frame: Frame, depth_mm: np.ndarray, sigma_mm: np.ndarray | None) -> Frame:
    """Return a frame with depth, and its standard deviation where there is one, from any size to the frame's."""
    sigma_mm = None if sigma_mm is None else resampled(sigma_mm, frame.camera)
    return replace(frame, depth_mm=resampled(depth_mm, frame.camera), depth_sigma_mm=sigma_mm, views=None)
