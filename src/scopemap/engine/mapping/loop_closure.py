"""Loop closure: keyframes that observe the same place as one long before or of another map.

They are found by features and PnP. Folds that repeat, and what stays in place in the picture, give enough features that
fit a wrong pose by chance; the picture between them does not (`is_verified`). Its fine detail is compared, relative to
its surround, because the lamp moves with the camera.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import MappingSettings
from scopemap.engine.flow.corners import usable_pixels
from scopemap.engine.frame import Frame, RowTable, rows_in_memory
from scopemap.engine.geometry.local_contrast import local_contrast, local_mean
from scopemap.engine.geometry.se3 import transform
from scopemap.engine.tracking.features import (
    FeatureDetector,
    Features,
    SiftFeatures,
    relative_pose_pnp,
    similarities,
)

_STRONGEST_VALUES = 8192  # by hand: of the descriptors of the strongest features, by which candidates are ranked
_CANDIDATES = 3  # by hand: that are verified, the most similar ones
_STATIC_PX = 2.0  # by hand: features that move less between two maps may be dirt on the lens
# With a camera at rest every keyframe would close loops to the same few ones; the adjustment's cost is their square.
_MIN_INTERVAL = 5  # by hand: keyframes between two loops to the same keyframe, loops to one keyframe
_MAX_LOOPS = 20  # by hand
MOST_RECENT = 8  # by hand
"""Keyframes just before a new one: flow leads to them, and loops are sought to those before them."""
_MAX_PAIRS = 60  # by hand: features of a loop
MOST_SEARCHED = 400  # by hand
"""Keyframes with features; above, every second one is forgotten, so that memory and time of a search are bounded."""
_TRIED_BETWEEN = 20  # by hand: pairs of keyframes that are verified at the end: of two maps, of all maps
_MOST_TRIED = 1000  # by hand, for time
LOOP = np.dtype([("past", np.int64), ("new", np.int64), ("T_new_past", np.float64, (4, 4)), ("log_ratio", np.float64)])
"""A loop without its features."""
_WIDTH = 160  # by hand: px of the small picture, and between the pixels that are compared
_HEIGHT = 128  # by hand
_STEP = 2  # by hand
_FINE_PX = 0.75  # by hand: standard deviations of the Gaussians between which the detail lies
_COARSE_PX = 2.5  # by hand
_DARKEST = 8.0  # by hand: grey levels added before the logarithm
_LEAST_CONTRAST = 0.01  # by hand: ln, below which detail is noise
_MIN_PIXELS = 100  # by hand: fewer pixels in common verify nothing
# In an examination of which the truth is known: 97 of 100 right loops are above, and 8 of 100 wrong ones.
_MIN_CORRELATION = 0.12
VIEW = np.dtype(
    [
        ("detail", np.float16, (_HEIGHT, _WIDTH)),
        ("depth_mm", np.float32, (_HEIGHT // _STEP, _WIDTH // _STEP)),
    ]
)
"""What a keyframe shows, small: its detail, of local standard deviation 1, and depth at every second pixel.

