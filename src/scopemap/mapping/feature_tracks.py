"""Which points of which keyframes are seen again where: corners spread over the image, carried by optical flow."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import MappingSettings
from scopemap.flow.corners import detect_corners, match_corners
from scopemap.flow.estimator import FlowEstimator
from scopemap.frame import Frame
from scopemap.geometry.uncertainty import sigma_share
from scopemap.mapping.loop_closure import Loop
from scopemap.mapping.reprojection import Observations, Points


@dataclass(frozen=True)
class _Keyframe:
    """A keyframe that others can be linked to.

    number : among all keyframes. nth : among those of its map. rgb, valid : image and mask. places : (n, 2) of its
    points, of which `first` is the number of the first.
    """

    number: int
    nth: int
    rgb: np.ndarray
    valid: np.ndarray
    places: np.ndarray
    first: int


class _Sighting(NamedTuple):
    point: np.ndarray
    keyframe: np.ndarray
    pixel: np.ndarray


class Linker:
    """Collects keyframes one by one; each is linked to those of its map `settings.gaps` before it, both ways."""

    def __init__(self, settings: MappingSettings, flow: FlowEstimator) -> None:
        self.settings, self._flow = settings, flow
        self._recent: defaultdict[int, deque[_Keyframe]] = defaultdict(lambda: deque(maxlen=max(settings.gaps)))
        self._points: list[Points] = []
        self._sightings: list[_Sighting] = []
        self._count = self._keyframes = 0
        self._camera: PinholeCamera | None = None

    def add(self, keyframe: Frame, map_number: int = 0) -> None:
        """Take a keyframe with depth: choose its points, find them in earlier keyframes, and theirs in it."""
        assert keyframe.depth_mm is not None
        places = detect_corners(keyframe, self.settings.cell_px)
        rows, columns = places[:, 1], places[:, 0]
        self._camera = keyframe.camera
        log_depth = np.log(keyframe.depth_mm[rows, columns].astype(np.float64))
        share = sigma_share(keyframe.depth_mm, keyframe.depth_sigma_mm)[rows, columns]
        first = self._host(self._keyframes, places, log_depth, np.nan_to_num(share, nan=0.0))
        recent = self._recent[map_number]
        nth = recent[-1].nth + 1 if recent else 0
        new = _Keyframe(self._keyframes, nth, keyframe.rgb, keyframe.valid, places, first)
        for past in recent:
            if new.nth - past.nth in self.settings.gaps:
                self._link(past, new)
        recent.append(new)
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

    def collected(self, keyframes: Collection[int] | None = None) -> tuple[Points, Observations]:
        """Return all points so far, sorted by host, and all sightings of them, sorted by point.

        keyframes : numbers, increasing, of those that count, and by whose place here they are then called; None: all.
        """
        called = np.full(self._keyframes, -1)
        chosen = np.arange(self._keyframes) if keyframes is None else np.array(keyframes, dtype=int)
        called[chosen] = np.arange(len(chosen))
        points = Points(*(np.concatenate([getattr(p, n) for p in self._points]) for n in Points.__annotations__))
        empty = _Sighting(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
        point, keyframe, pixel = (np.concatenate(parts) for parts in zip(empty, *self._sightings, strict=True))
        host, keyframe = called[points.host], called[keyframe]
        by_host = np.argsort(host, kind="stable")[np.count_nonzero(host < 0) :]
        place = np.full(len(host), -1)
        place[by_host] = np.arange(len(by_host))
        order = np.argsort(place[point], kind="stable")
        order = order[(place[point] >= 0)[order] & (keyframe >= 0)[order]]
        sorted_points = Points(host[by_host], points.pixel[by_host], points.log_depth[by_host], points.sigma[by_host])
        return sorted_points, Observations(place[point][order], keyframe[order], self._centred(pixel[order]))

    def _host(self, keyframe: int, places: np.ndarray, log_depth: np.ndarray, share: np.ndarray) -> int:
        """Add points at pixels (n, 2) of a keyframe, of depth uncertain by `share`; return the first one's number."""
        first = self._count
        pixel = self._centred(places)
        sigma = np.hypot(share, self.settings.depth_share)
        self._points.append(Points(np.full(len(pixel), keyframe), pixel, log_depth, sigma))
        self._count += len(pixel)
        return first

    def _centred(self, pixel: np.ndarray) -> np.ndarray:
        """Return pixels (n, 2) from the principal point, y times fx / fy."""
        camera = self._camera
        if camera is None:
            return pixel
        centred: np.ndarray = (pixel - [camera.cx, camera.cy]) * [1.0, camera.fx / camera.fy]
        return centred

    def _link(self, past: _Keyframe, new: _Keyframe) -> None:
        to_new, to_past = self._flow.estimate_both(past.rgb, new.rgb)
        self._see(new, past, to_past, to_new)
        self._see(past, new, to_new, to_past)

    def _see(self, host: _Keyframe, other: _Keyframe, forth: np.ndarray, back: np.ndarray) -> None:
        """Note where points of `host` are seen in `other`, where the way back ends where it began."""
        number, pixel = match_corners(host.places, (forth, back), other.valid, self.settings.consistency_px)
        keyframe = np.full(len(number), other.number)
        self._sightings.append(_Sighting(host.first + number, keyframe, pixel))
