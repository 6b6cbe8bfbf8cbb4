"""Depth's consistency in time, frame by frame: one frame in memory, the same flow and matches for every method.

What the images alone tell of a pair of frames is an `ImageLink`; make it once and hand it to the meter of every method:

    linker, meters = ImageLinker(camera), {name: ConsistencyMeter(camera) for name in methods}
    for each frame:
        link = linker.link(rgb, valid, to_previous, consistent)
        for name, meter in meters.items():
            meter.add(DepthFrame(depth_mm[name], valid, T_world_camera=..., T_reference_camera=...), link)
    reports = {name: meter.report() for name, meter in meters.items()}

The measures are in `depth_change.py` (TAE, OPW, rTC, differences), `orb.py` (the paper's displacement) and
`depth_sequence.py` (scale jitter). Each that needs poses is given with reference and with estimated poses, apart. Depth
that is steady need not be right: constant depth is perfect in all that has no poses. Read them beside depth errors.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scopemap.cameras.camera import PinholeCamera
from scopemap.errors import SettingsError, check_shape
from scopemap.evaluation.depth_change import DepthChange, alignment_errors, depth_change, mean_change, seen_from
from scopemap.evaluation.depth_sequence import ScaleJitter, depth_scale, scale_jitter
from scopemap.evaluation.image_link import ImageLink
from scopemap.evaluation.orb import DisplacementSummary, displacements
from scopemap.geometry.se3 import inverse, se3
from scopemap.geometry.warp import pull

Poses = Literal["reference", "estimated"]
_POSES: tuple[Poses, ...] = ("reference", "estimated")
_CHANGES = ("same_pixel", "along_flow", "opw", "opw_reference", "opw_estimated")


@dataclass(frozen=True)
class DepthFrame:
    """One method's depth of one frame, and what is known of the camera.

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
class AlignmentError:
    """TAE in percent of depth, the mean over both directions of all pairs, and how many pairs could be measured."""

    pairs: int
    percent: float


