"""Windows of a sequence: corners of a host frame, followed by pyramidal Lucas-Kanade (Bouguet 2001) in later frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice

import cv2
import numpy as np

from scopemap.engine.cameras.rectification import Rectifier, working_camera, working_size
from scopemap.engine.config import Config, DepthSettings
from scopemap.engine.depth.anchor import depth_downscale
from scopemap.engine.depth.scopenet.estimator import ScopeNetDepth
from scopemap.engine.errors import InputError
from scopemap.engine.flow.corners import detect_corners, normalised_brightness
from scopemap.engine.frame import Frame, is_constant
from scopemap.engine.geometry.warp import resampled
from scopemap.engine.masking.masker import Masker
from scopemap.input.mask_files import masks_of
from scopemap.input.sequence import Sequence

MAX_FRAMES = 120
"""Number of frames at the start of a sequence that are used."""

_EVERY = 4  # of these frames every fourth is used, of a short sequence more of them
_MIN_KEPT = 30
_HOST_EVERY = 5  # used frames from one host to the next, and to its last partner at most
_MAX_GAP = 15
_MAX_PARTNERS = 6
_CELL_PX = 16
_CONSISTENCY_PX = 1.0
_MIN_SHARE = 0.35  # of a host's corners that a partner observes
_MIN_CORNERS = 40
_PATCH_PX = 21
_LEVELS = 3
_LEAST_EIGENVALUE = 1e-4
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)


@dataclass(frozen=True)
class Window:
    """N corners of a host frame and their observations in K partner frames.

    start : (N, 2) float64 px in the host, from the principal point. seen : (N, K, 2) the same in the partners, NaN
    where not observed. half_width_px : half the width of the image. aspect : fy over fx. log_distance : (N,) ln of the
    estimated distance of the corners along their rays, mm; None: not estimated. host : where it may be estimated.
    """

    start: np.ndarray
    seen: np.ndarray
    half_width_px: float
    aspect: float = 1.0
    log_distance: np.ndarray | None = None
    host: Frame | None = None


def frames_of_windows(sequence: Sequence, config: Config) -> Iterator[list[Frame]]:
    """Yield a host and the frames after it, as soon as they are read, for each window of the first `MAX_FRAMES` frames.

    They have the default working size or are smaller.
    """
    frames, first = list[Frame](), 0
    for frame in _kept(_at_default_size(sequence), config):
        frames.append(frame)
        if len(frames) > first + _MAX_GAP:
            yield frames[first:]
            first += _HOST_EVERY
    for number in range(first, len(frames) - 2, _HOST_EVERY):
        yield frames[number:]


def with_distance(window: Window) -> Window:
    """Return a window with the distance of its corners as scopenet estimates it in the host, at its own size."""
    host = window.host
    if host is None:
        return window
    small = host.downscaled(depth_downscale(DepthSettings(), max(host.valid.shape)))
    depth_mm = resampled(ScopeNetDepth(rays_known=False).estimate(small).values, host.camera)
    column, row = np.rint(window.start + np.array([host.camera.cx, host.camera.cy])).astype(int).T
    length = np.linalg.norm(host.camera.rays[row, column], axis=1)
    return replace(window, log_distance=np.log(depth_mm[row, column] * length), host=None)


def _at_default_size(sequence: Sequence) -> Sequence:
    """Return the sequence at the default working size or smaller: larger images cost more and add little."""
    source = sequence.rectifier.source
    size = working_size(source.width, source.height)
    if max(size) >= max(sequence.camera.width, sequence.camera.height):
        return sequence
    return replace(sequence, rectifier=Rectifier(source, working_camera(source, size)))


def _kept(sequence: Sequence, config: Config) -> Iterator[Frame]:
    masker = Masker(config.mask, masks_of(config.mask, sequence))
    count = min(sequence.count or MAX_FRAMES, MAX_FRAMES)
    every = min(max(count // _MIN_KEPT, 1), _EVERY)
    step = every * (sequence.selection.step or 1)
    selection = slice(sequence.selection.start, sequence.selection.stop, step)
    # What is skipped here does not count as skipped in the run.
    some = replace(sequence, selection=selection, choice=replace(sequence.choice, skipped={}))
    with suppress(InputError):  # a video that breaks off at once; reading all of it says so
        yield from map(masker, islice(some.frames(), -(-MAX_FRAMES // every)))


def window_of(frames: list[Frame]) -> Window | None:
    """Return the window of the first of some frames, which ends where its corners are lost.

    A corner is not searched again after a partner that does not observe it. None where less than two partners observe
    40 corners.
    """
    host, camera = frames[0], frames[0].camera
    if is_constant(host.rgb):
        return None
    corners = detect_corners(replace(host, depth_mm=np.ones_like(host.valid, dtype=np.float32)), _CELL_PX)
    if len(corners) < _MIN_CORNERS:
        return None
    pattern, seen = normalised_brightness(host.rgb), list[np.ndarray]()
    kept, pixels = np.arange(len(corners)), corners.astype(np.float32)
    for partner in frames[1:]:
        pixels, good = _followed(pattern, normalised_brightness(partner.rgb), corners[kept], pixels)
        good &= _valid_at(pixels, partner.valid)
        kept, pixels = kept[good], pixels[good]
        if len(kept) < _MIN_SHARE * len(corners) or len(kept) < _MIN_CORNERS:
            break
        seen.append(np.full((len(corners), 2), np.nan))
        seen[-1][kept] = pixels
    if len(seen) < 2:
        return None
    chosen = np.unique(np.linspace(0, len(seen) - 1, _MAX_PARTNERS).round().astype(int))
    pixels = np.stack([seen[i] for i in chosen], 1)
    often = np.isfinite(pixels[..., 0]).sum(1) >= max(2, len(chosen) // 2)
    if often.sum() < _MIN_CORNERS:
        return None
    axis = np.array([camera.cx, camera.cy])
    return Window(corners[often] - axis, pixels[often] - axis, camera.width / 2, camera.fy / camera.fx, host=host)


def _followed(
    image_from: np.ndarray, image_to: np.ndarray, corners: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where corners (n, 2) are in another image (H, W) uint8, float32 px, and which are found there and back."""
    places = corners.astype(np.float32)
    there, found = _searched(image_from, image_to, places, start)
    back, found_back = _searched(image_to, image_from, there, places)
    return there, found & found_back & (np.linalg.norm(back - places, axis=1) <= _CONSISTENCY_PX)


def _searched(
    image_from: np.ndarray, image_to: np.ndarray, places: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    # OpenCV writes the result over the start.
    begin, patch, flags = start[:, None].copy(), (_PATCH_PX, _PATCH_PX), cv2.OPTFLOW_USE_INITIAL_FLOW
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        image_from, image_to, places[:, None], begin, None, None, patch, _LEVELS, _STOP, flags, _LEAST_EIGENVALUE
    )
    return moved[:, 0], status.ravel() > 0


def _valid_at(pixels: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return which pixels (n, 2) are inside an image and valid (H, W) there."""
    last = np.array(valid.shape[::-1]) - 1
    nearest = np.clip(np.rint(pixels), 0, last).astype(int)
    inside = ((pixels >= 0) & (pixels <= last)).all(1)
    good: np.ndarray = inside & valid[nearest[:, 1], nearest[:, 0]]
    return good
