"""A mask of what a run does not find by itself, in the form in which it reads it: one image for all frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from scopemap.inspection.inspecting import Inspection

MASK_NAME = "mask.png"


def write_mask(inspection: Inspection, folder: Path) -> bool:
    """Write a PNG, white where an overlay or a picture in the picture lies; False, and nothing, where neither does.

    Raises `OSError` where the folder cannot be written.
    """
    boxes = [*inspection.insets, *(overlay.box for overlay in inspection.overlays if overlay.in_field)]
    if not boxes:
        return False
    width, height = inspection.size
    mask = np.zeros((height, width), np.uint8)
    for left, top, right, bottom in boxes:
        rows = slice(int(np.floor(top * height)), int(np.ceil(bottom * height)))
        mask[rows, int(np.floor(left * width)) : int(np.ceil(right * width))] = 255
    content = cv2.imencode(".png", mask)[1].tobytes()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MASK_NAME).write_bytes(content)
    return True
