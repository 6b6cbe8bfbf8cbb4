"""Temporal consistency of depth, frame by frame, with the same flow and matches for every method.

    matcher, meters = FrameMatcher(camera), {name: ConsistencyMeter(camera) for name in methods}
    for each frame:
        found = matcher.match(rgb, valid, to_previous, consistent)
        for name, meter in meters.items():
            meter.add(DepthFrame(depth_mm[name], valid, T_world_camera=..., T_reference_camera=...), found)
    reports = {name: meter.report() for name, meter in meters.items()}

The measures are in `depth_change` (TAE, OPW, rTC, differences), `displacement` (the paper's ORB displacement) and
`depth_sequence` (scale jitter). Each measure that needs poses is reported for reference and for estimated poses. Steady
depth may be wrong: constant depth is perfect in all measures without poses. Read them beside depth errors.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import SettingsError, check_shape
from scopemap.evaluation.correspondences import FrameCorrespondences
from scopemap.evaluation.depth_change import DepthChange, alignment_errors, depth_change, mean_change, seen_from
from scopemap.evaluation.depth_sequence import ScaleJitter, depth_scale, scale_jitter
from scopemap.evaluation.displacement import DisplacementSummary, displacements
from scopemap.geometry.se3 import inverse, se3
from scopemap.geometry.warp import pull

_POSES = ("reference", "estimated")
_CHANGES = ("same_pixel", "along_flow", "opw", "opw_reference", "opw_estimated")


@dataclass(frozen=True)
class DepthFrame:
    """One method's depth of one frame, and the poses that are known.

    Attributes
    ----------
    depth_mm : (H, W) float, mm or the method's own unit (see `ConsistencyMeter`), NaN = unknown.
    valid : (H, W) bool, True where the pixel shows usable tissue; depth elsewhere does not count.
    T_world_camera : (4, 4) the method's own pose, in the unit of its depth; None where lost or not estimated.
    T_reference_camera : (4, 4) the reference's pose, mm; None where unknown.
    true_depth_mm : (H, W), NaN = unknown; for scale jitter only. None where unknown.
    """

    depth_mm: np.ndarray
    valid: np.ndarray
    T_world_camera: np.ndarray | None = None
    T_reference_camera: np.ndarray | None = None
    true_depth_mm: np.ndarray | None = None


@dataclass(frozen=True)
class TemporalAlignmentError:
    """TAE in percent of depth, the mean over both directions of all pairs, and the number of measurable pairs."""

    pairs: int
    percent: float

    @classmethod
    def of(cls, errors: list[tuple[float, float]]) -> TemporalAlignmentError:
        """Summarise the two errors of each pair of frames (`alignment_errors`)."""
        table = np.array(errors, dtype=np.float64).reshape(-1, 2)
        known = np.isfinite(table)
        percent = 100 * float(table[known].mean()) if known.any() else float("nan")
        return cls(int(known.any(axis=1).sum()), percent)


@dataclass(frozen=True)
class ConsistencyReport:
    """Consistency of one method's depth over one sequence; NaN where nothing could be measured. Lower is better.

    Attributes
    ----------
    frames, pairs : frames added, and pairs of consecutive ones.
    scale : factor applied to depth and to estimated translations before anything in mm.
    jitter : of the factor to the true depth.
    same_pixel : |D_t - D_{t-1}| at the same pixel; includes the camera's motion.
    along_flow : the same along the flow, wherever the flow is trusted.
    opw : along the flow where the images moreover have the same colour; its `rtc` is rTC. Includes true changes.
    opw_reference, opw_estimated : the same after moving the current depth into the previous camera by these poses.
    tae_reference, tae_estimated : TAE by these poses. The public protocol is `reference`.
    orb_camera : ORB displacement between points in their own cameras; includes the camera's motion.
    orb_reference, orb_estimated : ORB displacement in the world, by these poses.
    """

    frames: int
    pairs: int
    scale: float
    jitter: ScaleJitter
    same_pixel: DepthChange
    along_flow: DepthChange
    opw: DepthChange
    opw_reference: DepthChange
    opw_estimated: DepthChange
    tae_reference: TemporalAlignmentError
    tae_estimated: TemporalAlignmentError
    orb_camera: DisplacementSummary
    orb_reference: DisplacementSummary
    orb_estimated: DisplacementSummary


@dataclass(frozen=True)
class _Measured:
    """A frame ready for measuring: depth (H, W) float32, mm, NaN where it does not count; poses by name, mm."""

    depth_mm: np.ndarray
    poses: dict[str, np.ndarray]


class ConsistencyMeter:
    """Measures one method's depth frame by frame; keeps the previous frame and a few numbers per match.

    Parameters
    ----------
    camera : of all frames.
    scale : factor on depth and on the translation of estimated poses (both share the method's unit), so that figures
        in mm of methods with different scales compare; such as the `scale` of `fit_sequence`. Where a shift belongs to
        it, pass depth that `DepthFit.apply` has been applied to. Raises `SettingsError` unless it is positive.
    """

    def __init__(self, camera: PinholeCamera, scale: float = 1.0) -> None:
        if not (np.isfinite(scale) and scale > 0):
            raise SettingsError(f"scale of depth is {scale}: give a positive number")
        self._camera, self._scale = camera, scale
        self._previous: _Measured | None = None
        self._scales: list[float] = []
        self._changes: defaultdict[str, list[DepthChange]] = defaultdict(list)
        self._alignments: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
        self._displacements: defaultdict[str, list[np.ndarray]] = defaultdict(list)

    def add(self, frame: DepthFrame, found: FrameCorrespondences | None = None) -> None:
        """Measure the next frame against the one added before it.

        `found` are the correspondences of these two frames, None at the first. Where it is None later on, the pair has
        no measure along flow and no ORB displacement; the rest is measured.
        """
        current, truth = self._scaled(frame), frame.true_depth_mm
        self._scales.append(float("nan") if truth is None else depth_scale(current.depth_mm, truth))
        previous, self._previous = self._previous, current
        if previous is None:
            return
        common = [name for name in _POSES if name in previous.poses and name in current.poses]
        motions = {name: inverse(current.poses[name]) @ previous.poses[name] for name in common}
        self._changes["same_pixel"].append(depth_change(previous.depth_mm, current.depth_mm))
        for name, motion in motions.items():
            errors = alignment_errors(previous.depth_mm, current.depth_mm, self._camera, motion)
            self._alignments[name].append(errors)
        self._measure_matches(previous, current, found)
        if found is not None and found.to_previous is not None:
            before_mm = pull(previous.depth_mm, found.to_previous)
            self._changes["along_flow"].append(depth_change(before_mm, current.depth_mm, found.consistent))
            self._changes["opw"].append(depth_change(before_mm, current.depth_mm, found.same_colour))
            for name, motion in motions.items():
                moved_mm = seen_from(current.depth_mm, self._camera, inverse(motion))
                self._changes[f"opw_{name}"].append(depth_change(before_mm, moved_mm, found.same_colour))

    def report(self) -> ConsistencyReport:
        """Return the figures of all frames added so far."""
        changes = {name: mean_change(self._changes[name]) for name in _CHANGES}
        return ConsistencyReport(
            frames=len(self._scales),
            pairs=max(len(self._scales) - 1, 0),
            scale=self._scale,
            jitter=scale_jitter(np.array(self._scales)),
            **changes,
            tae_reference=TemporalAlignmentError.of(self._alignments["reference"]),
            tae_estimated=TemporalAlignmentError.of(self._alignments["estimated"]),
            orb_camera=DisplacementSummary.of(self._displacements["camera"]),
            orb_reference=DisplacementSummary.of(self._displacements["reference"]),
            orb_estimated=DisplacementSummary.of(self._displacements["estimated"]),
        )

    def _scaled(self, frame: DepthFrame) -> _Measured:
        size = (self._camera.height, self._camera.width)
        check_shape("DepthFrame.depth_mm", frame.depth_mm, size)
        check_shape("DepthFrame.valid", frame.valid, size)
        counts = frame.valid & np.isfinite(frame.depth_mm) & (frame.depth_mm > 0)
        depth_mm = np.where(counts, self._scale * frame.depth_mm, np.nan).astype(np.float32)
        poses: dict[str, np.ndarray] = {}
        if frame.T_reference_camera is not None:
            poses["reference"] = frame.T_reference_camera
        if frame.T_world_camera is not None:
            T = frame.T_world_camera
            poses["estimated"] = se3(T[:3, :3], self._scale * T[:3, 3])
        for T in poses.values():
            check_shape("DepthFrame pose", T, (4, 4))
        return _Measured(depth_mm, poses)

    def _measure_matches(self, previous: _Measured, current: _Measured, found: FrameCorrespondences | None) -> None:
        for name in ("camera", *_POSES):
            # A pair without matches or poses keeps its place, so that pair k stays pair k in every figure.
            measured = np.empty((2, 0), np.float32)
            has_poses = name in previous.poses and name in current.poses
            if found is not None and (has_poses or name == "camera"):
                poses = (previous.poses[name], current.poses[name]) if has_poses else None
                ends = displacements(found.matches, previous.depth_mm, current.depth_mm, self._camera, poses)
                measured = np.stack([ends.displacement_mm, ends.relative]).astype(np.float32)
            self._displacements[name].append(measured)
