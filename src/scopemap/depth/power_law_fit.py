"""Before a run: which exponent its predicted depth needs, from the flow between the first frames of the sequence.

Every fourth frame is a reference, of a short sequence more. Its partner is the farthest later frame that flow still
links to it: the longer the way, the more parallax, and parallax is what tells range apart from scale.

Flow is smooth where parallax is not: it takes some from the near and gives it to the far, which alone lowers the
exponent by a fifth. So the partner is warped to the reference by what the fit makes of the depth, the flow that remains
is added, and the fit repeated. A fit that is right leaves nothing to be smoothed. What remains is small: DIS
serves here, whatever flow the run uses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from scopemap.config import Config
from scopemap.depth import DepthEstimate, DepthEstimator
from scopemap.depth.power_law import ExponentFit, PairFit, modelled_flow, pair_exponent, sequence_exponent
from scopemap.flow import FlowEstimator, pair_flow
from scopemap.flow.dis import DisFlow
from scopemap.frame import Frame
from scopemap.geometry.uncertainty import sigma_share
from scopemap.geometry.warp import pull
from scopemap.io.sequence import Sequence
from scopemap.io.video_format.redundant_frames import is_constant
from scopemap.masking.mask_files import create_masks
from scopemap.masking.masker import Masker

_REFERENCE_EVERY, _REFERENCES = 4, 20
_GAPS = (12, 8, 5, 3, 2)  # frames from a reference to its partner, tried in this order
# Flow is believed up to this share of the width, and where this share of the usable pixels comes back to its start.
_LARGEST_FLOW_SHARE = 0.12
_LEAST_CONSISTENT_SHARE = 0.5
_REALIGNMENTS = 3


def fit_exponent(sequence: Sequence, config: Config, estimator: DepthEstimator) -> ExponentFit:
    """Return the exponent for the predicted depth of a sequence, from its first `config.depth.exponent_frames` frames.

    1, with a reason, where depth is not predicted (a disparity is fitted to its anchor, measured depth is right as it
    is) and where too few pairs of frames tell. Some estimators remember the first frame that they saw: a run that
    follows needs new ones.
    """
    fits: list[PairFit] = []
    for reference, partners in _pairs(sequence, config):
        estimate = estimator.estimate(reference)
        if estimate.kind != "depth":
            return ExponentFit(1.0, 0.0, 0, f"{estimate.kind} is not stretched")
        fit = _pair_fit(reference, partners, estimate, config.mapis.consistency_px)
        fits += [] if fit is None else [fit]
    return sequence_exponent(fits)


def with_exponent(config: Config, fit: ExponentFit) -> Config:
    """Return the settings with the fitted number in place of "fit"."""
    depth = config.depth.model_copy(update={"exponent": round(fit.exponent, 4)})
    return config.model_copy(update={"depth": depth})


def described(fit: ExponentFit, frames: int) -> str:
    """Return what was found in one line, for people."""
    if fit.reason:
        return f"depth exponent: left at 1, {fit.reason}"
    return (
        f"depth exponent: {fit.exponent:.2f} +- {fit.deviation:.2f} fitted to the flow of {fit.pairs} pairs "
        f"of the first {frames} frames"
    )


def _pairs(sequence: Sequence, config: Config) -> Iterator[tuple[Frame, list[Frame]]]:
    """Yield each usable reference, masked, with the frames that may be its partner, farthest first."""
    masks = create_masks(config.mask, sequence.rectifier, sequence.source.masks)
    masker = Masker(config.mask, masks)
    window = deque[Frame]()
    least_share, most = config.tracking.min_valid_share, config.depth.exponent_frames
    every = min(max(min(sequence.count or most, most) // _REFERENCES, 1), _REFERENCE_EVERY)

    def first() -> Iterator[tuple[Frame, list[Frame]]]:
        reference, known = window[0], len(window)
        if position % every == 0 and reference.valid.mean() >= least_share:
            partners = [window[gap] for gap in _GAPS if gap < known]
            yield reference, [frame for frame in partners if frame.valid.mean() >= least_share]
        window.popleft()

    position = 0
    for frame in islice(sequence.frames(), most):
        masked = masker(frame)
        dark = is_constant(masked.rgb)
        window.append(replace(masked, valid=np.zeros_like(masked.valid)) if dark else masked)
        if len(window) > max(_GAPS):
            yield from first()
            position += 1
    while window:
        yield from first()
        position += 1


def _pair_fit(
    reference: Frame, partners: list[Frame], estimate: DepthEstimate, consistency_px: float
) -> PairFit | None:
    """Return what the first partner that flow reaches tells of the estimate of the reference; None where nothing."""
    estimator, depth_mm, camera = DisFlow(), estimate.values, reference.camera
    share = None if estimate.sigma is None else sigma_share(depth_mm, estimate.sigma)
    for partner in partners:
        linked = _linked(reference, partner, estimator, consistency_px)
        if linked is None:
            continue
        fit = pair_exponent(depth_mm, linked.to_partner, linked.usable, camera, share)
        for _ in range(_REALIGNMENTS):
            if fit is None:
                return None
            guess = modelled_flow(depth_mm, camera, fit)
            guess = np.where(np.isfinite(guess), guess, linked.to_partner)
            realigned = _realigned(reference, partner, guess, estimator, consistency_px)
            fit = pair_exponent(depth_mm, realigned.to_partner, realigned.usable, camera, share)
        return fit
    return None


class _Link(NamedTuple):
    """Flow (H, W, 2) px from the reference to its partner, and where (H, W) bool it can be trusted."""

    to_partner: np.ndarray
    usable: np.ndarray


def _linked(reference: Frame, partner: Frame, estimator: FlowEstimator, consistency_px: float) -> _Link | None:
    """Link the two by flow; None where it is too long or too little of it comes back to its start."""
    flow = pair_flow(estimator, partner.rgb, reference.rgb, consistency_px)
    usable = flow.consistent & _seen(partner, flow.to_previous) & reference.valid
    if usable.sum() < _LEAST_CONSISTENT_SHARE * reference.valid.sum():
        return None
    length_px = np.median(np.linalg.norm(flow.to_previous[usable], axis=-1))
    return _Link(flow.to_previous, usable) if length_px <= _LARGEST_FLOW_SHARE * reference.camera.width else None


def _realigned(
    reference: Frame, partner: Frame, guess: np.ndarray, estimator: FlowEstimator, consistency_px: float
) -> _Link:
    """Link the two by a guess (H, W, 2) px of the flow and the flow that the guess leaves."""
    rest = pair_flow(estimator, pull(partner.rgb, guess), reference.rgb, consistency_px)
    to_partner = rest.to_previous + pull(guess, rest.to_previous)
    return _Link(to_partner, rest.consistent & _seen(partner, to_partner) & reference.valid)


def _seen(partner: Frame, to_partner: np.ndarray) -> np.ndarray:
    """Return where (H, W) bool flow leads to usable tissue of the partner."""
    return pull(partner.valid.astype(np.float32), to_partner) > 0.5
