"""What makes the uncertain parts of a surface pale, alike on the page and in the window."""

from __future__ import annotations

import numpy as np
import trimesh

SURE_CONFIDENCE = 0.6
"""From this confidence on colours are full. Half of the vertices reach it on Hamlyn, C3VD cecum and laparoscopy_rvim
60:120, whose verdicts are Good, and a tenth or less of them on colonoscopy_nflba_03, whose verdict is Doubtful."""
PALE = 199
"""Level of the grey that colours fade to."""
LEAST_COLOUR = 0.25
"""Share of the colour that is left where nothing is sure."""
WORDS = "Pale: few frames saw it, from afar or at a slant, or it moves."


def certainty(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return how sure a surface is at its vertices, (V,), 0 to 1, by its attributes `confidence` and `moving`."""
    count = len(mesh.vertices)
    confidence, moving = (
        np.asarray(mesh.vertex_attributes.get(name, np.full(count, otherwise)), float).ravel()
        for name, otherwise in (("confidence", 1.0), ("moving", 0.0))
    )
    return np.clip(confidence * (1 - moving) / SURE_CONFIDENCE, 0, 1)


def faded(colours: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """Return colours (..., 3) uint8, pale where they are not sure, (...), 0 to 1."""
    share = (LEAST_COLOUR + (1 - LEAST_COLOUR) * sure)[..., None]
    return np.round(PALE + share * (colours.astype(np.float32) - PALE)).astype(np.uint8)
