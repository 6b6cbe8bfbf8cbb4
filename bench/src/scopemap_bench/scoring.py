"""Scores a run's folder against the truth of its sequence: the same figures for every method."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from scopemap.engine.config import MaskSettings
from scopemap.engine.errors import AlignmentError, InputError
from scopemap.engine.flow.estimator import FlowEstimator, pair_flow
from scopemap.engine.flow.flows import create_flow
from scopemap.engine.fusion.mesh_files import read_mesh
from scopemap.engine.geometry.align import AlignMode
from scopemap.engine.masking.masker import Masker
from scopemap.evaluation.poses import MatchedTrajectories, frames_until_loss, longest_run, match, pose_report
from scopemap.evaluation.turn import NOT_DETERMINED, Turn
from scopemap.input.opening import open_sequence
from scopemap.input.sequence import Sequence
from scopemap.input.trajectory.trajectory import Trajectory
from scopemap.result.depth_maps import DepthReader
from scopemap.result.reference import reference_trajectory
from scopemap.result.trajectories import read_trajectory
from scopemap.runner.reread_frames import is_camera_of, open_truth
from scopemap_bench.climb.submission import with_score
from scopemap_bench.evaluation import depth as depth_errors
from scopemap_bench.evaluation.consistency import ConsistencyMeter, FrameMatcher
from scopemap_bench.evaluation.depth import DEPTH_RANGES_MM, DepthPairs, DepthScaling
from scopemap_bench.evaluation.failure import FailureMeter
from scopemap_bench.evaluation.paper import paper_figures
from scopemap_bench.evaluation.protocols import PROTOCOLS
from scopemap_bench.evaluation.true_surface import TrueSurface, measure_surface, read_true_surface
from scopemap_bench.plan import ProtocolPlan
from scopemap_bench.result import Figures
from scopemap_bench.true_depth import TrueDepths

TRUTH_CONTRADICTED = "true poses contradicted"
"""The word for clips whose pictures contradict the true poses: no method is counted there."""
_CONSISTENCY_PX = 1.0
_MAX_VIEWS = 40
_LIMIT_MM = 0.5  # a turn that moves surfaces by less leaves them as they are


def score(
    folder: Path,
    sequence: Sequence,
    protocol: ProtocolPlan,
    align: AlignMode | None = None,
    flows: Path | None = None,
    truths: Path | None = None,
) -> Figures:
    """Return all figures of a run's folder that its sequence's truth allows, by group.

    flows, truths : folders that keep flow and true depth for other runs of the sequence.
    """
    estimate, reference = read_trajectory(folder), reference_trajectory(sequence)
    figures, matched = pose_groups(estimate, reference, protocol, align or protocol.align)
    if "climb" in figures and reference is not None:
        figures["climb"] = with_score(figures["climb"], folder, estimate, reference)
    if matched is not None and protocol.surface:
        surface = surface_figures_of(folder, sequence, matched, icp=protocol.icp)
        figures |= {"surface": surface} if surface else {}
    depth, true_depths = DepthReader(folder), TrueDepths(sequence, truths)
    if depth.present and protocol.depth:
        figures |= _depth(depth, true_depths, protocol, matched)
    if depth.present and protocol.consistency:
        figures |= _consistency(depth, sequence, true_depths, estimate, protocol, flows)
    if protocol.contradiction:
        figures["poses"] |= _contradiction(sequence, estimate)
    return figures


def pose_groups(
    estimate: Trajectory, reference: Trajectory | None, protocol: ProtocolPlan, align: AlignMode
) -> tuple[Figures, MatchedTrajectories | None]:
    """Return "poses", "paper" and the protocols' groups, and the alignment; without one, "poses" that need no truth."""
    matched: MatchedTrajectories | None = None
    # A path that cannot be aligned (one place, one line) still has rotation, TLR and an error from the start.
    modes: tuple[AlignMode, ...] = (align, "origin")
    for mode in modes:
        with suppress(AlignmentError):
            matched = matched or (match(estimate, reference, mode) if reference is not None else None)
    if matched is None or reference is None:
        tracked = estimate.tracked
        own = {"frames": len(tracked), "tracked": int(np.count_nonzero(tracked))}
        own |= {"longest_tracked": longest_run(tracked), "frames_until_loss": frames_until_loss(tracked)}
        return {"poses": own}, None
    figures: Figures = {"poses": pose_report(matched), "paper": paper_figures(matched)}
    for name in protocol.protocols:
        # A protocol's own fit may fail where ours does not: then it has no figures.
        with suppress(AlignmentError):
            known = PROTOCOLS[name]
            figures[name] = known(estimate, reference) | {"description": known.description, "source": known.source}
    return figures, matched


