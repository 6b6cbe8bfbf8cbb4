"""How much of the field of view is too bright, too dark or a mirror image of the lamp."""

from __future__ import annotations

import numpy as np

from scopemap.inspection.clip import Clip, frames_of
from scopemap.inspection.finding import Finding, stretches_of

_MOST_CLIPPED, _MOST_DARK, _MOST_HIGHLIGHTS = 0.1, 0.5, 0.1
_LEAST_S, _LEAST_FRAMES, _GAP = 0.15, 3, 2


def check_exposure(clip: Clip) -> list[Finding]:
    """Return where a large share of the field is over-exposed, under-exposed or highlights; masks leave these out."""
    found = []
    shown = ~clip["blank"]
    kinds = (
        ("clipped", _MOST_CLIPPED, "over-exposed"),
        ("dark", _MOST_DARK, "under-exposed"),
        ("highlights", _MOST_HIGHLIGHTS, "specular highlights"),
    )
    for name, most, words in kinds:
        stretches = stretches_of(shown & (clip[name] > most), clip.frames_in(_LEAST_S, _LEAST_FRAMES), _GAP)
        if stretches:
            worst = float(np.max(clip[name][shown]))
            message = (
                f"more than {most:.0%} of the field is {words} in {frames_of(clip, stretches)}, {worst:.0%} at worst"
            )
            found.append(Finding("info", name, message, "", clip.positions(stretches)))
    return found


def exposure_figures(clip: Clip) -> dict[str, float]:
    """Return the median share over the pictures that show something: too bright, too dark, highlights, usable."""
    shown = ~clip["blank"]
    names = {"clipped": "over_exposed", "dark": "under_exposed", "highlights": "highlights", "usable": "usable"}
    return {f"{name}_share": float(np.median(clip[key][shown])) if shown.any() else 0.0 for key, name in names.items()}
