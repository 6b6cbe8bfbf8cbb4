"""`scopemap evaluate`: compare a run or a trajectory file with true poses, or a run's surface with its own video."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scopemap.apps.evaluate.measures import Asked, Compared
from scopemap.engine.errors import InputError
from scopemap.terminal.figures import show
from scopemap.terminal.options import Align, AsJson, InputNow, Unit, advanced, warn_of_damage

if TYPE_CHECKING:
    from scopemap.evaluation.poses import MatchedTrajectories
    from scopemap.terminal.figures import OutputForm


def evaluate(
    trajectory: Annotated[
        Path, typer.Argument(metavar="DIR|TRAJECTORY", help="Folder of a run, or trajectory file (docs/formats.md).")
    ],
    truth: Annotated[
        Path | None,
        typer.Option(help="True poses: folder of a data set's sequence, or trajectory file."),
    ] = None,
    against_video: Annotated[
        bool,
        typer.Option(
            "--against-video",
            help="Compare every 10th frame with the surface fused from the others; needs no truth.",
        ),
    ] = False,
    source: InputNow = None,
    align: Annotated[
        Align, typer.Option(help="Align before measuring; origin: to the first frame; scale: in size only.")
    ] = "sim3",
    align_first: Annotated[
        int | None, advanced(min=3, metavar="N", help="Fit the alignment to the first N tracked frames; default: all.")
    ] = (None),
    time_offset: Annotated[
        str,
        advanced(
            metavar="SECONDS|fit",
            help="Read the truth this much later, s; fit: find the offset within half a second.",
        ),
    ] = "0",
    unit: Annotated[
        Unit | None, advanced(help="Unit of a trajectory file that states none; default: its format's, m for TUM.")
    ] = None,
    truth_unit: Annotated[Unit | None, advanced(help="Unit of the truth; default: as --unit.")] = None,
    kind: Annotated[str, advanced(help="Format of the trajectory file; auto: by its content.")] = "auto",
    truth_kind: Annotated[
        str, advanced(help="Format of the truth, or name of its data set; auto: by its content.")
    ] = "auto",
    as_json: AsJson = False,
    as_csv: Annotated[bool, typer.Option("--csv", help="Print CSV to standard output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print one line of figures and no warnings.")] = False,
    further: Sequence[Asked] = (),
) -> None:
    """Measure errors against the truth or a run's own video.

    Frames are matched by number if both sides have numbers (line of the pose file, index in frames.csv, whole numbers
    as TUM time stamps), else by time within 0.01 s. Files without times count as 30 frames per second. The package
    scopemap-bench adds depth, surfaces and the protocols of other papers.
    """
    form = _output_form(as_json=as_json, as_csv=as_csv, quiet=quiet)
    offset = _offset_of(time_offset)
    if truth is None and (not against_video or any(measure.by_name for measure in further)):
        raise typer.BadParameter("needed for all figures but those of --against-video", param_hint="--truth")
    if os.path.isdir(trajectory):
        warn_of_damage(trajectory, silent=quiet)
    figures = _against_own_video(trajectory, source) if against_video else {}
    if truth is not None:
        from scopemap.evaluation.clock import by_clock
        from scopemap.evaluation.doubts import doubts
        from scopemap.evaluation.poses import match, pose_report
        from scopemap.result.reference import read_reference
        from scopemap.result.trajectories import read_trajectory

        estimate = read_trajectory(trajectory, unit=unit, kind=kind)
        reference = read_reference(truth, unit=truth_unit or unit, kind=truth_kind)
        if reference is None:
            figures = _without_poses(Compared(trajectory, truth, estimate), further) | figures
        else:
            reference, clock = by_clock(estimate, reference, align, offset, first=align_first)
            matched = match(estimate, reference, align, first=align_first)
            measured = _measured(Compared(trajectory, truth, estimate, reference, matched), further)
            sources = {"trajectory": estimate.source, "truth": reference.source}
            read_s = clock.get("time_offset_s", 0.0)
            doubted = doubts(estimate, reference, matched, read_s=0.0 if math.isnan(read_s) else read_s)
            said = {"doubts": doubted} if doubted else {}
            figures = pose_report(matched) | clock | measured | figures | said | {"sources": sources}
            if not quiet:
                _warn_of(matched, clock, doubted)
    show(figures, form)


def _measured(compared: Compared, further: Sequence[Asked]) -> dict[str, Any]:
    return {name: group for measure in further for name, group in measure(compared).items()}


def _without_poses(compared: Compared, further: Sequence[Asked]) -> dict[str, Any]:
    if found := _measured(compared, further):
        return found
    alone = "if it has depth, --depth median (of scopemap-bench) compares that alone"
    raise InputError(f"{compared.truth} has no true poses; {alone}")


def _offset_of(text: str) -> float | Literal["fit"]:
    """Return the clock offset, s, or "fit"."""
    if text == "fit":
        return "fit"
    try:
        offset_s = float(text)
    except ValueError:
        offset_s = math.nan
    if not math.isfinite(offset_s):
        raise typer.BadParameter(f"expected seconds or fit, got {text!r}", param_hint="--time-offset")
    return offset_s


def _output_form(*, as_json: bool, as_csv: bool, quiet: bool) -> OutputForm:
    """Return how figures are printed. Raises `BadParameter` where two forms are asked for."""
    if as_json and as_csv:
        raise typer.BadParameter("not both of --json and --csv", param_hint="--csv")
    return "json" if as_json else "csv" if as_csv else "line" if quiet else "table"


def _against_own_video(run: Path, source: Path | None = None) -> dict[str, Any]:
    """Return the agreement of a run's surface with its own video, which is written into the run's folder, too."""
    from scopemap.apps.evaluate.against_video import held_out_agreement

    agreement = held_out_agreement(run, source)
    agreement.save(run / "against_video")
    return {"against_video": agreement.figures()}


def _warn_of(matched: MatchedTrajectories, clock: dict[str, Any], doubted: Sequence[str]) -> None:
    """Print what limits the figures of these trajectories.

    clock : what `by_clock` says of the truth's clock. doubted : other readings of the two that would agree better.
    """
    from scopemap.evaluation.clock import clock_sentence

    for sentence in doubted:
        typer.echo(f"warning: {sentence}", err=True)
    if said := clock_sentence(clock):
        typer.echo(f"warning: {said}", err=True)
    lost = int((~matched.tracked).sum())
    if lost:
        counted = f"{lost} of {len(matched.tracked)} frames are lost"
        typer.echo(f"warning: {counted} and left out of all but one figure", err=True)
    if matched.similarity.straight:
        turn = "the turn about it is fitted to the orientations, since positions do not tell it"
        typer.echo(f"warning: the path is nearly a straight line: {turn}", err=True)
    if not len(matched.turned[0]):
        bound = f"their errors may turn it by up to {math.degrees(min(matched.turn.bound_rad, math.pi)):.1f} deg"
        left = "rotation after it is left out, rotation_unaligned_* needs none"
        typer.echo(f"warning: the positions do not determine the alignment's turn ({bound}): {left}", err=True)
