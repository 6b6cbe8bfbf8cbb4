"""`scopemap evaluate` with all that this package measures: depth, surfaces, the protocols of other papers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scopemap.apps.evaluate.command import (
    AgainstVideo,
    AlignBy,
    AlignFirst,
    AsCsv,
    EstimatePath,
    OfKind,
    OfUnit,
    OneLine,
    TimeOffset,
    TruthKind,
    TruthUnit,
    against_own_video,
    offset_of,
    output_form,
    warn_of,
)
from scopemap.engine.errors import CalibrationError, InputError, SettingsError
from scopemap.terminal.figures import show
from scopemap.terminal.options import AsJson, InputNow

if TYPE_CHECKING:
    from scopemap.evaluation.poses import MatchedTrajectories
    from scopemap.input.sequence import Sequence
    from scopemap.input.trajectory.trajectory import Trajectory

DepthScaling = Literal["none", "median", "scale-and-shift", "sequence-median", "sequence-scale-and-shift"]


def evaluate(
    trajectory: EstimatePath,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="True poses: the folder of any data set's sequence, or a trajectory file. With a run's mesh.ply and a "
            "true surface there, the mesh is measured too, moved by the same alignment."
        ),
    ] = None,
    against_video: AgainstVideo = False,
    source: InputNow = None,
    align: AlignBy = "sim3",
    align_first: AlignFirst = None,
    time_offset: TimeOffset = "0",
    unit: OfUnit = "mm",
    truth_unit: TruthUnit = None,
    kind: OfKind = "auto",
    truth_kind: TruthKind = "auto",
    paper_units: Annotated[
        bool, typer.Option("--paper-units", help="Also the figures of the paper's table 1, rotations in radians.")
    ] = False,
    protocol: Annotated[
        list[str] | None,
        typer.Option(
            help="Also another protocol's figures, may be repeated: evo, af, endogslam, surgcut3r, free-surgs, simcol, "
            "robust-pose-estimator, oneslam, climb."
        ),
    ] = None,
    icp: Annotated[bool, typer.Option("--icp", help="Also the mesh after a refinement by ICP.")] = False,
    depth: Annotated[
        DepthScaling | None, typer.Option(help="Also a run's depth maps against true depth, scaled so.")
    ] = None,
    consistency: Annotated[
        bool, typer.Option("--consistency", help="Also how steady a run's depth is; --truth is a data set's folder.")
    ] = False,
    as_json: AsJson = False,
    as_csv: AsCsv = False,
    quiet: OneLine = False,
) -> None:
    """Compare a trajectory with the truth, or a run's surface with its own video.

    Frames are matched by number where both sides have one (line of the pose file, index in frames.csv, whole numbers
    as TUM time stamps), else by time within 0.01 s; files without times count 30 frames per s.
    """
    form = output_form(as_json=as_json, as_csv=as_csv, quiet=quiet)
    offset = offset_of(time_offset)
    from scopemap.evaluation.clock import by_clock
    from scopemap.evaluation.poses import match, pose_report
    from scopemap.result.reference import read_reference
    from scopemap.result.trajectories import read_trajectory
    from scopemap_bench.climb.submission import with_score
    from scopemap_bench.evaluation.paper import paper_figures
    from scopemap_bench.scoring import depth_groups

    if truth is None:
        if not against_video or depth or consistency or protocol or icp or paper_units:
            raise typer.BadParameter("needed for all figures but those of --against-video", param_hint="--truth")
        show(against_own_video(trajectory, source), form)
        return
    own = against_own_video(trajectory, source) if against_video else {}
    estimate = read_trajectory(trajectory, unit=unit, kind=kind)
    reference = read_reference(truth, unit=truth_unit or unit, kind=truth_kind)
    if reference is None:
        if not (depth or consistency):
            raise InputError(f"{truth} has no true poses; if it has depth: --depth median compares that alone")
        show(depth_groups(trajectory, truth, depth, consistency=consistency) | own, form)
        return
    reference, clock = by_clock(estimate, reference, align, offset, first=align_first)
    matched = match(estimate, reference, align, first=align_first)
    figures: dict[str, Any] = pose_report(matched) | clock | _surface(trajectory, truth, matched, icp=icp)
    if paper_units:
        figures["paper"] = paper_figures(matched)
    figures |= _protocols(estimate, reference, protocol or [])
    if "climb" in figures:
        figures["climb"] = with_score(figures["climb"], trajectory, estimate, reference)
    if depth or consistency:
        figures |= depth_groups(trajectory, truth, depth, consistency=consistency, matched=matched)
    figures |= own
    figures["sources"] = {"trajectory": estimate.source, "truth": reference.source}
    if not quiet:
        warn_of(matched, clock)
    show(figures, form)


def _surface(trajectory: Path, truth: Path, matched: MatchedTrajectories, *, icp: bool) -> dict[str, Any]:
    if not (trajectory / "mesh.ply").is_file() or not truth.is_dir():
        if icp:
            raise InputError("--icp needs a run's mesh.ply and a folder with a true surface")
        return {}
    from scopemap.input.opening import open_sequence
    from scopemap.runner.reread_frames import open_truth
    from scopemap_bench.scoring import surface_figures_of

    try:
        place: Sequence | Path = open_sequence(truth)
    except CalibrationError:  # the run's user knew better
        place = open_truth(trajectory, truth)
    except InputError:  # poses and a surface, but no frames that would tell what was seen of it
        place = truth
    found = surface_figures_of(trajectory, place, matched.similarity, icp=icp)
    if not found:
        return {}
    short = {"mesh_accuracy_mm": "accuracy_mean_mm", "mesh_accuracy_p90_mm": "accuracy_p90_mm"}
    short |= {"mesh_completeness_mm": "completeness_mean_mm"}
    return {name: found[long] for name, long in short.items()} | {"surface": found}


def _protocols(estimate: Trajectory, reference: Trajectory, names: list[str]) -> dict[str, Any]:
    from scopemap_bench.evaluation.protocols import PROTOCOLS

    unknown = [name for name in names if name not in PROTOCOLS]
    if unknown:
        raise SettingsError(f"unknown protocol '{unknown[0]}': choose from {', '.join(PROTOCOLS)}")
    chosen = [PROTOCOLS[name] for name in names]
    return {known.name: known(estimate, reference) | {"description": known.description} for known in chosen}
