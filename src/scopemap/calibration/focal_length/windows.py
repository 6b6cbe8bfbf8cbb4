"""Windows of a sequence: corners of one frame, and where flow finds them in the frames that follow it."""

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

MOST_FRAMES = 120
"""How many frames at the start of a sequence are looked at."""

_EVERY, _KEPT = 4, 30  # of these frames every fourth is kept, of a short sequence more of them
_HOST_EVERY, _REACH = 5, 15  # kept frames from one host to the next, and to its last partner at most
_MOST_PARTNERS = 10
_CELL_PX = 16
_CONSISTENCY_PX = 1.0
_LEAST_SHARE = 0.35  # of a host's corners, found again, for a frame to be its partner
_LEAST_CORNERS = 40


@dataclass(frozen=True)
class Window:
    """Corners of a host frame in N places, seen again in K partners.

    Attributes
    ----------
    start : (N, 2) float64, px x, y in the host, from the optical axis. seen : (N, K, 2) the same in the partners, NaN
    where not found again. half_width_px : half the width of the picture. aspect : fy over fx.
    """

    start: np.ndarray
    seen: np.ndarray
    half_width_px: float
    aspect: float = 1.0


def windows_of(sequence: Sequence, config: Config) -> Iterator[Window]:
    """Yield the windows of the first `MOST_FRAMES` frames, at the working size that is chosen where none is given.

    A window reaches as far as flow links its host to what follows; one with less than two partners or 40 corners is
    left out. Flow is DIS without its smoothing: a smooth flow takes parallax away, and the focal length grows by 5 %.
    """
    frames = _kept(_at_chosen_size(sequence), config)
    flow = DisFlow(smooth=False)
    for number in range(0, len(frames) - 2, _HOST_EVERY):
        window = _window(frames[number : number + _REACH + 1], flow)
        if window is not None:
            yield window


def _at_chosen_size(sequence: Sequence) -> Sequence:
    """Return the sequence no larger than it is by default: a larger picture costs more, and says little more."""
    source = sequence.rectifier.source
    size = working_size(source.width, source.height)
    if max(size) >= max(sequence.camera.width, sequence.camera.height):
        return sequence
    return replace(sequence, rectifier=Rectifier(source, working_camera(source, size)))


def _kept(sequence: Sequence, config: Config) -> list[Frame]:
    masker = Masker(config.mask, create_masks(config.mask, sequence.rectifier, sequence.source.masks))
    count = min(sequence.count or MOST_FRAMES, MOST_FRAMES)
    every = min(max(count // _KEPT, 1), _EVERY)
    frames = islice(sequence.frames(), MOST_FRAMES)
    # The masker sees all of them: it learns the field of view.
    return [masked for number, masked in enumerate(map(masker, frames)) if number % every == 0]


def _window(frames: list[Frame], flow: DisFlow) -> Window | None:
    host, camera = frames[0], frames[0].camera
    if is_constant(host.rgb):
        return None
    places = detect_corners(replace(host, depth_mm=np.ones_like(host.valid, dtype=np.float32)), _CELL_PX)
    seen: list[np.ndarray] = []
    for partner in frames[1:] if len(places) else []:
        number, pixels = match_corners(
            places, flow.estimate_both(host.rgb, partner.rgb), partner.valid, _CONSISTENCY_PX
        )
        if len(number) < _LEAST_SHARE * len(places):
            break
        seen.append(np.full(places.shape, np.nan))
        seen[-1][number] = pixels
    if len(seen) < 2:
        return None
    chosen = np.unique(np.linspace(0, len(seen) - 1, _MOST_PARTNERS).round().astype(int))
    everywhere = np.stack([seen[i] for i in chosen], 1)
    often = np.isfinite(everywhere[..., 0]).sum(1) >= max(2, len(chosen) // 2)
    if often.sum() < _LEAST_CORNERS:
        return None
    axis = np.array([camera.cx, camera.cy])
    return Window(places[often] - axis, everywhere[often] - axis, camera.width / 2, camera.fy / camera.fx)
