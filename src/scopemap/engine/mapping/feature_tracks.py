"""Feature tracks: corners of keyframes, matched in others by aligned patches, and loops.

Flow is computed between successive keyframes only, and between small images; where it matches nothing, as across a
cut, it is computed again from the flow that depth and poses as tracked predict. Patches in near keyframes are searched
from the composed flows of those between; those in distant ones, whose parallax outweighs what flow lags behind, from
where depth and poses as tracked have them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.flow.corners import (
    detect_corners,
    expected_flow,
    flow_at,
    match_corners,
    normalised_brightness,
    refined_corners,
    resized,
    small_flow_size,
)
from scopemap.engine.flow.estimator import FlowEstimator, FlowPair
from scopemap.engine.frame import Frame, RowTable, rows_in_memory
from scopemap.engine.geometry.se3 import inverse
from scopemap.engine.geometry.uncertainty import relative_sigma
from scopemap.engine.mapping.bundle_problem import Observations, Points
from scopemap.engine.mapping.loop_closure import MOST_RECENT, Loop

# By hand; 16 and 32, where flow lags less: chosen on phantoms of an abdominal wall.
KEYFRAME_GAPS = (1, 2, 3, 5, 8, 16, 32)
"""A keyframe's corners are matched in those so many before it."""
NEAR_GAPS = tuple(gap for gap in KEYFRAME_GAPS if gap <= MOST_RECENT)
"""Those of keyframes just before it: farther apart two may have a few pixels in common, which prove nothing."""
_LEAST_DEPTH_SIGMA = 0.2  # by hand: standard deviation that every estimated depth has at least, over the depth
_CELL_PX = 16  # by hand: one corner in each cell of that size
# Maps whose last keyframes are kept: as many as a lost camera may be found again in.
_MOST_MAPS = 20  # by hand
_CONSISTENCY_PX = 2.0  # by hand: largest forward-backward error of flow, about one of its own pixels
_LEAST_IN_COMMON = 0.15  # by hand: of either picture, by depth and poses as tracked
# Of the corners of both (chance gives 0.03 on real clips); below it keyframes before are tried no more.
_LEAST_MATCHED = 0.05  # by hand


@dataclass
class _FlowKeyframe:
    """A keyframe that later ones are matched with.

    number : among all keyframes. number_in_map : among those of its map. corners : (n, 2) int px; the first of them is
    point `first_point`. pattern : (H, W) uint8 as `normalised_brightness`. composed : flows to the latest
    keyframe of its map and back, None: it is the latest or too old, or the camera has been in another map since.
    """

    number: int
    number_in_map: int
    frame: Frame
    corners: np.ndarray
    first_point: int
    pattern: np.ndarray
    composed: FlowPair | None = None


class PairMatches(NamedTuple):
    """Corners of two keyframes that were found in the other one: their numbers (n,), and where there, (n, 2) px."""

    of_past: tuple[np.ndarray, np.ndarray]
    of_new: tuple[np.ndarray, np.ndarray]

    @property
    def corners(self) -> int:
        """Number of corners of both that were found."""
        return len(self.of_past[0]) + len(self.of_new[0])


class KeyframeMatches(NamedTuple):
    """What was matched of a new keyframe, so that nobody does it again.

    corners : (n, 2) int px. pattern : (H, W) uint8, `normalised_brightness`. pairs : its matches with earlier
    keyframes, by the numbers of their frames. latest : number of the frame of the keyframe before. coarse : small flows
    from that one, and back; None: they are unknown.
    """

    corners: np.ndarray
    pattern: np.ndarray
    pairs: Mapping[int, PairMatches] = MappingProxyType({})
    latest: int = -1
    coarse: FlowPair | None = None


# Columns of the table of points.
_POINT = np.dtype([("host", np.int64), ("pixel", np.float64, (2,)), ("log_depth", np.float64), ("sigma", np.float32)])
_MATCH = np.dtype([("point", np.int64), ("keyframe", np.int64), ("pixel", np.float64, (2,))])
"""An observation, in the order in which they were found; its pixel is as in the image."""


