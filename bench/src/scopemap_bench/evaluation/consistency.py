"""Consistency of depth over time: a `ConsistencyMeter` per method, one `FrameMatcher` (ORB matches, flow) for all.

- ORB displacement, the depth-consistency experiment of arXiv 2508.11282: e = ||P_t X_t - P_{t+1} X_{t+1}|| over inlier
    matches of consecutive frames, lifted with depth. The form is ours.
- OPW and rTC: Khan et al., "Temporally consistent online depth estimation in dynamic scenes", WACV 2023, in the form of
    facebookresearch/TemporallyConsistentDepth, `eval/metrics.py`.
- TAE: Chen et al., "Video Depth Anything", arXiv 2501.12375, in the form of its `benchmark/eval/eval_tae.py`.

Steady depth may be wrong: constant depth is perfect in all measures without poses. Read them beside depth errors.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import SettingsError, check_shape
from scopemap.engine.geometry.se3 import inverse, se3, transform
from scopemap.engine.geometry.warp import moved_depth, pull
from scopemap.evaluation.poses import ErrorSummary
from scopemap_bench.evaluation.depth import depth_scale, scale_jitter

FEATURES = 1000
RATIO = 0.8
# OpenCV's default of 20 finds 7 corners in a smooth colon; 7 is ORB-SLAM's lower threshold, and the best 1000 stay.
_FAST_THRESHOLD = 7
# The five-point solver needs 5; with fewer than 8 no match is left to confirm a model.
_FEWEST_MATCHES = 8
_EPIPOLAR_PX = 1.0
_RANSAC_CONFIDENCE = 0.999
_RNG_SEED = 0
# exp(-50 |difference|) > 1e-2, with colours in 0..1.
_COLOUR_DISTANCE = 255 * np.log(1e2) / 50
_FLOW_LIMIT_PX = 250.0

OrbFeatures = tuple[np.ndarray, np.ndarray]
"""ORB features of one image: pixels (N, 2) float64, px, and descriptors (N, 32) uint8."""
_POSES = ("reference", "estimated")
_CHANGES = ("same_pixel", "along_flow", "opw", "opw_reference", "opw_estimated")
_CHANGE = ("mean_mm", "relative", "rtc")
_RTC_RATIO = 1.01


@dataclass(frozen=True)
class Matches:
    """The same M points in two frames: `previous_px` and `current_px`, (M, 2) float64, px."""

    previous_px: np.ndarray
    current_px: np.ndarray


@dataclass(frozen=True)
class FrameCorrespondences:
    """Correspondences of a frame and the one before it; the same for every method.

    to_previous : (H, W, 2) px, pixel p of this frame is seen at p + to_previous(p) in the previous one; None: no flow.
    consistent, same_colour : (H, W) bool, where that flow is trusted, and where moreover both images have the same
    colour.
    """

    matches: Matches
    to_previous: np.ndarray | None = None
    consistent: np.ndarray | None = None
    same_colour: np.ndarray | None = None


class FrameMatcher:
    """Matches each image with the one before it; keeps only that one."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._previous: tuple[np.ndarray, OrbFeatures] | None = None

    def match(
        self,
        rgb: np.ndarray,
        valid: np.ndarray,
        to_previous: np.ndarray | None = None,
        consistent: np.ndarray | None = None,
    ) -> FrameCorrespondences | None:
        """Return the correspondences with the image (H, W, 3) uint8 of the call before, None at the first."""
        size = (self._camera.height, self._camera.width)
        check_shape("rgb", rgb, (*size, 3))
        check_shape("valid", valid, size)
        previous, self._previous = self._previous, (rgb, orb_features(rgb, valid))
        if previous is None:
            return None
        matches = match_features(previous[1], self._previous[1], self._camera)
        if to_previous is None:
            return FrameCorrespondences(matches)
        trusted = np.ones(size, dtype=bool) if consistent is None else consistent
        same_colour = trusted & have_same_colour(previous[0], rgb, to_previous)
        return FrameCorrespondences(matches, to_previous, trusted, same_colour)


def orb_features(rgb: np.ndarray, valid: np.ndarray | None = None) -> OrbFeatures:
    """Return the 1000 strongest ORB features of an image (H, W, 3) uint8 on the `valid` pixels (H, W), None: on all."""
    mask = None if valid is None else valid.astype(np.uint8)
    detector = cv2.ORB.create(nfeatures=FEATURES, fastThreshold=_FAST_THRESHOLD)
    keypoints, descriptors = detector.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), mask)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    return np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64), descriptors


