"""Small pictures of a run's frames, and what is measured on each frame, for its report.

DIR/frames/  000012.jpg (the rectified frame)  000012_mask.png (white: usable, grey: an instrument)
            measures.csv (one row per frame)
"""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from scopemap.engine.errors import reporting
from scopemap.engine.frame import Rows

if TYPE_CHECKING:
    from scopemap.engine.odometry import Step

FOLDER = "frames"
_MOST = 64
_MOST_MEASURES = 100_000
_LONGEST_SIDE_PX = 320
_QUALITY = 80
WHOLLY_USABLE = 255
"""Level of the usable pixels in a picture's mask."""
_INSTRUMENT = 90
_COLUMNS = ("index", "sharpness", "ms")
_MEASURE = np.dtype(list(zip(_COLUMNS, (np.int64, np.float64, np.float64), strict=True)))


class FramePictures:
    """Keeps small pictures of frames spread over a run, at most 64 (n, of every n-th, doubles), and their measures.

    A measure is kept of every frame (of 100,000; beyond it fewer of the older ones): `sharpness`, the standard
    deviation of the Laplacian of the grey picture inside the mask, and, where the run itself is `timed`, `ms`, the time
    since the frame before.
    """

    def __init__(self, *, timed: bool = True) -> None:
        self._pictures = dict[int, tuple[bytes, bytes]]()
        self._measures, self._every, self._count = Rows(_MEASURE), 1, 0
        self._timed, self._before = timed, time.perf_counter()

    def forget(self) -> None:
        """Begin anew, where a run begins again at its first frame."""
        self._pictures, self._measures = {}, Rows(_MEASURE)
        self._every, self._count, self._before = 1, 0, time.perf_counter()

    def __call__(self, step: Step) -> None:
        """Put the frame of a step in: an observer for `reconstruct`."""
        self.put(step.frame.index, step.frame.rgb, step.frame.valid, step.frame.instruments)

    def again(self, step: Step) -> None:
        """Put the frame of a step in that was made before the run was resumed: its time is not known any more."""
        if not step.skipped:
            timed, self._timed = self._timed, False
            self(step)
            self._timed = timed

    def put(self, index: int, rgb: np.ndarray, valid: np.ndarray, instruments: np.ndarray | None = None) -> None:
        """Measure a frame, its picture (H, W, 3) uint8, usable pixels, instruments (H, W) bool; keep some."""
        now = time.perf_counter()
        mask = valid.astype(np.uint8)
        laplacian = cv2.Laplacian(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.CV_16S)
        sharpness = float(cv2.meanStdDev(laplacian, mask=mask)[1][0, 0])
        if self._count % self._every == 0:
            small = shrunk(rgb, _LONGEST_SIDE_PX)
            levels = mask * np.uint8(WHOLLY_USABLE)
            if instruments is not None:
                levels[instruments] = _INSTRUMENT
            levels = shrunk(levels, _LONGEST_SIDE_PX, cv2.INTER_NEAREST)
            self._pictures[index] = (_encoded(".jpg", small), _encoded(".png", levels))
        waited_ms = 1000 * (now - self._before) if self._timed else np.nan
        self._measures.append(np.array([(index, sharpness, waited_ms)], _MEASURE))
        self._count += 1
        if len(self._measures) > _MOST_MEASURES:
            kept = np.ones(len(self._measures), bool)
            kept[1 : _MOST_MEASURES // 2 : 2] = False
            self._measures.keep(kept)
        if len(self._pictures) > _MOST:
            self._pictures = dict(list(self._pictures.items())[::2])
            self._every *= 2
        self._before = now

    def save(self, run: Path) -> None:
        """Write them to a run's folder in place of those that it has. Raises `InputError` where that fails."""
        folder = run / FOLDER
        with reporting(f"cannot write to {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            # Here: `scopemap inspect` shrinks pictures without all that results need, and starts sooner.
            from scopemap.result.result import Result

            place = Result(run)
            for index in place.pictured:
                place.picture_file(index).unlink()
                place.mask_file(index).unlink(missing_ok=True)
            for index, (picture, mask) in self._pictures.items():
                place.picture_file(index).write_bytes(picture)
                place.mask_file(index).write_bytes(mask)
            with (folder / "measures.csv").open("w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow(_COLUMNS)
                writer.writerows(
                    (index, f"{sharp:.4g}", f"{ms:.4g}") for index, sharp, ms in self._measures.read().tolist()
                )


def shrunk(image: np.ndarray, longest_px: int, interpolation: int = cv2.INTER_AREA) -> np.ndarray:
    """Return a copy of an image whose longer side is at most `longest_px`."""
    height, width = shrunk_shape(image.shape, longest_px)
    return cv2.resize(image, (width, height), interpolation=interpolation)


def shrunk_shape(shape: tuple[int, ...], longest_px: int) -> tuple[int, int]:
    """Return height and width of an image of some shape (h, w, ...) whose longer side is to be at most `longest_px`."""
    scale = min(1.0, longest_px / max(shape[:2]))
    return max(1, round(scale * shape[0])), max(1, round(scale * shape[1]))


def thinned(values: np.ndarray, widest_px: int) -> np.ndarray:
    """Return every n-th value of a map (H, W), at most `widest_px` in a row."""
    width = min(values.shape[1], widest_px)
    size = (width, max(1, round(values.shape[0] * width / values.shape[1])))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST))


def _encoded(ending: str, image: np.ndarray) -> bytes:
    if ending == ".jpg":
        return cv2.imencode(ending, image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    two_levels = not (image == _INSTRUMENT).any()
    return cv2.imencode(ending, image, [cv2.IMWRITE_PNG_BILEVEL, int(two_levels)])[1].tobytes()