def surface_figures_of(
    run: Path, truth: Sequence | Path, matched: MatchedTrajectories, *, icp: bool = False
) -> dict[str, Any]:
    """Return the figures of a run's mesh.ply against the true surface of a data set; {} where there is none.

    `matched` takes the run's world to the true one. A sequence tells what of the true surface its views show, where the
    data set does not. "turn" is "not determined", and what is measured before ICP is NaN, where the distance may be the
    alignment's own; else "".
    Raises `InputError` for a mesh that cannot be read.
    """
    file = run / "mesh.ply"
    if not file.is_file():
        return {}
    mesh = read_mesh(file)
    true_surface = read_true_surface(truth) if isinstance(truth, Path) else _seen_surface(truth)
    if true_surface is None:
        return {}
    moved = trimesh.Trimesh(matched.similarity.transform_points(np.asarray(mesh.vertices)), mesh.faces, process=False)
    camera = None
    if true_surface.T_view is not None:
        camera = (open_sequence(truth) if isinstance(truth, Path) else truth).camera
    figures = measure_surface(moved, true_surface, camera=camera, icp=icp)
    if _determines_surface(matched.turn, np.asarray(moved.vertices), figures["accuracy_mean_mm"]):
        return figures | {"turn": ""}
    kept = {name: value for name, value in figures.items() if "icp" in name or name == "observed_share"}
    return dict.fromkeys(figures, math.nan) | kept | {"turn": NOT_DETERMINED}


def _determines_surface(turn: Turn, points_mm: np.ndarray, error_mm: float) -> bool:
    """Return whether a distance that points (N, 3), mm, were found to have after the alignment is the method's."""
    if not len(points_mm):
        return True
    arm_mm = np.sqrt(np.mean(np.sum((points_mm - turn.centre_mm) ** 2, axis=1)))
    return turn.determines(float(turn.off_rad * arm_mm), max(_LIMIT_MM, error_mm / 2))


