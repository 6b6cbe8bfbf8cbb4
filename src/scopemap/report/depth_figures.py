"""Figures of depth maps and renderings beside their frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.errors import reporting
from scopemap.engine.frame import Frame
from scopemap.engine.models.device import cpu_threads
from scopemap.input.decoding import read_decoded
from scopemap.report.sheet import Sheet, picture_grid
from scopemap.result.depth_maps import DepthReader, write_picture

_CELL_PX = (300, 250)
_LEGEND_PX = 36
_STEP_PX = 54
_LAST_PX = 140
_MOST_NUMBERS = 5
MASKED_GREY = 110
"""Level of the pixels of a depth picture that the mask leaves out: border, overlay, highlight, instrument."""


def colour_depth(depth_mm: np.ndarray, near_mm: float, far_mm: float) -> np.ndarray:
    """Return (H, W, 3) uint8 sRGB of depth (H, W) mm over its logarithm: near red, far blue (turbo), NaN black.

    Raises `ValueError` unless 0 < `near_mm` < `far_mm`.
    """
    if not far_mm > near_mm > 0:
        raise ValueError(f"colouring depth: far ({far_mm} mm) must be beyond near ({near_mm} mm), and that beyond 0")
    return colour_share(np.log(far_mm / depth_mm) / np.log(far_mm / near_mm))


def colour_share(share: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8 sRGB of shares (H, W): 0 and below blue, 1 and above red (turbo), NaN black."""
    known = np.isfinite(share)
    level = np.round(255 * np.clip(np.where(known, share, 0), 0, 1)).astype(np.uint8)
    rgb = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1].copy()
    rgb[~known] = 0
    return rgb


class DepthPreviews:
    """Pictures of the depth of a run's frames, for which it keeps the mask of each frame until the colours are known.

    folder : that of the result. Raises `InputError` where nothing can be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "depth_preview"

    def __call__(self, frame: Frame) -> None:
        """Keep the mask of a frame, as PNG in the place of its picture."""
        with reporting(f"cannot write to {self._folder}"):
            self._folder.mkdir(parents=True, exist_ok=True)
        write_picture(self._folder / f"{frame.index:06d}.png", frame.valid.astype(np.uint8))

    def finish(self, range_mm: tuple[float, float], *, scale_known: bool) -> None:
        """Write a JPEG of each depth map: turbo over its logarithm, red near, blue far, black unknown, grey masked.

        range_mm : depth at the ends of the colours, the same for all frames. What they mean is written below the map:
        mm, or multiples of the nearest depth where the scale is unknown.
        """
        scale_mm = DepthReader(self._folder.parent).scale_mm
        bgr_by_unit = colour_depth(scale_mm * np.arange(1 << 16).clip(1)[None], *range_mm)[0, :, ::-1].copy()
        bgr_by_unit[0] = 0
        legend_of = cache(lambda width: _depth_legend(width, range_mm, scale_known)[..., ::-1])

        def write(file: Path) -> None:
            picture = bgr_by_unit.take(np.asarray(read_decoded(file)), axis=0)
            kept = self._folder / file.name
            picture[np.asarray(read_decoded(kept)) == 0] = MASKED_GREY
            write_picture(kept.with_suffix(".jpg"), np.vstack([picture, legend_of(picture.shape[1])]))
            kept.unlink()

        # All of it but the loop runs without Python's lock.
        with ThreadPoolExecutor(cpu_threads()) as pool:
            list(pool.map(write, sorted((self._folder.parent / "depth").glob("*.png"))))


def _depth_legend(width: int, range_mm: tuple[float, float], scale_known: bool) -> np.ndarray:
    """Return what the colours of the previews mean, (h, width, 3) uint8."""
    shown_mm = np.geomspace(*range_mm, max(2, min(_MOST_NUMBERS, (width - _LAST_PX) // _STEP_PX)))
    unit_mm = 1.0 if scale_known else range_mm[0]
    colours = (f"#{bytes(rgb).hex()}" for rgb in colour_depth(shown_mm[None], *range_mm)[0])
    words = dict(zip([f"{mm / unit_mm:.3g}" for mm in shown_mm], colours, strict=True)) | {"unknown": "#000000"}
    words["no tissue"] = f"#{bytes([MASKED_GREY] * 3).hex()}"
    sheet = Sheet(width, _LEGEND_PX)
    sheet.text((4, 2), "depth, mm" if scale_known else "depth, multiples of the nearest", 11)
    sheet.legend((4, 18), words, _STEP_PX, 10)
    return sheet.rgb


def draw_depths(images: Sequence[np.ndarray], depths_mm: Mapping[str, Sequence[np.ndarray]], file: Path) -> None:
    """Draw a contact sheet as a PNG: one row per image, one column per kind of depth ("raw depth", "refined depth").

    `images` are (H, W, 3) uint8, depths (H, W) mm with NaN = unknown, as many of each kind as images. All share one
    colour scale, from the 2nd to the 98th percentile.
    """
    near_mm, far_mm = colour_range([depth for depths in depths_mm.values() for depth in depths])
    rows = []
    for number, (image, *depths) in enumerate(zip(images, *depths_mm.values(), strict=True)):
        pictures = [colour_depth(depth, near_mm, far_mm) for depth in depths]
        # The first row names the columns.
        titles = [title if number == 0 else " " * column for column, title in enumerate(("image", *depths_mm))]
        rows.append(dict(zip(titles, [image, *pictures], strict=True)))
    picture_grid(rows, _CELL_PX, f"red {near_mm:.0f} mm .. blue {far_mm:.0f} mm, black unknown").save(file)


def draw_renderings(pairs: Mapping[int, tuple[np.ndarray, np.ndarray]], file: Path) -> None:
    """Draw a row per frame number as a PNG: the frame (H, W, 3) uint8, a rendering of it, their absolute difference."""
    rows = [
        {f"frame {number}": rgb, "surface, rendered": rendered, "difference": cv2.absdiff(rgb, rendered)}
        for number, (rgb, rendered) in pairs.items()
    ]
    picture_grid(rows, _CELL_PX).save(file)


def colour_range(maps: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return what the ends of a colour map show: the 2nd and 98th percentile of known values; 1 and 2 without any."""
    known = np.concatenate([values[np.isfinite(values)] for values in maps])
    low, high = np.percentile(known, (2, 98)) if len(known) else (1.0, 2.0)
    return float(low), float(max(high, low + 1e-3))
