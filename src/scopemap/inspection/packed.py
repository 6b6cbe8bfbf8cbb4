"""What a video system packed into one picture: two views (stereo), or two fields taken one after the other."""

from __future__ import annotations

import numpy as np

from scopemap.inspection.finding import Finding
from scopemap.io.video_format.interlacing import is_interlaced
from scopemap.io.video_format.stereo_packing import Packing


def interlacing_findings(pictures: list[np.ndarray]) -> list[Finding]:
    """Return whether pictures (H, W, 3) uint8 of a video hold two fields each; without motion nothing can be told."""
    if not pictures or not is_interlaced(pictures):
        return []
    message = "interlaced: odd and even rows show two moments, edges of what moves look like combs"
    return [Finding("warning", "interlaced", message, "--deinterlace")]


def stereo_findings(packed: Packing | None) -> list[Finding]:
    """Return whether there are two views in each picture."""
    if packed is None:
        return []
    where = "beside" if packed.layout == "left-right" else "above"
    squeezed = ", each squeezed to half its size" if packed.squeezed else ""
    message = (
        f"two views {where} each other{squeezed} (correlation {packed.correlation:.2f}); the rest is about the first"
    )
    return [Finding("warning", "stereo", message, f"--stereo {packed.layout}")]
