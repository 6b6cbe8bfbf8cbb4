"""Windows of a sequence: corners of a host frame and their observations in the frames after it, by optical flow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from scopemap.cameras.rectification import Rectifier, working_camera, working_size
from scopemap.config import Config
from scopemap.flow.corners import detect_corners, match_corners
from scopemap.flow.dis import DisFlow
from scopemap.frame import Frame, is_constant
from scopemap.io.sequence import Sequence
from scopemap.masking.mask_files import create_masks
from scopemap.masking.masker import Masker

MAX_FRAMES = 120
"""Number of frames at the start of a sequence that are used."""

_EVERY, _MIN_KEPT = 4, 30  # of these frames every fourth is used, of a short sequence more of them
_HOST_EVERY, _MAX_GAP = 5, 15  # used frames from one host to the next, and to its last partner at most
_MAX_PARTNERS = 10
_CELL_PX = 16
_CONSISTENCY_PX = 1.0
_MIN_SHARE = 0.35  # of a host's corners that a partner observes
_MIN_CORNERS = 40


@dataclass(frozen=True)
class Window:
    """N corners of a host frame and their observations in K partner frames.

    Attributes
    ----------
    start : (N, 2) float64 px in the host, from the principal point. seen : (N, K, 2) the same in the partners, NaN
    where not observed. half_width_px : half the width of the image. aspect : fy over fx.
    """

    start: np.ndarray
    seen: np.ndarray
    half_width_px: float
    aspect: float = 1.0


def windows_of(sequence: Sequence, config: Config) -> Iterator[Window]:
    """Yield the windows of the first `MAX_FRAMES` frames, at the default working size or smaller.

    A window ends where flow loses the host's corners; one with less than two partners or 40 corners is left out. Flow
    is DIS without smoothing: smooth flow reduces parallax, which biases the focal length by 5 %.
    """
    frames = _kept(_at_default_size(sequence), config)
    flow = DisFlow(smooth=False)
    for number in range(0, len(frames) - 2, _HOST_EVERY):
        window = _window(frames[number : number + _MAX_GAP + 1], flow)
        if window is not None:
            yield window


def _at_default_size(sequence: Sequence) -> Sequence:
    """Return the sequence at the default working size or smaller: larger images cost more and add little."""
    source = sequence.rectifier.source
    size = working_size(source.width, source.height)
    if max(size) >= max(sequence.camera.width, sequence.camera.height):
        return sequence
    return replace(sequence, rectifier=Rectifier(source, working_camera(source, size)))


def _kept(sequence: Sequence, config: Config) -> list[Frame]:
    masker = Masker(config.mask, create_masks(config.mask, sequence.rectifier, sequence.source.masks))
    count = min(sequence.count or MAX_FRAMES, MAX_FRAMES)
    every = min(max(count // _MIN_KEPT, 1), _EVERY)
    frames = islice(sequence.frames(), MAX_FRAMES)
    # The masker sees all of them: it learns the field of view.
    return [masked for number, masked in enumerate(map(masker, frames)) if number % every == 0]


def _window(frames: list[Frame], flow: DisFlow) -> Window | None:
    host, camera = frames[0], frames[0].camera
    if is_constant(host.rgb):
        return None
    corners = detect_corners(replace(host, depth_mm=np.ones_like(host.valid, dtype=np.float32)), _CELL_PX)
    seen: list[np.ndarray] = []
    for partner in frames[1:] if len(corners) else []:
        number, pixels = match_corners(
            corners, flow.estimate_both(host.rgb, partner.rgb), partner.valid, _CONSISTENCY_PX
        )
        if len(number) < _MIN_SHARE * len(corners):
            break
        seen.append(np.full(corners.shape, np.nan))
        seen[-1][number] = pixels
    if len(seen) < 2:
        return None
    chosen = np.unique(np.linspace(0, len(seen) - 1, _MAX_PARTNERS).round().astype(int))
    pixels = np.stack([seen[i] for i in chosen], 1)
    often = np.isfinite(pixels[..., 0]).sum(1) >= max(2, len(chosen) // 2)
    if often.sum() < _MIN_CORNERS:
        return None
    axis = np.array([camera.cx, camera.cy])
    return Window(corners[often] - axis, pixels[often] - axis, camera.width / 2, camera.fy / camera.fx)
