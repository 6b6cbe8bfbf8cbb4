"""Temporal consistency of depth, frame by frame: a `ConsistencyMeter` per method, one `FrameMatcher` for all.

- OPW and rTC: Khan et al., "Temporally consistent online depth estimation in dynamic scenes", WACV 2023, in the form of
    facebookresearch/TemporallyConsistentDepth, `eval/metrics.py`.
- TAE: Chen et al., "Video Depth Anything", arXiv 2501.12375, in the form of its `benchmark/eval/eval_tae.py`.

Steady depth may be wrong: constant depth is perfect in all measures without poses. Read them beside depth errors.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import SettingsError, check_shape
from scopemap.geometry.se3 import inverse, se3
from scopemap.geometry.warp import moved_depth, pull
from scopemap_bench.evaluation.correspondences import FrameCorrespondences, displacement_figures, lifted_matches
from scopemap_bench.evaluation.depth import depth_scale, scale_jitter

_POSES = ("reference", "estimated")
_CHANGES = ("same_pixel", "along_flow", "opw", "opw_reference", "opw_estimated")
_CHANGE = ("mean_mm", "relative", "rtc")
_RTC_RATIO = 1.01


def depth_change(other_mm: np.ndarray, current_mm: np.ndarray, counted: np.ndarray | None = None) -> dict[str, float]:
    """Compare two depth maps (H, W), mm, NaN = unknown, where both are positive and `counted` (H, W) bool is True.

    pairs : 1, or 0 where no pixel counts; then all else is NaN.
    mean_mm : mean |a - b|; relative : mean |a - b| / b, b of the current frame.
    rtc : share of pixels, 0..1, with max(a/b, b/a) strictly below 1.01; higher is better.
    """
    both = (other_mm > 0) & (current_mm > 0)
    if counted is not None:
        both &= counted
    if not both.any():
        return {"pairs": 0, **dict.fromkeys(_CHANGE, float("nan"))}
    a, b = other_mm[both].astype(np.float64), current_mm[both].astype(np.float64)
    apart, near = np.abs(a - b), np.maximum(a, b) < _RTC_RATIO * np.minimum(a, b)
    figures = [float(np.mean(values)) for values in (apart, apart / b, near)]
    return {"pairs": 1, **dict(zip(_CHANGE, figures, strict=True))}


def mean_change(changes: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each figure of `depth_change` over the pairs of frames with a pixel, and their number."""
    kept = np.array([[change[name] for name in _CHANGE] for change in changes if change["pairs"]])
    means = kept.mean(axis=0).tolist() if len(kept) else [float("nan")] * len(_CHANGE)
    return {"pairs": len(kept), **dict(zip(_CHANGE, means, strict=True))}


def projected_depth(depth_mm: np.ndarray, camera: PinholeCamera, T_other_camera: np.ndarray) -> np.ndarray:
    """Return the depth map (H, W) float32, mm, that the other camera sees of this one's points; NaN where none falls.

    As in TAE's code: the last point written to a pixel stays, and a pixel that a point behind the camera took is empty.
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

    NaN where no pixel can be compared (the public code counts 0 there). TAE is 100 times the mean over both directions
    and all pairs. The public protocol first fits scale and shift to the truth.
    """
    forth = depth_change(projected_depth(depth_previous_mm, camera, T_current_previous), depth_current_mm)
    back = depth_change(projected_depth(depth_current_mm, camera, inverse(T_current_previous)), depth_previous_mm)
    return forth["relative"], back["relative"]


class ConsistencyMeter:
    """Measures one method's depth frame by frame; keeps the previous frame and a few numbers per match.

    `scale` is a factor on depth and on the translation of estimated poses, so that figures in mm of methods with
    different units compare. Raises `SettingsError` unless it is positive.
    """

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

        depth_mm : (H, W) float, mm or the method's own unit, NaN = unknown. valid : (H, W) bool, where it counts.
        T_world_camera : (4, 4) the method's own pose, in the unit of its depth.
        T_reference_camera : (4, 4) the reference's, mm. true_depth_mm : (H, W), NaN = unknown; for scale jitter only.
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

        frames, pairs : frames added, and pairs of consecutive ones; scale, jitter : factor to mm, and its variation.
        same_pixel, along_flow : |D_t - D_{t-1}| at the same pixel, and along the flow.
        opw : along the flow where the images have the same colour; its `rtc` is rTC.
        opw_reference, opw_estimated : the same after moving the current depth into the previous camera by these poses.
        tae_reference, tae_estimated : TAE by these poses, percent of depth. The public protocol is `reference`.
        orb_camera, orb_reference, orb_estimated : displacement of points in their own cameras, and in the world.
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