class FeatureTracks:
    """Takes keyframes one by one; each is matched both ways with earlier ones of its map.

    gaps : how many keyframes before it these are.
    """

    _camera: PinholeCamera | None = None

    def __init__(
        self,
        flow: FlowEstimator,
        table: RowTable = rows_in_memory,
        gaps: Collection[int] = KEYFRAME_GAPS,
    ) -> None:
        self._flow, self._gaps = flow, gaps
        self._recent, self.keyframe_count = dict[int, deque[_FlowKeyframe]](), 0
        self._points, self._matches = table("points", _POINT), table("observations", _MATCH)

    def add(self, keyframe: Frame, map_number: int = 0, known: KeyframeMatches | None = None) -> KeyframeMatches:
        """Take a keyframe with depth: its corners become points, and are matched with earlier keyframes.

        known : what was matched of it elsewhere. Returns what is known now.
        """
        assert keyframe.depth_mm is not None
        if known is None:
            known = KeyframeMatches(detect_corners(keyframe, _CELL_PX), normalised_brightness(keyframe.rgb))
        corners = known.corners
        rows, columns = corners[:, 1], corners[:, 0]
        self._camera = keyframe.camera
        log_depth = np.log(keyframe.depth_mm[rows, columns].astype(np.float64))
        share = relative_sigma(keyframe.depth_mm, keyframe.depth_sigma_mm)[rows, columns]
        first = self._add_points(self.keyframe_count, corners, log_depth, np.nan_to_num(share, nan=0.0))
        # The map that was used last is the last one.
        recent = self._recent[map_number] = deque(self._recent.pop(map_number, ()), maxlen=max(self._gaps))
        for oldest in [*self._recent][:-_MOST_MAPS]:
            del self._recent[oldest]
        # With the flows, and the older keyframes, of each new map memory would grow by tens of megabytes.
        for others in (others for other, others in self._recent.items() if other != map_number):
            while len(others) > MOST_RECENT:
                others.popleft()
            for past in others:
                past.composed = None
        number_in_map = recent[-1].number_in_map + 1 if recent else 0
        new = _FlowKeyframe(self.keyframe_count, number_in_map, _slim(keyframe), corners, first, known.pattern)
        matches = self._match_with(recent, new, known)
        recent.append(new)
        self.keyframe_count += 1
        return matches

    def _match_with(self, recent: deque[_FlowKeyframe], new: _FlowKeyframe, known: KeyframeMatches) -> KeyframeMatches:
        """Match a new keyframe both ways with recent ones of its map, the latest first; return what is known then."""
        if not recent:
            return known
        latest = recent[-1]
        coarse = known.coarse if known.latest == latest.frame.index else None
        if coarse is None:
            coarse = self._flow.estimate_both(*self._small_pictures(latest, new))
        pairs, overlaps = dict(known.pairs), True
        for past in reversed(recent):
            gap, number = new.number_in_map - past.number_in_map, past.frame.index
            wanted = overlaps and gap in self._gaps
            start = self._start(past, new, coarse, gap, wanted=wanted)
            if wanted and number not in pairs and start is not None:
                pairs[number] = _pair(past, new, start)
                expected = None
                if gap == 1 and not _overlap(past, new, pairs[number]):
                    expected = _expected_flows(past.frame, new.frame)
                if expected is not None:  # as across a cut: poses tell where flow finds nothing by itself
                    pictures = self._small_pictures(past, new)
                    size = pictures[0].shape[1::-1]
                    start = flow_at(expected[0], size), flow_at(expected[1], size)
                    coarse = past.composed = self._flow.estimate_checked(*pictures, start)
                    pairs[number] = _pair(past, new, coarse)
            if wanted and number in pairs:
                found = pairs[number]
                self._add_matches(past.first_point + found.of_past[0], new.number, found.of_past[1])
                self._add_matches(new.first_point + found.of_new[0], past.number, found.of_new[1])
                overlaps = _overlap(past, new, found)
        return known._replace(pairs=pairs, latest=latest.frame.index, coarse=coarse)

    def _small_pictures(self, one: _FlowKeyframe, other: _FlowKeyframe) -> tuple[np.ndarray, np.ndarray]:
        """Return both pictures at the size between which flow is computed."""
        size = small_flow_size(self._flow, one.frame.valid.shape[::-1])
        return resized(one.frame.rgb, size), resized(other.frame.rgb, size)

    def _start(
        self, past: _FlowKeyframe, new: _FlowKeyframe, coarse: FlowPair, gap: int, *, wanted: bool
    ) -> FlowPair | None:
        """Return flows between a keyframe and a new one to search from; None where nothing is to be searched.

        coarse : flows between the latest keyframe and the new one, with which those of earlier ones are composed.
        """
        if gap == 1:
            past.composed = coarse
        elif past.composed is not None and gap <= MOST_RECENT:
            past.composed = _composed(past.composed[0], coarse[0]), _composed(coarse[1], past.composed[1])
        else:
            past.composed = None
            return _expected_flows(past.frame, new.frame) if wanted else None
        return past.composed

    def add_loop(self, loop: Loop) -> None:
        """Take the features of a loop closure: points of either keyframe that the other one observes."""
        for host, other, pixels, log_depth, observed in (
            (loop.past, loop.new, loop.pixels_past, loop.log_depth_past, loop.pixels_new),
            (loop.new, loop.past, loop.pixels_new, loop.log_depth_new, loop.pixels_past),
        ):
            known = np.isfinite(log_depth)
            first = self._add_points(host, pixels[known], log_depth[known], np.zeros(known.sum()))
            self._add_matches(first + np.arange(known.sum()), other, observed[known])

    def median_depth_mm(self, keyframes: Collection[int], log_factor: np.ndarray | None = None) -> float | None:
        """Return the median of the estimated depths of the points of some keyframes, mm; None without any.

        log_factor : (n,) ln of the factor of each keyframe's depth; None: 1.
        """
        points, log_factors = self._points.read(), np.full(self.keyframe_count, np.nan)
        log_factors[list(keyframes)] = 0.0 if log_factor is None else log_factor
        log_depth = points["log_depth"] + log_factors[points["host"]]
        log_depth = log_depth[np.isfinite(log_depth)]
        return float(np.exp(np.median(log_depth))) if len(log_depth) else None

    def collected(
        self,
        keyframes: Collection[int] | None = None,
        most_observations: int | None = None,
        across: np.ndarray | None = None,
    ) -> tuple[Points, Observations]:
        """Return all points, sorted by host, and their observations, sorted by point.

        keyframes : increasing numbers of the keyframes that are used, None: all. The result numbers keyframes by their
        place in it. most_observations : above about so many only every n-th point is returned. across : (K,) int, part
        of each keyframe: only observations between parts are returned.
        """
        new_number = np.full(self.keyframe_count, -1)
        chosen = range(self.keyframe_count) if keyframes is None else keyframes
        new_number[list(chosen)] = np.arange(len(chosen))
        points = self._points.read()
        host = new_number[points["host"]]
        by_host = np.argsort(host, kind="stable")[np.count_nonzero(host < 0) :]
        if most_observations is not None:
            count = sum(len(_among(part, host, new_number)) for part in self._matches.parts())
            by_host = by_host[:: max(-(-count // most_observations), 1)]
        place = np.full(len(host), -1)
        place[by_host] = np.arange(len(by_host))
        found = [np.zeros(0, _MATCH)]
        for part in self._matches.parts():
            rows = _among(part, place, new_number)
            if across is not None:
                rows = rows[across[points["host"][rows["point"]]] != across[rows["keyframe"]]]
            found.append(rows)
        matches = np.concatenate(found)
        matches = matches[np.argsort(place[matches["point"]], kind="stable")]
        pixel, log_depth, sigma = (points[name][by_host] for name in ("pixel", "log_depth", "sigma"))
        point, keyframe = place[matches["point"]], new_number[matches["keyframe"]]
        return Points(host[by_host], pixel, log_depth, sigma), Observations(
            point, keyframe, self._centred(matches["pixel"])
        )

    def keep_last(self, count: int) -> None:
        """Forget the points of all keyframes but the last `count`, not fewer than are matched with the next one."""
        points, matches = self._points.read(), self._matches.read()
        gone = int(np.searchsorted(points["host"], self.keyframe_count - count))
        matches = matches[matches["point"] >= gone]
        matches["point"] -= gone
        self._points.keep(np.arange(len(points)) >= gone)
        self._matches.keep(np.zeros(len(self._matches), bool))
        self._matches.append(matches)
        for past in (past for recent in self._recent.values() for past in recent):
            past.first_point -= gone

    def _add_points(self, keyframe: int, pixels: np.ndarray, log_depth: np.ndarray, share: np.ndarray) -> int:
        """Add points at pixels (n, 2), with relative deviation of depth `share` (n,); return the first's number."""
        first, rows = len(self._points), np.zeros(len(pixels), _POINT)
        rows["host"], rows["pixel"], rows["log_depth"] = keyframe, self._centred(pixels), log_depth
        rows["sigma"] = np.hypot(share, _LEAST_DEPTH_SIGMA)
        self._points.append(rows)
        return first

    def _add_matches(self, points: np.ndarray, keyframe: int, pixels: np.ndarray) -> None:
        """Add the observations of points (n,) in a keyframe, at pixels (n, 2)."""
        rows = np.zeros(len(points), _MATCH)
        rows["point"], rows["keyframe"], rows["pixel"] = points, keyframe, pixels
        self._matches.append(rows)

    def _centred(self, pixel: np.ndarray) -> np.ndarray:
        """Return pixels (n, 2) relative to the principal point, y times fx / fy."""
        camera = self._camera
        if camera is None:
            return pixel
        centred: np.ndarray = (pixel - [camera.cx, camera.cy]) * [1.0, camera.fx / camera.fy]
        return centred


def _among(matches: np.ndarray, place: np.ndarray, new_number: np.ndarray) -> np.ndarray:
    """Return the observations of points with a place (P,), not -1, in keyframes with a new number (K,)."""
    chosen: np.ndarray = matches[(place[matches["point"]] >= 0) & (new_number[matches["keyframe"]] >= 0)]
    return chosen


def _pair(past: _FlowKeyframe, new: _FlowKeyframe, start: FlowPair) -> PairMatches:
    """Return what is matched both ways between two keyframes, searched from flows of any size."""
    size = new.frame.valid.shape[::-1]
    flows = flow_at(start[0], size), flow_at(start[1], size)
    return PairMatches(_matched(past, new, flows), _matched(new, past, flows[::-1]))


def _overlap(past: _FlowKeyframe, new: _FlowKeyframe, found: PairMatches) -> bool:
    """Return whether more is matched between two keyframes than by chance."""
    return found.corners >= _LEAST_MATCHED * (len(past.corners) + len(new.corners))


def _matched(host: _FlowKeyframe, other: _FlowKeyframe, flows: FlowPair) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the host's corners are found in another keyframe, and where; flows : there, back."""
    number, pixel = match_corners(host.corners, flows, other.frame.valid, _CONSISTENCY_PX)
    kept, pixel = refined_corners(host.pattern, other.pattern, host.corners[number], pixel, flows[0])
    return number[kept], pixel


def _composed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the flow (H, W, 2) from a to c by those from a to b and from b to c; borders are continued."""
    height, width = first.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    onwards = cv2.remap(second, u + first[..., 0], v + first[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    composed: np.ndarray = first + onwards
    return composed


def _expected_flows(past: Frame, new: Frame) -> FlowPair | None:
    """Return the flows that depth and poses as tracked give, and back; None with hardly anything in common."""
    T_world_past, T_world_new = past.T_world_camera, new.T_world_camera
    assert T_world_past is not None
    assert T_world_new is not None
    T_new_past = inverse(T_world_new) @ T_world_past
    flows = expected_flow(past, T_new_past), expected_flow(new, inverse(T_new_past))
    if min(_share_inside(flow) for flow in flows) < _LEAST_IN_COMMON:
        return None
    return flows


def _share_inside(flow: np.ndarray) -> float:
    """Return the share of pixels that a flow (h, w, 2) leaves in the picture."""
    height, width = flow.shape[:2]
    there = flow + np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    return float(((there >= 0) & (there <= [width - 1, height - 1])).all(-1).mean())


def _slim(keyframe: Frame) -> Frame:
    """Return what matching needs of a keyframe."""
    shown = (keyframe.index, keyframe.time_s, keyframe.rgb, keyframe.camera, keyframe.valid)
    return Frame(*shown, depth_mm=keyframe.depth_mm, T_world_camera=keyframe.T_world_camera)
