"""Measures of one video frame after the other: brightness, sharpness, change, motion, colour and exposure."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from scopemap.engine.config import MaskSettings
from scopemap.engine.frame import Frame, is_constant
from scopemap.engine.masking.masker import BRIGHT_LEVEL, FieldOfView, Masker, darker_channels, is_lit, specular
from scopemap.engine.tracking.sharpness import sharpness
from scopemap.input.picture_difference import LEAST_DIFFERENCE, mean_difference
from scopemap.report.frame_pictures import shrunk, shrunk_shape

_SMALL_PX = 320
_FLOW_PX = 160
# A frame with a smaller lit share is blank: text on black shows no tissue.
_LEAST_LIT = 0.05


@dataclass(frozen=True)
class FrameMeasures:
    """Measures of one frame.

    position : in the input, from 0, as `--frames` counts. part : number of the part of the video that was read.
    time_s : from the reader. blank : whether it shows next to nothing that is not black. brightness : mean level in the
    field, 0-255. sharpness : as the tracker has it. change : mean difference from the last frame of the part that was
    no repeat, grey levels. motion : median flow since the frame before, share of the width. correlation : correlation
    with the frame before, moved by that flow, -1 to 1; 1 for the first frame of a part. redness : mean red over the
    stronger of green and blue. clipped, dark, highlights : shares of the field. usable : share of the frame that a run
    would use.
    """

    position: int
    part: int
    time_s: float
    blank: bool
    brightness: float
    sharpness: float
    change: float
    motion: float
    correlation: float
    redness: float
    clipped: float
    dark: float
    highlights: float
    usable: float


@dataclass(frozen=True)
class InspectedFrame:
    """One frame of the video.

    rgb : (H, W, 3) uint8 as in the video. small : (h, w, 3) uint8, its longer side at most 320 px. lit : (h, w) bool,
    which pixels are not black. field : (h, w) bool, field of view as known so far. frame : as a run sees it, rectified
    and masked. measures : of it.
    """

    rgb: np.ndarray
    small: np.ndarray
    lit: np.ndarray
    field: np.ndarray
    frame: Frame
    measures: FrameMeasures


class FrameInspector:
    """Measures the frames of a video in their order; keeps the last one of a part that was no repeat.

    frames_only_resize : whether a run's frame is the whole picture at another size.
    """

    def __init__(self, *, frames_only_resize: bool) -> None:
        self._frames_only_resize = frames_only_resize
        self._field, self._masker = FieldOfView(), Masker(MaskSettings())
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._kept: tuple[np.ndarray, np.ndarray] | None = None
        self._before: np.ndarray | None = None
        self._part = 0

    def __call__(self, position: int, part: int, rgb: np.ndarray, frame: Frame) -> InspectedFrame:
        """Return the picture (H, W, 3) uint8 at a position, with the frame that a run makes of it, measured.

        part : number of the part of the video; the first frame of each is compared with none before it.
        """
        if part != self._part:
            self._part, self._kept, self._before = part, None, None
        # Most runs' frames have the small picture's size.
        is_small = self._frames_only_resize and frame.rgb.shape[:2] == shrunk_shape(rgb.shape, _SMALL_PX)
        small = frame.rgb if is_small else shrunk(rgb, _SMALL_PX)
        lit = is_lit(small)
        field, masked = self._field(lit, np.ones_like(lit)), self._masker(frame)
        inside = field if field.any() else np.ones_like(field)
        darkest, middle = darker_channels(small)
        clipped = (middle >= BRIGHT_LEVEL) & inside
        red, green, blue, _ = cv2.mean(small, (inside & ~clipped).astype(np.uint8))
        motion, correlation = self._motion(small)
        measures = FrameMeasures(
            position=position,
            part=part,
            time_s=masked.time_s,
            blank=bool(is_constant(small) or lit[inside].mean() < _LEAST_LIT),
            brightness=sum(cv2.mean(small, inside.astype(np.uint8))[:3]) / 3,
            sharpness=sharpness(masked.rgb, masked.valid),
            change=self._change(rgb, small),
            motion=motion,
            correlation=correlation,
            redness=red / max(green, blue, 1.0),
            clipped=float(clipped[inside].mean()),
            dark=1 - float(lit[inside].mean()),
            highlights=float(specular(darkest, inside)[inside].mean()),
            usable=float(masked.valid.mean()),
        )
        return InspectedFrame(rgb, small, lit, field, masked, measures)

    def _change(self, rgb: np.ndarray, small: np.ndarray) -> float:
        change = np.inf
        if self._kept is not None:
            # Means of pixels differ less than the pixels do: only where they agree, all pixels are compared.
            change = mean_difference(small, self._kept[1])
            if change < LEAST_DIFFERENCE:
                change = mean_difference(rgb, self._kept[0])
        if change >= LEAST_DIFFERENCE:
            self._kept = rgb, small
        return change

    def _motion(self, small: np.ndarray) -> tuple[float, float]:
        """Return motion and correlation."""
        grey = cv2.cvtColor(shrunk(small, _FLOW_PX), cv2.COLOR_RGB2GRAY)
        before, self._before = self._before, grey
        if before is None:
            return 0.0, 1.0
        flow = self._flow.calc(before, grey, np.zeros((*grey.shape, 2), np.float32))
        y, x = np.indices(grey.shape, np.float32)
        # Large shades agree whatever moves: fine ones tell.
        fine, moved = _fine(before), cv2.remap(_fine(grey), x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)
        norm = float(np.sqrt((fine**2).mean() * (moved**2).mean()))
        correlation = float((fine * moved).mean()) / norm if norm > 0 else 1.0
        return float(np.median(np.hypot(flow[..., 0], flow[..., 1]))) / grey.shape[1], correlation


def _fine(grey: np.ndarray) -> np.ndarray:
    """Return a picture (H, W) uint8 without what is larger than some 10 pixels, float32."""
    picture = grey.astype(np.float32)
    return cv2.GaussianBlur(picture, (0, 0), 0.7) - cv2.GaussianBlur(picture, (0, 0), 4.0)
