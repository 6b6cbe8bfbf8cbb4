"""The interchangeable parts of a pipeline that look at images, of all its stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from scopemap.engine.depth.anchor import AnchoredDepth
from scopemap.engine.depth.estimate import DepthEstimator, PerceptualDistance
from scopemap.engine.flow.estimator import FlowEstimator
from scopemap.engine.masking.masker import StoredMasks
from scopemap.engine.tracking.features import FeatureDetector, SiftFeatures
from scopemap.engine.tracking.track import FrameTracker


@dataclass(frozen=True)
class Estimators:
    """The interchangeable parts that look at images; a flow is not thread-safe, so each thread has its own."""

    depth: DepthEstimator
    anchor: AnchoredDepth
    flow: FlowEstimator  # between successive frames
    corner_flow: FlowEstimator  # of the keyframe's corners, in tracking
    keyframe_flow: FlowEstimator  # between keyframes, in mapping
    perceptual: PerceptualDistance
    masks: StoredMasks | None = None
    features: FeatureDetector = field(default_factory=SiftFeatures)
    tracker: Callable[[], FrameTracker] | None = None  # makes what tracks in place of `Tracker`
