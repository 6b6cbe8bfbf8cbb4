"""Stretches that are not as red as tissue under white light: outside the patient, or in narrow-band light."""

from __future__ import annotations

import numpy as np

from scopemap.inspection.clip import Clip, frames_of
from scopemap.inspection.finding import Finding, stretches_of

_LEAST_REDNESS = 1.1
_LEAST_S, _LEAST_FRAMES, _GAP = 0.3, 4, 3
_MOSTLY = 0.9


def check_colour(clip: Clip) -> list[Finding]:
    """Return stretches in which red hardly leads; black ones have no colour."""
    flags = (clip["redness"] < _LEAST_REDNESS) & ~clip["blank"]
    stretches = stretches_of(flags, clip.frames_in(_LEAST_S, _LEAST_FRAMES), _GAP)
    if not stretches:
        return []
    advice = "look at them; narrow-band light is fine to run on"
    if np.mean(flags) > _MOSTLY:
        message = "hardly any picture has the colour of tissue in white light: is it narrow-band light, or no tissue?"
        return [Finding("warning", "not-tissue", message, advice, clip.positions(stretches))]
    message = (
        "not the colour of tissue in white light (outside the patient, or narrow-band light): "
        f"{frames_of(clip, stretches)}"
    )
    advice += f", else {clip.selecting(stretches)}" if clip.selecting(stretches) else ""
    return [Finding("warning", "not-tissue", message, advice, clip.positions(stretches))]
