"""Which points of which keyframes are seen again where: corners spread over the image, carried by optical flow.

Shading moves with the lamp and pulls flow along where tissue has no texture; corners hold on to the tissue itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.backend.adjustment import Points, Sightings
from scopemap.backend.loops import Loop
from scopemap.camera import PinholeCamera
from scopemap.config import BackendSettings
from scopemap.flow import FlowEstimator
from scopemap.frame import Frame
from scopemap.geometry.uncertainty import sigma_share

_CORNER_BLOCK_PX = 5
_BORDER_PX = 3


@dataclass(frozen=True)
class _Keyframe:
    """A keyframe that others can be linked to: number, image, mask, places (n, 2) of its points, first point."""

    number: int
    rgb: np.ndarray
    valid: np.ndarray
    places: np.ndarray
    first: int


class _Sighting(NamedTuple):
    point: np.ndarray
    keyframe: np.ndarray
    pixel: np.ndarray


class Linker:
    """Collects keyframes one by one; each is linked to those `settings.gaps` before it, both ways."""

    def __init__(self, settings: BackendSettings, flow: FlowEstimator) -> None:
        self.settings, self._flow = settings, flow
        self._recent: deque[_Keyframe] = deque(maxlen=max(settings.gaps))
        self._points: list[Points] = []
        self._sightings: list[_Sighting] = []
        self._count = self._keyframes = 0
        self._camera: PinholeCamera | None = None

    def add(self, keyframe: Frame) -> None:
        """Take a keyframe with depth: choose its points, find them in earlier keyframes, and theirs in it."""
        assert keyframe.depth_mm is not None
        places = corners(keyframe, self.settings.cell_px)
        rows, columns = places[:, 1], places[:, 0]
        self._camera = keyframe.camera
        log_depth = np.log(keyframe.depth_mm[rows, columns].astype(np.float64))
        share = sigma_share(keyframe.depth_mm, keyframe.depth_sigma_mm)[rows, columns]
        first = self._host(self._keyframes, places, log_depth, np.nan_to_num(share, nan=0.0))
        new = _Keyframe(self._keyframes, keyframe.rgb, keyframe.valid, places, first)
        for past in self._recent:
            if new.number - past.number in self.settings.gaps:
                self._link(past, new)
        self._recent.append(new)
        self._keyframes += 1

    def close(self, loop: Loop) -> None:
        """Take the landmarks of a loop as points that one keyframe hosts and the other sees, both ways."""
        for host, other, places, log_depth, pixels in (
            (loop.past, loop.new, loop.pixels_past, loop.log_depth_past, loop.pixels_new),
            (loop.new, loop.past, loop.pixels_new, loop.log_depth_new, loop.pixels_past),
        ):
            known = np.isfinite(log_depth)
            first = self._host(host, places[known], log_depth[known], np.zeros(known.sum()))
            number = first + np.arange(known.sum())
            self._sightings.append(_Sighting(number, np.full(len(number), other), pixels[known]))

    def collected(self) -> tuple[Points, Sightings]:
        """Return all points so far, sorted by host, and all sightings of them, sorted by point."""
        points = Points(*(np.concatenate([getattr(p, n) for p in self._points]) for n in Points.__annotations__))
        empty = _Sighting(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
        point, keyframe, pixel = (np.concatenate(parts) for parts in zip(empty, *self._sightings, strict=True))
        by_host = np.argsort(points.host, kind="stable")
        place = np.empty_like(by_host)
        place[by_host] = np.arange(len(by_host))
        order = np.argsort(place[point], kind="stable")
        sorted_points = Points(*(getattr(points, name)[by_host] for name in Points.__annotations__))
        return sorted_points, Sightings(place[point][order], keyframe[order], pixel[order])

    def _host(self, keyframe: int, places: np.ndarray, log_depth: np.ndarray, share: np.ndarray) -> int:
        """Add points at pixels (n, 2) of a keyframe, of depth uncertain by `share`; return the first one's number."""
        camera, first = self._camera, self._count
        assert camera is not None
        x, y = np.asarray(places, dtype=np.float64).reshape(-1, 2).T
        rays = np.column_stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))])
        sigma = np.hypot(share, self.settings.depth_share)
        self._points.append(Points(np.full(len(x), keyframe), rays, log_depth, sigma))
        self._count += len(x)
        return first

    def _link(self, past: _Keyframe, new: _Keyframe) -> None:
        to_new, to_past = self._flow.estimate_both(past.rgb, new.rgb)
        self._see(new, past, to_past, to_new)
        self._see(past, new, to_new, to_past)

    def _see(self, host: _Keyframe, other: _Keyframe, forth: np.ndarray, back: np.ndarray) -> None:
        """Note where points of `host` are seen in `other`, where the way back ends where it began."""
        start = host.places.astype(np.float32)
        pixel = start + forth[host.places[:, 1], host.places[:, 0]]
        returned = pixel + _sampled(back, pixel)
        height, width = other.valid.shape
        nearest = np.clip(np.rint(pixel).astype(int), 0, [width - 1, height - 1])
        inside = ((pixel >= 0) & (pixel <= [width - 1, height - 1])).all(1)
        good = inside & other.valid[nearest[:, 1], nearest[:, 0]]
        good &= np.linalg.norm(returned - start, axis=1) <= self.settings.consistency_px
        number = np.flatnonzero(good)
        self._sightings.append(
            _Sighting(host.first + number, np.full(len(number), other.number), pixel[number].astype(np.float64))
        )


