"""Masks of what a run does not find by itself, in the form in which it reads them: one image per frame, by number."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.inspection.inspecting import Inspection


def write_masks(inspection: Inspection, folder: Path) -> int:
    """Write a PNG for every frame, white where an overlay or a picture in the picture lies; return how many.

    Nothing is written where there are neither. Raises `OSError` where the folder cannot be written.
    """
    boxes = [*inspection.insets, *(overlay.box for overlay in inspection.overlays if overlay.in_field)]
    if not boxes:
        return 0
    width, height = inspection.size
    mask = np.zeros((height, width), np.uint8)
    for left, top, right, bottom in boxes:
        rows = slice(int(np.floor(top * height)), int(np.ceil(bottom * height)))
        mask[rows, int(np.floor(left * width)) : int(np.ceil(right * width))] = 255
    content = cv2.imencode(".png", mask)[1].tobytes()
    folder.mkdir(parents=True, exist_ok=True)
    for figures in inspection.clip.figures:
        (folder / f"{figures.index:06d}.png").write_bytes(content)
    return len(inspection.clip)
