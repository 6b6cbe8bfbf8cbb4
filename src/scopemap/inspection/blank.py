"""Stretches that show nothing: black, or of one colour."""

from __future__ import annotations

from scopemap.inspection.clip import Clip, frames_of
from scopemap.inspection.finding import Finding, stretches_of

_BLACK_LEVEL = 16.0


def check_blank(clip: Clip) -> list[Finding]:
    """Return black stretches and those of one colour; runs call these frames lost and go on."""
    blank, black = clip["blank"], clip["brightness"] <= _BLACK_LEVEL
    found = []
    for flags, code, what in ((blank & black, "black", "black"), (blank & ~black, "one-colour", "of one colour")):
        stretches = stretches_of(flags)
        if stretches:
            message = f"{what}: {frames_of(clip, stretches)}"
            found.append(Finding("warning", code, message, clip.selecting(stretches), clip.positions(stretches)))
    return found
