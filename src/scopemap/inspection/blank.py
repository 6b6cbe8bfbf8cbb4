"""Stretches that show nothing: black, or of one colour."""

from __future__ import annotations

from scopemap.inspection.clip import Clip
from scopemap.inspection.finding import Finding, frames_of, stretches_of

_BLACK_LEVEL = 16.0


def check_blank(clip: Clip) -> list[Finding]:
    """Return black stretches and those of one colour; runs call these frames lost and go on."""
    blank, black = clip["blank"], clip["brightness"] <= _BLACK_LEVEL
    found = []
    for flags, code, what in ((blank & black, "black", "black"), (blank & ~black, "one-colour", "of one colour")):
        stretches = stretches_of(flags)
        if stretches:
            message = f"{what}: {frames_of(stretches)}"
            found.append(Finding("warning", code, message, clip.selecting(stretches), stretches))
    return found