@dataclass(frozen=True)
class ConsistencyReport:
    """Consistency of one method's depth over one sequence; NaN where nothing could be measured. Lower is better.

    Attributes
    ----------
    frames, pairs : frames added, and pairs of consecutive ones.
    scale : factor applied to depth and to estimated translations before anything in mm.
    jitter : of the factor to the true depth.
    same_pixel : |D_t - D_{t-1}| at the same pixel; holds the camera's motion, too.
    along_flow : the same along the flow, wherever the flow is trusted.
    opw : along the flow where the images moreover have the same colour; its `rtc` is rTC. Holds true change of depth.
    opw_reference, opw_estimated : the same after moving the current depth into the previous camera by these poses.
    tae_reference, tae_estimated : TAE by these poses. The public protocol is `reference`.
    orb_camera : ORB displacement between points in their own cameras; holds the camera's motion, too.
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
    tae_reference: AlignmentError
    tae_estimated: AlignmentError
    orb_camera: DisplacementSummary
    orb_reference: DisplacementSummary
    orb_estimated: DisplacementSummary


@dataclass(frozen=True)
class _Scaled:
    """A frame ready for measuring: depth (H, W) float32 in mm with NaN wherever it does not count, poses in mm."""

    depth_mm: np.ndarray
    poses: dict[Poses, np.ndarray]


class ConsistencyMeter:
    """Measures one method's depth as its frames come; keeps the previous frame and a few numbers per match.

    Parameters
    ----------
    camera : of all frames.
    scale : factor on depth and on the translation of estimated poses (both share the method's unit), so that figures
        in mm of methods with different scales compare; such as the `scale` of `fit_sequence`. Where a shift belongs to
        it, hand in depth that `DepthFit.apply` has been through. Raises `SettingsError` unless it is positive.
    """

    def __init__(self, camera: PinholeCamera, scale: float = 1.0) -> None:
        if not (np.isfinite(scale) and scale > 0):
            raise SettingsError(f"scale of depth is {scale}: give a positive number")
        self._camera, self._scale = camera, scale
        self._previous: _Scaled | None = None
        self._scales: list[float] = []
        self._changes: defaultdict[str, list[DepthChange]] = defaultdict(list)
        self._alignments: defaultdict[Poses, list[tuple[float, float]]] = defaultdict(list)
        self._displacements: defaultdict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)

    def add(self, frame: DepthFrame, link: ImageLink | None = None) -> None:
        """Measure the next frame against the one added before it.

        `link` is between just these two frames, None at the first. Where it is None later on, flow and ORB have nothing
        to say of this pair; the rest is measured.
        """
        current = self._scaled(frame)
        truth = frame.true_depth_mm
        self._scales.append(float("nan") if truth is None else depth_scale(current.depth_mm, truth))
        if self._previous is not None:
            self._measure(self._previous, current, link)
        self._previous = current

    def report(self) -> ConsistencyReport:
        """Return the figures of all frames added so far."""
        changes = {name: mean_change(self._changes[name]) for name in _CHANGES}
        return ConsistencyReport(
            frames=len(self._scales),
            pairs=max(len(self._scales) - 1, 0),
            scale=self._scale,
            jitter=scale_jitter(np.array(self._scales)),
            **changes,
            tae_reference=self._alignment("reference"),
            tae_estimated=self._alignment("estimated"),
            orb_camera=self._displacement("camera"),
            orb_reference=self._displacement("reference"),
            orb_estimated=self._displacement("estimated"),
        )

    def _scaled(self, frame: DepthFrame) -> _Scaled:
        size = (self._camera.height, self._camera.width)
        check_shape("DepthFrame.depth_mm", frame.depth_mm, size)
        check_shape("DepthFrame.valid", frame.valid, size)
        counts = frame.valid & np.isfinite(frame.depth_mm) & (frame.depth_mm > 0)
        depth_mm = np.where(counts, self._scale * frame.depth_mm, np.nan).astype(np.float32)
        poses: dict[Poses, np.ndarray] = {}
        if frame.T_reference_camera is not None:
            poses["reference"] = frame.T_reference_camera
        if frame.T_world_camera is not None:
            T = frame.T_world_camera
            poses["estimated"] = se3(T[:3, :3], self._scale * T[:3, 3])
        for T in poses.values():
            check_shape("DepthFrame pose", T, (4, 4))
        return _Scaled(depth_mm, poses)

    def _measure(self, previous: _Scaled, current: _Scaled, link: ImageLink | None) -> None:
        self._changes["same_pixel"].append(depth_change(previous.depth_mm, current.depth_mm))
        motions: dict[Poses, np.ndarray] = {}
        for name in _shared_poses(previous, current):
            motions[name] = inverse(current.poses[name]) @ previous.poses[name]
            errors = alignment_errors(previous.depth_mm, current.depth_mm, self._camera, motions[name])
            self._alignments[name].append(errors)
        self._measure_matches(previous, current, link)
        if link is not None and link.to_previous is not None:
            self._measure_flow(previous, current, link, motions)

    def _measure_flow(
        self, previous: _Scaled, current: _Scaled, link: ImageLink, motions: dict[Poses, np.ndarray]
    ) -> None:
        assert link.to_previous is not None
        before = pull(previous.depth_mm, link.to_previous)
        self._changes["along_flow"].append(depth_change(before, current.depth_mm, link.consistent))
        self._changes["opw"].append(depth_change(before, current.depth_mm, link.alike))
        for name, T_current_previous in motions.items():
            moved = seen_from(current.depth_mm, self._camera, inverse(T_current_previous))
            self._changes[f"opw_{name}"].append(depth_change(before, moved, link.alike))

    def _measure_matches(self, previous: _Scaled, current: _Scaled, link: ImageLink | None) -> None:
        pairs: dict[str, tuple[np.ndarray, np.ndarray] | None] = {"camera": None}
        pairs |= {
            n: (previous.poses[n], current.poses[n]) for n in _POSES if n in previous.poses and n in current.poses
        }
        for name in ("camera", *_POSES):
            # A pair without matches or poses keeps its place, so that pair k stays pair k in every figure.
            measured = (np.empty(0, np.float32), np.empty(0, np.float32))
            if link is not None and name in pairs:
                found = displacements(link.matches, previous.depth_mm, current.depth_mm, self._camera, pairs[name])
                measured = (found.displacement_mm.astype(np.float32), found.relative.astype(np.float32))
            self._displacements[name].append(measured)

    def _alignment(self, poses: Poses) -> AlignmentError:
        errors = np.array(self._alignments[poses], dtype=np.float64).reshape(-1, 2)
        known = np.isfinite(errors)
        percent = 100 * float(errors[known].mean()) if known.any() else float("nan")
        return AlignmentError(int(known.any(axis=1).sum()), percent)

    def _displacement(self, name: str) -> DisplacementSummary:
        rows = self._displacements[name]
        return DisplacementSummary.of([row[0] for row in rows], [row[1] for row in rows])


def _shared_poses(previous: _Scaled, current: _Scaled) -> list[Poses]:
    """Return the kinds of pose that both frames have."""
    return [name for name in _POSES if name in previous.poses and name in current.poses]
