"""Which frames can be tracked: one test for the tracker, and before the networks, for which others are not worth it."""

from __future__ import annotations

import math

import numpy as np

from scopemap.engine.config import TrackingSettings
from scopemap.engine.frame import Frame, percentiles_uint8
from scopemap.engine.tracking.causes import LossCause
from scopemap.engine.tracking.keyframe_alignment import MIN_TEXTURE
from scopemap.engine.tracking.pyramid import texture
from scopemap.engine.tracking.track import TrackingLoss

_DARK_LEVEL = 40  # by hand: of the brightest channel, in an image with few usable pixels
_BRIGHT_LEVEL = 200  # by hand
_MOST_LOW_TEXTURE = 10  # by hand: frames in a row that are tried all the same: motion blur is shorter


def too_few_pixels(frame: Frame, settings: TrackingSettings) -> TrackingLoss | None:
    """Return why few pixels of a frame are usable: it is dark, overexposed, or covered; None: enough are."""
    share = float(frame.valid.mean())
    if share >= settings.min_valid_share:
        return None
    low, middle = percentiles_uint8(frame.rgb[::2, ::2].max(axis=2), [20.0, 50.0])
    reason = f"only {share:.0%} of the image is usable"
    if middle < _DARK_LEVEL:
        return TrackingLoss(LossCause.TOO_DARK, f"{reason}, it is too dark")
    if low > _BRIGHT_LEVEL:
        return TrackingLoss(LossCause.OVEREXPOSED, f"{reason}, it is overexposed")
    return TrackingLoss(LossCause.VIEW_COVERED, reason)


def covered_by(instruments: np.ndarray, frame: Frame, settings: TrackingSettings) -> TrackingLoss | None:
    """Return that instruments (H, W) bool, left out of a frame, leave too few usable pixels; None: enough are left."""
    loss = too_few_pixels(frame, settings)
    return loss and TrackingLoss(
        LossCause.VIEW_COVERED,
        f"only {frame.valid.mean():.0%} of the image is usable: instruments cover {instruments.mean():.0%}",
    )


class TextureMonitor:
    """Finds where frames, in order, have shown too little texture for some time."""

    def __init__(self, settings: TrackingSettings) -> None:
        self._settings, self._low_texture = settings, 0  # frames in a row

    def too_little(self, frame: Frame) -> TrackingLoss | None:
        """Return that this frame and those before it have too little texture; None: it is worth trying."""
        is_checked = self._settings.picture_checks
        found = texture(frame, self._settings) if is_checked else math.inf
        self._low_texture = self._low_texture + 1 if found < MIN_TEXTURE else 0
        if self._low_texture <= _MOST_LOW_TEXTURE:
            return None
        return TrackingLoss(LossCause.NO_TEXTURE, f"{found:.2f} of texture, noise has 0.32: contact, blur or fluid")