NaN: not usable, or the depth is unknown.
"""
_NO_FEATURES = (np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))  # of a loop without features


@dataclass(frozen=True)
class Loop:
    """A loop closure: two keyframes that observe the same place, long after each other or in two maps.

    past, new : numbers of the keyframes. T_new_past : (4, 4), mm of the past keyframe's depth. log_ratio : ln of the
    new keyframe's depth over the past one's, transformed into the new camera. pixels_past, pixels_new : (M, 2) of the
    matched features. log_depth_past, log_depth_new : (M,) ln of their depth, NaN = unknown.
    """

    past: int
    new: int
    T_new_past: np.ndarray
    log_ratio: float
    pixels_past: np.ndarray
    pixels_new: np.ndarray
    log_depth_past: np.ndarray
    log_depth_new: np.ndarray

    def among(self, keyframes: list[int], log_unit: np.ndarray) -> Loop:
        """Return the loop with keyframes numbered by their place in a list; log_unit : (K,) ln factor of their mm."""
        past, new = keyframes.index(self.past), keyframes.index(self.new)
        T_new_past = self.T_new_past.copy()
        T_new_past[:3, 3] *= np.exp(log_unit[past])
        log_ratio = self.log_ratio + float(log_unit[new] - log_unit[past])
        return replace(self, past=past, new=new, T_new_past=T_new_past, log_ratio=log_ratio)

    def row(self) -> np.ndarray:
        """Return the loop without its features as one row of the kind `LOOP`."""
        return np.array([(self.past, self.new, self.T_new_past, self.log_ratio)], LOOP)

    @classmethod
    def of_row(cls, row: np.void) -> Loop:
        """Return the loop of a row, without features."""
        return cls(int(row["past"]), int(row["new"]), row["T_new_past"], float(row["log_ratio"]), *_NO_FEATURES)


class _KeptFeatures(NamedTuple):
    """Features of a keyframe: the strongest descriptors (n, D) float16; first row and number of all of them."""

    strongest: np.ndarray
    first: int
    rows: int


class LoopFinder:
    """Takes keyframes one by one and returns the loops that each closes, to long before and to other maps.

    Candidates are the keyframes with the most similar features. A loop is accepted if PnP places the new keyframe with
    at least `settings.min_loop_inliers` inliers and both look alike there (`is_verified`). table : where is
    kept what only this needs. detector : of features; None: SIFT. recent : keyframes just before the new one, to which
    no loop is sought.
    """

    _camera: PinholeCamera | None = None

    def __init__(
        self,
        settings: MappingSettings,
        table: RowTable = rows_in_memory,
        detector: FeatureDetector | None = None,
        recent: int = MOST_RECENT,
    ) -> None:
        self._detector = detector or SiftFeatures()
        self._strongest = _STRONGEST_VALUES // self._detector.descriptor_size
        self._min_inliers, self._recent = settings.min_loop_inliers, recent
        self._rows, self._views = table("features", self._kind), table("views", VIEW)
        self._features, self._map_of = dict[int, _KeptFeatures](), dict[int, int]()
        self._loops_to = defaultdict[int, list[int]](list)
        self._count, self._every = 0, 1

    @property
    def _kind(self) -> np.dtype:
        # Half precision distinguishes descriptors as well, in half of the space.
        size = (self._detector.descriptor_size,)
        return np.dtype([("pixel", np.float64, (2,)), ("descriptor", np.float16, size), ("point_mm", np.float64, (3,))])

    def add(self, keyframe: Frame, map_number: int = 0) -> list[Loop]:
        """Return the loops that a keyframe with depth closes."""
        new, loops = self._detector.detect(keyframe), []
        self._camera = keyframe.camera
        self._views.append(small_view(keyframe))
        for past in self._candidates(new, map_number):
            loop = self._loop((past, self._count), self._of(past), new, self._map_of[past] != map_number)
            if loop is not None:
                self._loops_to[past].append(loop.new)
                loops.append(loop)
        self._features[self._count] = self._kept(new)
        self._map_of[self._count] = map_number
        self._count += 1
        if len(self._features) > MOST_SEARCHED:
            self._every *= 2
            self._features = {k: own for k, own in self._features.items() if k % self._every == 0}
        return loops

    def _kept(self, features: Features) -> _KeptFeatures:
        rows = np.zeros(len(features.pixels), self._kind)
        rows["pixel"], rows["descriptor"], rows["point_mm"] = features.pixels, features.descriptors, features.points_mm
        self._rows.append(rows)
        return _KeptFeatures(rows["descriptor"][: self._strongest].copy(), len(self._rows) - len(rows), len(rows))

    def _of(self, keyframe: int) -> Features:
        rows = self._rows.read(*self._features[keyframe][1:])
        pixels, descriptors, points = (np.ascontiguousarray(rows[n]) for n in ("pixel", "descriptor", "point_mm"))
        return Features(pixels, descriptors, points, self._detector.max_ratio)

    def between(self, map_of: Sequence[int]) -> list[Loop]:
        """Return further loops between maps, after the last keyframe, of the most similar keyframes of two maps."""
        ranked = defaultdict[tuple[int, int], list[tuple[float, int, int]]](list)
        for new in self._features:
            others = [k for k in self._features if k < new and map_of[k] != map_of[new]]
            others = [k for k in others if new not in self._loops_to[k]]
            alike = self._similarities(self._features[new].strongest.astype(np.float32), others)
            for past, how in zip(others, alike.tolist(), strict=True):
                maps = min(map_of[past], map_of[new]), max(map_of[past], map_of[new])
                ranked[maps].append((how, past, new))
        likely = [pair for pairs in ranked.values() for pair in sorted(pairs, reverse=True)[:_TRIED_BETWEEN]]
        loops = []
        for _, past, new in sorted(likely, reverse=True)[:_MOST_TRIED]:
            loop = self._loop((past, new), self._of(past), self._of(new), other_map=True)
            if loop is not None:
                self._loops_to[past].append(new)
                loops.append(loop)
        return loops

    def _loop(self, pair: tuple[int, int], old: Features, new: Features, other_map: bool) -> Loop | None:
        """Return the loop between a past keyframe and a new one, by number; None where it is not verified."""
        assert self._camera is not None
        found = relative_pose_pnp(old, new, self._camera, self._min_inliers)
        if found is None:
            return None
        shift_px = np.linalg.norm(new.pixels[found.pairs[:, 1]] - old.pixels[found.pairs[:, 0]], axis=1)
        # Dirt on the lens stays in place, and matches in unrelated places.
        if other_map and int((shift_px > _STATIC_PX).sum()) < self._min_inliers:
            return None
        one, other = found.pairs[:: -(-len(found.pairs) // _MAX_PAIRS)].T
        T_new_past = found.T_current_reference
        transformed_z = old.points_mm[one] @ T_new_past[2, :3] + T_new_past[2, 3]
        with np.errstate(invalid="ignore", divide="ignore"):
            log_z_past, log_z_new = np.log(old.points_mm[one, 2]), np.log(new.points_mm[other, 2])
            ratio = log_z_new - np.log(transformed_z)
        if np.isfinite(ratio).sum() < min(self._min_inliers, _MAX_PAIRS) // 2:
            return None
        old_view, new_view = (self._views.read(number, 1)[0] for number in pair)
        if not is_verified(old_view, new_view, T_new_past, self._camera):
            return None
        log_ratio, pixels = float(np.nanmedian(ratio)), (old.pixels[one], new.pixels[other])
        return Loop(*pair, T_new_past, log_ratio, *pixels, log_z_past, log_z_new)

    def _candidates(self, new: Features, map_number: int) -> list[int]:
        """Numbers of the most similar keyframes, of this map (but for the last ones) and of others."""
        kept, strongest = list(self._features), new.descriptors[: self._strongest]
        recent = [k for k, number in self._map_of.items() if number == map_number][-self._recent :]
        own = [k for k in kept if self._map_of[k] == map_number and k not in recent]
        elsewhere = [k for k in kept if self._map_of[k] != map_number]
        candidates: list[int] = []
        for some in (own, elsewhere):
            alike = self._similarities(strongest, some)
            ranked = [some[k] for k in np.argsort(-alike, kind="stable") if alike[k] > 0]
            candidates += [k for k in ranked if self._allows_loop(k)][:_CANDIDATES]
        return candidates

    def _similarities(self, strongest: np.ndarray, keyframes: list[int]) -> np.ndarray:
        return similarities(strongest, [self._features[k].strongest for k in keyframes])

    def _allows_loop(self, past: int) -> bool:
        loops = self._loops_to[past]
        return len(loops) < _MAX_LOOPS and (not loops or self._count - loops[-1] >= _MIN_INTERVAL)


def small_view(keyframe: Frame) -> np.ndarray:
    """Return what a keyframe with depth shows, (1,) of the kind `VIEW`."""
    assert keyframe.depth_mm is not None
    size, view = (_WIDTH, _HEIGHT), np.zeros(1, VIEW)
    usable = usable_pixels(keyframe.valid).astype(np.float32)
    grey = cv2.cvtColor(keyframe.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    weight = cv2.resize(usable, size, interpolation=cv2.INTER_AREA)
    relative = np.log(cv2.resize(grey, size, interpolation=cv2.INTER_AREA) + _DARKEST)
    detail = local_mean(relative, _FINE_PX, weight) - local_mean(relative, _COARSE_PX, weight)
    contrast = local_contrast(detail, _COARSE_PX, weight, least=_LEAST_CONTRAST)
    view["detail"] = np.where(weight == 1, contrast, np.nan)
    view["depth_mm"] = cv2.resize(keyframe.depth_mm, size, interpolation=cv2.INTER_NEAREST)[::_STEP, ::_STEP]
    return view


def is_verified(past: np.ndarray, new: np.ndarray, T_new_past: np.ndarray, camera: PinholeCamera) -> bool:
    """Return whether two keyframes look alike by a relative pose; too small an overlap verifies nothing.

    past, new : views, () of the kind `VIEW`. T_new_past : (4, 4), mm of the past one's depth. camera : of both, at any
    size.
    """
    small = camera.resized(_WIDTH, _HEIGHT)
    seen = small.project(transform(T_new_past, past["depth_mm"][..., None] * small.rays[::_STEP, ::_STEP]))
    column, row = np.moveaxis(np.nan_to_num(seen, nan=-1.0), -1, 0).astype(np.float32)
    detail, beyond = new["detail"].astype(np.float32), cv2.BORDER_CONSTANT
    there = cv2.remap(detail, column, row, cv2.INTER_LINEAR, borderMode=beyond, borderValue=np.nan)
    here = past["detail"][::_STEP, ::_STEP].astype(np.float32)
    both = np.isfinite(here) & np.isfinite(there)
    if both.sum() < _MIN_PIXELS:
        return False
    return bool(np.corrcoef(here[both], there[both])[0, 1] >= _MIN_CORRELATION)
