"""`scopemap evaluate`: compare a run or a trajectory file with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scopemap.cli.figures import show
from scopemap.cli.options import Align, AsJson, Unit
from scopemap.errors import CalibrationError, InputError, SettingsError

if TYPE_CHECKING:
    from scopemap.cli.figures import OutputForm
    from scopemap.evaluation.poses import MatchedTrajectories
    from scopemap.io.sequence import Sequence
    from scopemap.trajectory.trajectory import Trajectory

# Below this ratio of singular values the path hardly determines the rotation about it.
_WEAK_LINE_RATIO = 1e-3


DepthScaling = Literal["none", "median", "scale-and-shift", "sequence-median", "sequence-scale-and-shift"]


def evaluate(
    trajectory: Annotated[
        Path,
        typer.Argument(
            metavar="DIR|TRAJECTORY",
            help="A run's folder; a TUM, KITTI or C3VD file; a SCARED folder; what OneSLAM, EndoGSLAM, Endo-2DTAM, "
            "BodySLAM, Open3D, Endo-Depth-and-Motion or COLMAP wrote.",
        ),
    ],
    truth: Annotated[
        Path | None,
        typer.Option(
            help="True poses: the folder of any data set's sequence, or a trajectory file. With a run's mesh.ply and a "
            "true surface there, the mesh is measured too, moved by the same alignment."
        ),
    ] = None,
    against_video: Annotated[
        bool,
        typer.Option(
            "--against-video",
            help="A run's surface against its own video, no truth needed: every 10th frame is kept out of fusion and "
            "compared with the mesh of the others; DIR/against_video holds a row per frame and a picture.",
        ),
    ] = False,
    align: Annotated[
        Align,
        typer.Option(help="Alignment before measuring; origin: of the first frames, scale: of the size alone."),
    ] = "sim3",
    align_first: Annotated[
        int | None, typer.Option(min=3, metavar="N", help="Fit on the first N tracked frames only.")
    ] = None,
    unit: Annotated[Unit, typer.Option(help="Unit of a trajectory file that does not state one.")] = "mm",
    truth_unit: Annotated[Unit | None, typer.Option(help="The same for the truth; as --unit if left out.")] = None,
    kind: Annotated[str, typer.Option(help="Form of the trajectory file where its content fits two.")] = "auto",
    truth_kind: Annotated[str, typer.Option(help="The same for the truth, or the name of a data set.")] = "auto",
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
        DepthScaling | None,
        typer.Option(help="Also a run's depth maps against true depth, scaled so."),
    ] = None,
    consistency: Annotated[
        bool, typer.Option("--consistency", help="Also the consistency of a run's depth over time.")
    ] = False,
    as_json: AsJson = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="One line of figures, no warnings.")] = False,
) -> None:
    """Compare a trajectory with the truth, or a run's surface with its own video.

    Frames are matched by number where both sides have one (line of the pose file, index in frames.csv, whole numbers
    as TUM time stamps), else by time within 0.01 s; files without times count 30 frames per s.
    """
    if as_json and as_csv:
        raise typer.BadParameter("not both of --json and --csv", param_hint="--csv")
    from scopemap.benchmark.scoring import depth_groups
    from scopemap.evaluation.paper import paper_figures
    from scopemap.evaluation.poses import match, pose_report
    from scopemap.io.datasets.reference import read_reference
    from scopemap.trajectory.formats.opening import read_trajectory

    form: OutputForm = "json" if as_json else "csv" if as_csv else "line" if quiet else "table"
    if truth is None:
        if not against_video or depth or consistency or protocol or icp or paper_units:
            raise typer.BadParameter("needed for all figures but those of --against-video", param_hint="--truth")
        show(_against_video(trajectory), form)
        return
    own = _against_video(trajectory) if against_video else {}
    estimate = read_trajectory(trajectory, unit=unit, kind=kind)
    reference = read_reference(truth, unit=truth_unit or unit, kind=truth_kind)
    if reference is None:
        if not (depth or consistency):
            raise InputError(f"{truth} has no true poses; if it has depth: --depth median compares that alone")
        show(depth_groups(trajectory, truth, depth, consistency=consistency) | own, form)
        return
    matched = match(estimate, reference, align, first=align_first)
    figures: dict[str, Any] = pose_report(matched) | _surface(trajectory, truth, matched, icp=icp)
    if paper_units:
        figures["paper"] = paper_figures(matched)
    figures |= _protocols(estimate, reference, protocol or [])
    if depth or consistency:
        figures |= depth_groups(trajectory, truth, depth, consistency=consistency)
    figures |= own
    figures["sources"] = {"trajectory": estimate.source, "truth": reference.source}
    if not quiet:
        _warn(matched)
    show(figures, form)


def _surface(trajectory: Path, truth: Path, matched: MatchedTrajectories, *, icp: bool) -> dict[str, Any]:
    if not (trajectory / "mesh.ply").is_file() or not truth.is_dir():
        if icp:
            raise InputError("--icp needs a run's mesh.ply and a folder with a true surface")
        return {}
    from scopemap.benchmark.scoring import surface_figures_of
    from scopemap.benchmark.truth import open_truth
    from scopemap.io.opening import open_sequence

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


def _against_video(run: Path) -> dict[str, Any]:
    from scopemap.benchmark.held_out import held_out_agreement

    agreement = held_out_agreement(run)
    agreement.save(run / "against_video")
    return {"against_video": agreement.figures()}


def _protocols(estimate: Trajectory, reference: Trajectory, names: list[str]) -> dict[str, Any]:
    from scopemap.evaluation.protocols import PROTOCOLS

    unknown = [name for name in names if name not in PROTOCOLS]
    if unknown:
        raise SettingsError(f"unknown protocol '{unknown[0]}': choose from {', '.join(PROTOCOLS)}")
    chosen = [PROTOCOLS[name] for name in names]
    return {known.name: known(estimate, reference) | {"description": known.description} for known in chosen}


def _warn(matched: MatchedTrajectories) -> None:
    lost = int((~matched.tracked).sum())
    if lost:
        typer.echo(
            f"warning: {lost} of {len(matched.tracked)} frames are lost and left out of all but one figure", err=True
        )
    if matched.similarity.line_ratio < _WEAK_LINE_RATIO:
        typer.echo(
            f"warning: the path is nearly a straight line (D2/D1 = {matched.similarity.line_ratio:.1e}); the rotation "
            "about it is poorly determined, and so are the rotation errors",
            err=True,
        )