def match_features(previous: OrbFeatures, current: OrbFeatures, camera: PinholeCamera) -> Matches:
    """Return the matches between two frames that agree with one rigid motion; none from fewer than 8 features.

    Mutual nearest neighbours by Lowe's ratio test of 0.8 both ways, inliers (1 px) of the essential matrix by a fixed
    seed.
    """
    if min(len(previous[0]), len(current[0])) < _FEWEST_MATCHES:
        return Matches(np.empty((0, 2)), np.empty((0, 2)))
    to_current, distinct = _nearest(previous[1], current[1])
    to_previous, distinct_back = _nearest(current[1], previous[1])
    rows = np.arange(len(to_current))
    mutual = np.flatnonzero(distinct & distinct_back[to_current] & (to_previous[to_current] == rows))
    previous_px, current_px = previous[0][mutual], current[0][to_current[mutual]]
    inliers = None
    if len(mutual) >= _FEWEST_MATCHES:
        cv2.setRNGSeed(_RNG_SEED)
        _, inliers = cv2.findEssentialMat(
            previous_px, current_px, camera.matrix, cv2.RANSAC, _RANSAC_CONFIDENCE, _EPIPOLAR_PX
        )
    kept = np.zeros(len(mutual), dtype=bool) if inliers is None else inliers.ravel() > 0
    return Matches(previous_px[kept], current_px[kept])