def corners(frame: Frame, cell_px: int) -> np.ndarray:
    """Return pixels (n, 2) int x, y: the most corner-like one with depth of each cell of `cell_px` x `cell_px`.

    The strength is the smaller eigenvalue of the structure tensor (Shi and Tomasi, CVPR 1994). Every whole cell with
    usable tissue gives one, however weak, unless it is quite flat: where corners are few, edges and shades are better
    than nothing.
    """
    assert frame.depth_mm is not None
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    # On brightness relative to its surround: far tissue is dark, not featureless.
    level = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 8.0) + 8.0
    strength = cv2.cornerMinEigenVal(grey / level, _CORNER_BLOCK_PX)
    usable = frame.valid & (frame.depth_mm > 0) & np.isfinite(frame.depth_mm)
    # A patch that touches a mask's edge has a corner that is not the tissue's.
    usable = cv2.erode(usable.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8), borderValue=0) > 0
    strength = np.where(usable, strength, -1.0)
    height, width = (side // cell_px * cell_px for side in strength.shape)
    cells: np.ndarray = strength[:height, :width].reshape(height // cell_px, cell_px, width // cell_px, cell_px)
    cells = cells.transpose(0, 2, 1, 3).reshape(-1, cell_px * cell_px)
    best = cells.argmax(1)
    row, column = np.divmod(np.arange(len(cells)), width // cell_px)
    places = np.column_stack([column * cell_px + best % cell_px, row * cell_px + best // cell_px])
    return places[cells.max(1) > 0]


def _sampled(flow: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Flow (n, 2) at pixels (n, 2), bilinear; NaN outside. Not OpenCV's remap, which refuses none and very many."""
    height, width = flow.shape[:2]
    inside = ((pixel >= 0) & (pixel <= [width - 1, height - 1])).all(axis=1, keepdims=True)
    place = np.where(inside, pixel, 0.0)
    corner = np.clip(np.floor(place).astype(int), 0, [width - 2, height - 2])
    x, y = corner.T
    a, b = (place - corner).T[..., None]
    top = (1 - a) * flow[y, x] + a * flow[y, x + 1]
    bottom = (1 - a) * flow[y + 1, x] + a * flow[y + 1, x + 1]
    return np.where(inside, (1 - b) * top + b * bottom, np.nan)