def _seen_surface(sequence: Sequence) -> TrueSurface | None:
    """Return the true surface with the part that the sequence's frames show."""
    surface = read_true_surface(sequence.path)
    whole_clip = sequence.selection == slice(None)
    # What a data set states as seen is valid for its whole clip.
    if surface is None or (surface.seen is not None and whole_clip) or surface.T_view is not None:
        return surface
    stamps = sequence.source.stamps(sequence.selection) or []
    true_depths, views = TrueDepths(sequence), {}
    for index, _ in stamps[:: max(1, -(-len(stamps) // _MAX_VIEWS))]:
        pose = sequence.source.pose(index)
        depth_mm = None if pose is None else true_depths(index)
        if pose is not None and depth_mm is not None:
            views[index] = (pose, depth_mm)
    return surface.seen_by(sequence.camera, views) if views else surface


def depth_groups(
    run: Path,
    truth: Path,
    scaling: DepthScaling | None,
    *,
    consistency: bool,
    matched: MatchedTrajectories | None = None,
) -> Figures:
    """Return "depth" (unless `scaling` is None) and "consistency" of a run's depth against the data set in `truth`.

    matched : the aligned trajectory, for the metric consistency of depth with it. Raises `InputError` where the run
    kept no depth, or has another camera than the data set, which must have true depth.
    """
    depth = DepthReader(run)
    if not depth.present:
        raise InputError(f"{run} holds no depth maps (depth/depth.json); only a run's folder does")
    sequence = open_truth(run, truth)
    if not is_camera_of(run, sequence):
        raise InputError(f"the run {run} was made with another camera than {truth} gives: their depths do not compare")
    protocol, true_depths = default_protocol(sequence), TrueDepths(sequence)
    figures: Figures = {}
    if scaling is not None:
        figures |= _depth(depth, true_depths, protocol.model_copy(update={"depth_scaling": scaling}), matched)
        if not figures:
            raise InputError(f"{truth} has no true depth of the frames with depth in {run}")
    if consistency:
        figures |= _consistency(depth, sequence, true_depths, read_trajectory(run), protocol)
    return figures


def default_protocol(sequence: Sequence) -> ProtocolPlan:
    """Return the protocol with the range of true depth that is usual for the data set."""
    name = next((known for known in DEPTH_RANGES_MM if sequence.source.name.startswith(known)), "")
    return ProtocolPlan(depth_range_mm=DEPTH_RANGES_MM.get(name, ProtocolPlan().depth_range_mm))


def true_pairs(depth: DepthReader, true_depths: TrueDepths) -> DepthPairs:
    """Return a factory of (estimated, true) depth of the frames that have both, in order."""

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for index in true_depths.numbers():
            estimated_mm = depth.read(index)
            true_mm = None if estimated_mm is None else true_depths(index)
            if estimated_mm is not None and true_mm is not None:
                yield estimated_mm, true_mm

    return pairs


def _depth(
    depth: DepthReader, true_depths: TrueDepths, protocol: ProtocolPlan, matched: MatchedTrajectories | None
) -> Figures:
    report = depth_errors.evaluate_depth_sequence(
        true_pairs(depth, true_depths),
        scaling=protocol.depth_scaling,
        truth_range_mm=protocol.depth_range_mm,
        clip_prediction=protocol.clip_depth,
    )
    if not report.frames:
        return {}
    found = report.mean | {"jitter": report.jitter}
    if matched is not None:
        found["metric_consistency"] = depth_errors.metric_consistency(report.scales, matched.similarity.scale)
    return {"depth": found}


def _consistency(
    depth: DepthReader,
    sequence: Sequence,
    true_depths: TrueDepths,
    estimate: Trajectory,
    protocol: ProtocolPlan,
    flows: Path | None = None,
) -> Figures:
    """Measure depth over time, after one scale factor for all frames where true depth is known."""
    scale = depth_errors.fit_sequence(true_pairs(depth, true_depths), "sequence-median", protocol.depth_range_mm).scale
    camera = sequence.camera
    matcher, meter = FrameMatcher(camera), ConsistencyMeter(camera, scale)
    estimator, masker = create_flow(protocol.flow), Masker(MaskSettings())
    folder = None if flows is None else flows / estimator.name
    poses = _tracked_poses(estimate)
    before: np.ndarray | None = None
    for frame in sequence.frames():
        # Highlights move with the lamp, and pixels outside the field of view show no tissue: one mask for all methods.
        valid = masker(frame).valid
        found = (None, None) if before is None else flow_to_previous(estimator, frame.index, before, frame.rgb, folder)
        correspondence = matcher.match(frame.rgb, valid, *found)
        before = frame.rgb
        depth_mm = depth.read(frame.index)
        meter.add(
            np.full(valid.shape, np.nan, np.float32) if depth_mm is None else depth_mm,
            valid,
            correspondence,
            T_world_camera=poses.get(frame.index),
            T_reference_camera=sequence.source.pose(frame.index),
            true_depth_mm=true_depths(frame.index),
        )
    return {"consistency": meter.report() | {"flow": estimator.name}}


def _contradiction(sequence: Sequence, estimate: Trajectory) -> dict[str, int | str]:
    """Count frames until the poses contradict the pictures; where the true ones do, too, only say so."""
    masker, poses = Masker(MaskSettings()), _tracked_poses(estimate)
    meter, meter_of_truth = FailureMeter(sequence.camera), FailureMeter(sequence.camera)
    for frame in sequence.frames():
        valid, true_pose = masker(frame).valid, sequence.source.pose(frame.index)
        meter.add(frame.rgb, valid, poses.get(frame.index))
        if true_pose is not None:
            meter_of_truth.add(frame.rgb, valid, true_pose)
    # Tissue that moves by itself, or poses of another clip: then the criterion says nothing about a method.
    if meter_of_truth.is_contradicted:
        return {"contradiction": TRUTH_CONTRADICTED}
    return dict(meter.figures())


def _tracked_poses(estimate: Trajectory) -> dict[int, np.ndarray]:
    """Return the poses (4, 4) of the tracked frames by number."""
    rows = np.flatnonzero(estimate.tracked)
    return dict(zip(estimate.indices[rows].tolist(), estimate.T_world_camera[rows], strict=True))


def flow_to_previous(
    estimator: FlowEstimator, index: int, rgb_previous: np.ndarray, rgb_current: np.ndarray, folder: Path | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return flow (H, W, 2) float32 px from frame `index` to the one before, and its consistent pixels (H, W) bool.

    `folder` keeps the flow, so that all methods are measured with the same one. Half precision, with and without it.
    """
    file = None if folder is None else folder / f"{index:06d}.npz"
    if file is not None and file.is_file():
        with np.load(file) as kept:
            return kept["to_previous"].astype(np.float32), kept["consistent"]
    found = pair_flow(estimator, rgb_previous, rgb_current, _CONSISTENCY_PX)
    half = found.to_previous.astype(np.float16)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        draft = file.with_suffix(".part.npz")
        np.savez_compressed(draft, to_previous=half, consistent=found.consistent)
        draft.replace(file)
    return half.astype(np.float32), found.consistent
