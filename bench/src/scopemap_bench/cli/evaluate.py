"""What this package adds to `scopemap evaluate`: surfaces, depth, the protocols of other papers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from scopemap.apps.evaluate.measures import Compared
from scopemap.engine.errors import CalibrationError, InputError, SettingsError
from scopemap_bench.evaluation.protocol_words import PROTOCOL_WORDS

if TYPE_CHECKING:
    from pathlib import Path

    from scopemap.input.sequence import Sequence

DepthScaling = Literal["none", "median", "scale-and-shift", "sequence-median", "sequence-scale-and-shift"]


def surface(
    compared: Compared,
    icp: Annotated[
        bool,
        typer.Option(
            "--icp",
            help="Also measure the mesh after refining its alignment by ICP.",
        ),
    ] = False,
) -> dict[str, Any]:
    """Return the figures of a run's mesh against a true surface; {} without one."""
    if compared.matched is None:
        return {}
    run, truth = compared.run, compared.truth
    if not (run / "mesh.ply").is_file() or not truth.is_dir():
        if icp:
            raise InputError("--icp needs a run's mesh.ply and a folder with a true surface")
        return {}
    from scopemap.input.opening import open_sequence
    from scopemap.runner.reread_frames import open_truth
    from scopemap_bench.scoring import surface_figures_of

    try:
        place: Sequence | Path = open_sequence(truth)
    except CalibrationError:  # the run's user knew better
        place = open_truth(run, truth)
    except InputError:  # poses and a surface, but no frames that would tell what was seen of it
        place = truth
    found = surface_figures_of(run, place, compared.matched, icp=icp)
    if not found:
        return {}
    short = {"mesh_accuracy_mm": "accuracy_mean_mm", "mesh_accuracy_p90_mm": "accuracy_p90_mm"}
    short |= {"mesh_completeness_mm": "completeness_mean_mm"}
    return {name: found[long] for name, long in short.items()} | {"surface": found}


def paper(
    compared: Compared,
    paper_units: Annotated[
        bool, typer.Option("--paper-units", help="Also print the paper's table 1, rotations in radians.")
    ] = False,
) -> dict[str, Any]:
    """Return the figures of the paper's table 1."""
    if compared.matched is None or not paper_units:
        return {}
    from scopemap_bench.evaluation.paper import paper_figures

    return {"paper": paper_figures(compared.matched)}


def protocols(
    compared: Compared,
    protocol: Annotated[
        list[str] | None,
        typer.Option(help=f"Also measure by {', '.join(PROTOCOL_WORDS)}."),
    ] = None,
) -> dict[str, Any]:
    """Return a group of figures for each protocol asked for."""
    if compared.reference is None or not protocol:
        return {}
    from scopemap_bench.climb.submission import with_score
    from scopemap_bench.evaluation.protocols import PROTOCOLS

    for name in protocol:
        if name not in PROTOCOLS:
            raise SettingsError(f"unknown protocol '{name}': choose from {', '.join(PROTOCOLS)}")
    given = (compared.estimate, compared.reference)
    figures = {name: PROTOCOLS[name](*given) for name in protocol}
    if "climb" in figures:
        figures["climb"] = with_score(figures["climb"], compared.run, *given)
    return {name: found | {"description": PROTOCOLS[name].description} for name, found in figures.items()}


def depth(
    compared: Compared,
    scaling: Annotated[
        DepthScaling | None, typer.Option("--depth", help="Also compare depth maps with true depth, scaled this way.")
    ] = None,
    consistency: Annotated[
        bool,
        typer.Option(
            "--consistency",
            help="Also measure the consistency of depth over time; --truth must be a data set's folder.",
        ),
    ] = False,
) -> dict[str, Any]:
    """Return the figures of a run's depth maps; a truth without poses will do."""
    if scaling is None and not consistency:
        return {}
    from scopemap_bench.scoring import depth_groups

    return depth_groups(compared.run, compared.truth, scaling, consistency=consistency, matched=compared.matched)


MEASURES = (surface, paper, protocols, depth)
"""The measures, in the order of their figures."""