def _nearest(descriptors: np.ndarray, among: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest of `among` for each descriptor (N,), and whether it passes the ratio test (N,)."""
    distances, rows = cv2.batchDistance(descriptors, among, dtype=cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    return rows[:, 0], distances[:, 0] < RATIO * distances[:, 1]


def have_same_colour(rgb_previous: np.ndarray, rgb_current: np.ndarray, to_previous: np.ndarray) -> np.ndarray:
    """Return where OPW counts a pixel, (H, W) bool: exp(-50 |I - I_warped|) > 0.01, and flow (H, W, 2) < 250 px.

    Khan et al., WACV 2023; their code limits the flow only where it is positive.
    """
    difference = rgb_current.astype(np.float32) - pull(rgb_previous, to_previous)
    same_colour = np.einsum("hwc,hwc->hw", difference, difference) < _COLOUR_DISTANCE**2
    return same_colour & (np.abs(to_previous) < _FLOW_LIMIT_PX).all(axis=-1)


def lifted_matches(
    matches: Matches,
    depth_previous_mm: np.ndarray,
    depth_current_mm: np.ndarray,
    camera: PinholeCamera,
    poses: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both ends of the matches in space, (M, 3) float64 mm each, and the mean depth (M,) of the two ends, mm.

    M counts the matches with depth (H, W), NaN = unknown, at the nearest pixel of both ends. `poses` are T_world_camera
    (4, 4) of the previous and of the current frame; without them points stay in their cameras.
    """
    z_previous = _nearest_depth(depth_previous_mm, matches.previous_px)
    z_current = _nearest_depth(depth_current_mm, matches.current_px)
    previous = z_previous[:, None] * camera.unproject(matches.previous_px)
    current = z_current[:, None] * camera.unproject(matches.current_px)
    if poses is not None:
        previous, current = transform(poses[0], previous), transform(poses[1], current)
    known = np.isfinite(previous).all(axis=1) & np.isfinite(current).all(axis=1)
    return previous[known], current[known], ((z_previous + z_current) / 2)[known]


def _nearest_depth(depth_mm: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return depth (M,) float64 of the pixels nearest to positions (M, 2), NaN outside the image."""
    height, width = depth_mm.shape
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return np.where(inside, depth_mm[v.clip(0, height - 1), u.clip(0, width - 1)], np.nan).astype(np.float64)


def displacement_figures(pairs: Sequence[np.ndarray]) -> dict[str, Any]:
    """Return the figures of a sequence's displacements in mm and over depth, (2, M) per pair, M = 0 where unmatched.

    pairs, matches : pairs of frames with a lifted match, and their matches.
    mean_mm, median_mm, std_mm, relative_mean, relative_median : over all matches; NaN where there are none.
    pair_mean_mm, pair_median_mm, pair_matches : of every pair in order.
    """
    mm, relative = (ErrorSummary.of(row) for row in np.concatenate([*pairs, np.empty((2, 0))], axis=1).astype(float))
    each_mm = [ErrorSummary.of(pair[0]) for pair in pairs]
    return {
        "pairs": sum(pair.shape[1] > 0 for pair in pairs),
        "matches": sum(pair.shape[1] for pair in pairs),
        "mean_mm": mm.mean,
        "median_mm": mm.median,
        "std_mm": mm.std,
        "relative_mean": relative.mean,
        "relative_median": relative.median,
        "pair_mean_mm": tuple(one.mean for one in each_mm),
        "pair_median_mm": tuple(one.median for one in each_mm),
        "pair_matches": tuple(pair.shape[1] for pair in pairs),
    }


def depth_change(other_mm: np.ndarray, current_mm: np.ndarray, counted: np.ndarray | None = None) -> dict[str, float]:
    """Compare two depth maps (H, W), mm, NaN = unknown, where both are positive and `counted` (H, W) bool is True.

    pairs : 1, or 0 where no pixel counts; then all else is NaN.
    mean_mm, median_mm : of |a - b|; relative : mean |a - b| / b, b of the current frame.
    rtc : share of pixels, 0..1, with max(a/b, b/a) strictly below 1.01; higher is better.
    """
    both = (other_mm > 0) & (current_mm > 0)
    if counted is not None:
        both &= counted
    if not both.any():
        return {"pairs": 0, **dict.fromkeys((*_CHANGE, "median_mm"), float("nan"))}
    a, b = other_mm[both].astype(np.float64), current_mm[both].astype(np.float64)
    apart, near = np.abs(a - b), np.maximum(a, b) < _RTC_RATIO * np.minimum(a, b)
    figures = [float(np.mean(values)) for values in (apart, apart / b, near)]
    return {"pairs": 1, **dict(zip(_CHANGE, figures, strict=True)), "median_mm": float(np.median(apart))}


def mean_change(changes: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return what `depth_change` measured, over the pairs of frames with a pixel; NaN where there is none.

    pairs : their number. mean_mm, relative, rtc : means over the pairs. largest_step_mm : the largest of their medians
    of |a - b|, since a mean over a sequence hides one frame at which depth steps.
    """
    kept = [change for change in changes if change["pairs"]]
    if not kept:
        return {"pairs": 0, **dict.fromkeys((*_CHANGE, "largest_step_mm"), float("nan"))}
    means = {name: float(np.mean([change[name] for change in kept])) for name in _CHANGE}
    return {"pairs": len(kept), **means, "largest_step_mm": max(change["median_mm"] for change in kept)}


def projected_depth(depth_mm: np.ndarray, camera: PinholeCamera, T_other_camera: np.ndarray) -> np.ndarray:
    """Return the depth map (H, W) float32, mm, that the other camera sees of this one's points; NaN where none falls.

    As in TAE's code the last point written to a pixel stays, also one behind the camera, which leaves it empty.
    """
    # Rows of (3, H W): contiguous coordinates are several times faster than points side by side.
    rays = np.ascontiguousarray(camera.rays.reshape(-1, 3).T)
    T = T_other_camera.astype(np.float32)
    x, y, z = (T[:3, :3] @ rays) * depth_mm.astype(np.float32).ravel() + T[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.rint(np.float32(camera.fx) * x / z + np.float32(camera.cx))
        v = np.rint(np.float32(camera.fy) * y / z + np.float32(camera.cy))
        inside = (depth_mm.ravel() > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    splat = np.zeros(depth_mm.shape, dtype=np.float32)
    splat[v[inside].astype(np.int32), u[inside].astype(np.int32)] = z[inside]
    return np.where(splat > 0, splat, np.float32(np.nan))


def alignment_errors(
    depth_previous_mm: np.ndarray, depth_current_mm: np.ndarray, camera: PinholeCamera, T_current_previous: np.ndarray
) -> tuple[float, float]:
    """Return TAE's two errors of a pair, forth and back: mean |projected - d| / d, d of the frame projected into.

    NaN where no pixel can be compared (the public code counts 0). TAE is 100 times the mean over directions and pairs.
    """
    forth = depth_change(projected_depth(depth_previous_mm, camera, T_current_previous), depth_current_mm)
    back = depth_change(projected_depth(depth_current_mm, camera, inverse(T_current_previous)), depth_previous_mm)
    return forth["relative"], back["relative"]


class ConsistencyMeter:
    """Measures a method's depth frame by frame; `scale` > 0 is a factor on depth and translations, to mm."""

    def __init__(self, camera: PinholeCamera, scale: float = 1.0) -> None:
        if not (np.isfinite(scale) and scale > 0):
            raise SettingsError(f"scale of depth is {scale}: give a positive number")
        self._camera, self._scale = camera, scale
        self._previous: tuple[np.ndarray, dict[str, np.ndarray]] | None = None
        self._scales: list[float] = []
        self._changes: defaultdict[str, list[dict[str, float]]] = defaultdict(list)
        self._alignments: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
        self._displacements: defaultdict[str, list[np.ndarray]] = defaultdict(list)

    def add(
        self,
        depth_mm: np.ndarray,
        valid: np.ndarray,
        found: FrameCorrespondences | None = None,
        *,
        T_world_camera: np.ndarray | None = None,
        T_reference_camera: np.ndarray | None = None,
        true_depth_mm: np.ndarray | None = None,
    ) -> None:
        """Measure the next frame against the one before; without `found`, no measure along flow or on matches.

        depth_mm : (H, W) float, the method's own unit, NaN = unknown. valid : (H, W) bool, where it counts.
        T_world_camera : the method's own pose (4, 4), in the unit of its depth. T_reference_camera : the reference's,
        mm. true_depth_mm : (H, W), for scale jitter only.
        """
        camera = self._camera
        check_shape("depth_mm", depth_mm, (camera.height, camera.width))
        counts = valid & np.isfinite(depth_mm) & (depth_mm > 0)
        depth_mm = np.where(counts, self._scale * depth_mm, np.nan).astype(np.float32)
        T = T_world_camera
        estimated = None if T is None else se3(T[:3, :3], self._scale * T[:3, 3])
        known = {"reference": T_reference_camera, "estimated": estimated}
        poses = {name: pose for name, pose in known.items() if pose is not None}
        self._scales.append(float("nan") if true_depth_mm is None else depth_scale(depth_mm, true_depth_mm))
        previous, self._previous = self._previous, (depth_mm, poses)
        if previous is None:
            return
        previous_mm, previous_poses = previous
        pairs = {name: (previous_poses[name], pose) for name, pose in poses.items() if name in previous_poses}
        motions = {name: inverse(current) @ before for name, (before, current) in pairs.items()}
        self._changes["same_pixel"].append(depth_change(previous_mm, depth_mm))
        for name, motion in motions.items():
            self._alignments[name].append(alignment_errors(previous_mm, depth_mm, camera, motion))
        for name in ("camera", *_POSES):
            # A pair without matches or poses keeps its place, so that pair k stays pair k in every figure.
            measured = np.empty((2, 0), np.float32)
            if found is not None and (name in pairs or name == "camera"):
                before, now, z_mm = lifted_matches(found.matches, previous_mm, depth_mm, camera, pairs.get(name))
                apart_mm = np.linalg.norm(before - now, axis=1)
                measured = np.stack([apart_mm, apart_mm / z_mm]).astype(np.float32)
            self._displacements[name].append(measured)
        if found is not None and found.to_previous is not None:
            before_mm = pull(previous_mm, found.to_previous)
            self._changes["along_flow"].append(depth_change(before_mm, depth_mm, found.consistent))
            self._changes["opw"].append(depth_change(before_mm, depth_mm, found.same_colour))
            for name, motion in motions.items():
                moved_mm = moved_depth(depth_mm, np.zeros_like(found.to_previous, np.float32), camera, inverse(motion))
                self._changes[f"opw_{name}"].append(depth_change(before_mm, moved_mm, found.same_colour))

    def report(self) -> dict[str, Any]:
        """Return the figures of all frames so far, by measure; NaN where nothing could be measured. Lower is better.

        scale, jitter : factor to mm, and its variation. same_pixel, along_flow : |D_t - D_{t-1}| at the same pixel,
        along the flow.
        opw : along the flow where the images have the same colour; its `rtc` is rTC. opw_reference, opw_estimated : the
        same after moving the current depth into the previous camera by these poses; the largest depth step between
        frames is their `largest_step_mm`. tae_reference, tae_estimated : TAE, percent of depth; the public protocol is
        `reference`. orb_camera, orb_reference, orb_estimated : displacement of points in their own cameras, and in the
        world.
        """
        figures: dict[str, Any] = {"frames": len(self._scales), "pairs": max(len(self._scales) - 1, 0)}
        figures |= {"scale": self._scale, "jitter": scale_jitter(np.array(self._scales))}
        figures |= {name: mean_change(self._changes[name]) for name in _CHANGES}
        for name in _POSES:
            table = np.array(self._alignments[name], dtype=np.float64).reshape(-1, 2)
            known = np.isfinite(table)
            percent = 100 * float(table[known].mean()) if known.any() else float("nan")
            figures[f"tae_{name}"] = {"pairs": int(known.any(axis=1).sum()), "percent": percent}
        return figures | {
            f"orb_{name}": displacement_figures(self._displacements[name]) for name in ("camera", *_POSES)
        }
