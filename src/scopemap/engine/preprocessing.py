"""What needs no motion: masks, raw metric depth, and the correspondence with the previous frame."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scopemap.engine.config import Config
from scopemap.engine.depth.anchor import depth_downscale
from scopemap.engine.depth.estimate import DepthKind, ScaleFixed
from scopemap.engine.depth.mapis import DenseCorrespondence, DenseMatcher, Mapis
from scopemap.engine.estimators import Estimators
from scopemap.engine.faults import StageFaults
from scopemap.engine.frame import Frame
from scopemap.engine.geometry.warp import pull, resampled
from scopemap.engine.masking.masker import Masker, without_instruments
from scopemap.engine.notices import Notice
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.sharpness import LEAST_QUALITY, PictureQuality
from scopemap.engine.tracking.track import TrackingLoss
from scopemap.engine.tracking.usable import TextureMonitor, covered_by, too_few_pixels


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


class DepthTurns:
    """Which frames the network looks at: one in `every`; flow propagates its depth to the frames in between."""

    propagated = 0
    """How many frames got the depth of the one before."""
    _kind: DepthKind | None = None  # of the depth that can be propagated; None: there is none

    def __init__(self, every: int) -> None:
        self._every, self._since = every, 0  # frames since the network looked

    def propagated_kind(self) -> DepthKind | None:
        """Return of which kind the depth is that the next frame gets from the one before; None: the network looks."""
        if self._kind is None or self._since + 1 >= self._every:
            return None
        self._since, self.propagated = self._since + 1, self.propagated + 1
        return self._kind

    def looked(self, kind: DepthKind | None) -> None:
        """Note that the network looked at a frame; kind : of its depth, None: the next frame cannot use it."""
        self._since, self._kind = 0, kind

    def interrupt(self) -> None:
        """Note a frame without depth: nothing can be propagated from it."""
        self._kind = None

    @property
    def notices(self) -> list[Notice]:
        """How many frames got the depth of the one before, so far; [] where none did."""
        values = {"frames": self.propagated, "every": self._every}
        return [Notice("depth-propagated", values)] if self.propagated else []


class Preprocessing:
    """Masks frames and estimates their raw depth, in order, each once."""

    def __init__(self, config: Config, estimators: Estimators) -> None:
        self._config, self.estimators = config, estimators
        self._masker, self._quality = Masker(config.mask, estimators.masks), PictureQuality()
        self._texture, self.faults = TextureMonitor(config.tracking), StageFaults("depth")
        self.skipped = Counter[str]()
        """How many frames were skipped, by the cause of their loss."""
        from_files = config.depth.backend.startswith("files:") or config.mask.instruments == "auto"
        self._turns = DepthTurns(1 if from_files else config.depth.network_every)
        self._needs_previous = Mapis(config.mapis).needs_previous

    @property
    def notices(self) -> list[Notice]:
        """Which frames were skipped, and how many got the depth of the one before, so far."""
        causes = ", ".join(f"{count} {cause}" for cause, count in self.skipped.most_common())
        skipped = [Notice("frames-skipped", {"frames": self.skipped.total(), "causes": causes})] if causes else []
        return skipped + self._turns.notices

    def record(self) -> dict[str, Any]:
        """Return what does not follow from the frames that are stored, for `resume`: numbers and arrays by name."""
        depth, quality = self.estimators.depth, list(self._quality.recent)
        return {
            "masks": self._masker.record(),
            "anchor": self.estimators.anchor.record(),
            "scale_mm": depth.scale_mm if isinstance(depth, ScaleFixed) else None,
            "quality": quality,
            "propagated": self._turns.propagated,
            "skipped": dict(self.skipped),
            "faults": self.faults.record(),
        }

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record."""
        self._masker.resume(record["masks"])
        self.estimators.anchor.resume(record["anchor"])
        if isinstance(self.estimators.depth, ScaleFixed):
            self.estimators.depth.scale_mm = record["scale_mm"]
        self._quality.recent.extend(tuple(measures) for measures in record["quality"])
        self._turns.propagated, self.skipped = record["propagated"], Counter(record["skipped"])
        self.faults.resume(record["faults"])

    def pass_over(self, index: int) -> None:
        """Take the number of a frame that was estimated before the run was resumed."""
        self._masker.pass_over(index)

    def downscaled(self, frame: Frame) -> Frame:
        """Return a frame at the size of the depth estimate."""
        return frame.downscaled(depth_downscale(self._config.depth, max(frame.valid.shape)))

    def estimate(self, frame: Frame) -> PreprocessedFrame:
        """Mask a frame and estimate its raw depth; a frame with which that fails has no usable pixel, and is lost."""
        try:
            return self._estimate(frame)
        except Exception as error:
            fault = TrackingLoss(LossCause.OTHER, self.faults.noted(frame.index, error))
            return self._without_estimate(without_depth(frame), fault)

    def _estimate(self, frame: Frame) -> PreprocessedFrame:
        self.faults.frames += 1
        frame = self._masker(frame)
        # A frame that the tracker refuses must not fix the scale of depth, and is not worth the networks.
        if (loss := too_few_pixels(frame, self._config.tracking)) is not None:
            return self._skipped(frame, loss)
        if (loss := self._texture.too_little(frame)) is not None:
            return self._skipped(without_depth(frame), loss)
        frame = replace(frame, quality=self._quality(frame.rgb, frame.valid))
        small = self.downscaled(frame)
        if (kind := self._turns.propagated_kind()) is not None:
            frame, small = with_unknown_depth(frame), with_unknown_depth(small)
            return PreprocessedFrame(frame, small, kind, None, False, propagated=True)
        return self._by_network(frame, small)

    def _by_network(self, frame: Frame, small: Frame) -> PreprocessedFrame:
        """Return a frame with the network's depth in millimetres, without instruments; small : the same, downscaled."""
        estimate, fault = self.estimators.depth.estimate(small), None
        if estimate.kind != "measured" and not np.isfinite(estimate.values).any():
            self.faults.has_no_depth(frame.index)
        instruments = self._masker.instruments(estimate.instruments)
        if instruments is not None:
            # An instrument's depth is of no use, and what is behind it is not known.
            unknown = np.where(instruments, np.float32(np.nan), np.float32(1))
            sigma = None if estimate.sigma is None else estimate.sigma * unknown
            estimate = replace(estimate, values=estimate.values * unknown, sigma=sigma)
            frame, small = (without_instruments(seen, instruments) for seen in (frame, small))
            fault = covered_by(instruments, frame, self._config.tracking)
        raw, anchor = self.estimators.anchor.metric(estimate, small), self.estimators.anchor
        can_propagate = self._needs_previous(estimate.kind) and bool(anchor.conversion)
        self._turns.looked(estimate.kind if can_propagate else None)
        small = replace(small, depth_mm=raw.depth_mm, depth_sigma_mm=raw.sigma_mm, views=None)
        frame = with_depth(frame, raw.depth_mm, raw.sigma_mm)
        return PreprocessedFrame(frame, small, estimate.kind, None, anchor.just_fitted, raw.limit_note, fault)

    def _skipped(self, frame: Frame, why: TrackingLoss) -> PreprocessedFrame:
        self.skipped[str(why.cause)] += 1
        return replace(self._without_estimate(frame, why), skipped=True)

    def _without_estimate(self, frame: Frame, fault: TrackingLoss) -> PreprocessedFrame:
        self._masker.instruments(None)
        self._turns.interrupt()
        frame = replace(with_unknown_depth(frame), quality=LEAST_QUALITY)
        small = with_unknown_depth(self.downscaled(frame))
        return PreprocessedFrame(frame, small, "measured", None, False, fault=fault)


class Matching:
    """Finds the correspondence of each frame with the one before, where its depth is to be refined with it."""

    _before: Frame | None = None

    def __init__(self, config: Config, estimators: Estimators) -> None:
        self._matcher = DenseMatcher(config.mapis, estimators.flow, estimators.perceptual)
        self._needs_previous = Mapis(config.mapis).needs_previous
        self.faults = StageFaults("flow")

    def record(self) -> dict[str, Any]:
        """Return what does not follow from the frames that are stored, for `resume`, as JSON holds it."""
        return {"faults": self.faults.record()}

    def resume(self, record: dict[str, Any]) -> None:
        """Go on from a record."""
        self.faults.resume(record["faults"])

    def resume_after(self, small: Frame) -> None:
        """Let the next frame be matched with this one, which is at the size of the depth estimate."""
        self._matcher.match(small.rgb, small.valid, wanted=False)

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
