"""`scopemap measure`: distances and areas on the surface of a run, and the sizes of a lesion."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scopemap.terminal.options import AsJson, check_output, warn_of_damage

if TYPE_CHECKING:
    from scopemap.apps.measure.measure import Measure


def measure(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or of a submap such as result/maps/1.")],
    frame: Annotated[int | None, typer.Option(help="Number of the frame that the pixels or the mask refer to.")] = None,
    points: Annotated[str, typer.Option(help='Pixels "x,y x,y": two for a distance, three or more for an area.')] = "",
    lesion: Annotated[
        str,
        typer.Option(
            metavar="MASKS",
            help='Folder of masks numbered like frames; or, with --frame, one mask or an outline "x,y x,y x,y".',
        ),
    ] = "",
    second: Annotated[float | None, typer.Option(help="Time of the frame, s, instead of --frame.")] = None,
    reference: Annotated[
        str, typer.Option(help='Two pixels "x,y x,y" of the same frame whose distance is the reference.')
    ] = "",
    reference_mask: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Mask of an instrument shaft of known width, instead of --reference."),
    ] = None,
    reference_frame: Annotated[
        int | None, typer.Option(help="Frame of the reference, with --lesion; default: --frame.")
    ] = None,
    reference_mm: Annotated[
        float | None,
        typer.Option(min=1e-6, help="Reference distance, mm; without it, measures are multiples of the reference."),
    ] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Write pictures of the measured frames with the lesion's outline to this folder."
        ),
    ] = None,
    export: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the lesion, or all that is kept, for 3D Slicer (.mrk.json) or as a DICOM report (.dcm).",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure distances, areas or a lesion, with 95 % intervals.

    If the scale of the run is unknown, give a reference: two pixels or a mask, and its length. Without --points and
    --lesion the command shows what was measured by hand in the window.
    """
    if points and lesion:
        raise typer.BadParameter("give either --points or --lesion")
    if not (points or lesion):
        if reference or any(one is not None for one in (frame, second, reference_mask, reference_frame, reference_mm)):
            raise typer.BadParameter("--frame, --second and references need --points or --lesion")
        _show_kept(run, pictures, export, as_json)
        return
    if reference and reference_mask is not None:
        raise typer.BadParameter("give either --reference or --reference-mask")
    if frame is not None and second is not None:
        raise typer.BadParameter("give either --frame or --second")
    if points and frame is None and second is None:
        raise typer.BadParameter("--points needs --frame or --second")
    if points and (reference_mask or pictures or export or reference_frame is not None):
        raise typer.BadParameter("--points takes --frame or --second, --reference and --reference-mm alone")
    pixels = _pixels(points, "--points") if points else []
    if points and len(pixels) < 2:
        raise typer.BadParameter("at least two pixels are needed", param_hint="--points")
    ends = _pixels(reference, "--reference") if reference else None
    if ends is not None and len(ends) != 2:
        raise typer.BadParameter("two pixels are needed", param_hint="--reference")
    import numpy as np

    from scopemap.apps.measure import lesion as lesions
    from scopemap.apps.measure import measure as measuring
    from scopemap.apps.measure.findings import FINDING_ENDINGS, write_findings
    from scopemap.apps.measure.surface_finding import SurfaceFinding
    from scopemap.result.result import Result

    if export is not None:
        check_output(export, FINDING_ENDINGS, overwrite=True)

    warn_of_damage(run, silent=as_json)
    frame = frame if second is None else lesions.frame_at(run, second)
    if frame is not None and points:
        known = None if ends is None else np.array(ends)
        found = measuring.measure(run, frame, np.array(pixels), known, reference_mm)
        _show(found, [_facts(one) for one in found], as_json)
        if not as_json:
            camera = Result(run).camera
            typer.echo(f"pixels are those of frame {frame} after rectification, {camera.width}x{camera.height} px")
        return
    masks = Path(lesion) if Path(lesion).exists() else np.array(_pixels(lesion, "--lesion"))
    pair = lesions.shaft_width(run, reference_mask) if reference_mask is not None else ends
    given = None if pair is None else np.array(pair)
    measured = lesions.measure_lesion(
        run, masks, frame, reference=given, reference_frame=reference_frame, reference_mm=reference_mm
    )
    if export is not None:
        write_findings(run, [SurfaceFinding("lesion", measured.outline_mm, measured.measures)], measured.scale, export)
    if pictures is not None:
        lesions.write_outlines(run, measured.masks, pictures)
    facts = [_facts(one) for one in measured.measures]
    _show(measured.measures, {"measures": facts, "scale": measured.scale, "frames": list(measured.masks)}, as_json)
    if not as_json:
        typer.echo(f"from {len(measured.masks)} frames; the scale rests on {measured.scale}")


def _show_kept(run: Path, pictures: Path | None, export: Path | None, as_json: bool) -> None:
    """Show what was measured by hand on a run or a submap, and export it."""
    from scopemap.apps.measure.findings import FINDING_ENDINGS, write_findings
    from scopemap.apps.measure.hand_measure import findings_of, kept_measures
    from scopemap.report.measured_by_hand import (
        EARLIER,
        MEASUREMENTS,
        earlier_references,
        folder_in_whole,
        read_measurements,
    )
    from scopemap.result.result import Result

    if pictures is not None:
        raise typer.BadParameter("--pictures needs --lesion")
    result = Result(run).checked()
    here, whole = folder_in_whole(result), run.parent.parent if result.is_submap else run
    kept = [one for one in kept_measures(whole) if one.folder == here]
    if not kept:
        raise typer.BadParameter(f"give --points or --lesion: nothing was measured by hand in {whole / MEASUREMENTS}")
    if export is not None:
        check_output(export, FINDING_ENDINGS, overwrite=True)
        by_reference = "references set by hand" if any(one.reference is not None for one in kept) else result.scale
        write_findings(run, findings_of(kept), by_reference, export)
    if as_json:
        typer.echo(json.dumps([one.as_json for one in kept], indent=2))
        return
    earlier = earlier_references(Result(whole), [one.as_json for one in kept], read_measurements(whole))
    for one, is_earlier in zip(kept, earlier, strict=True):
        said = f"{one}, {EARLIER}" if is_earlier else str(one)
        typer.echo("\n  ".join(filter(None, (said, one.command(str(whole))))))


def _facts(one: Measure) -> dict[str, Any]:
    return vars(one) | {"value": one.value if math.isfinite(one.value) else None}


def _show(found: list[Measure], facts: Any, as_json: bool) -> None:
    typer.echo(json.dumps(facts, indent=2) if as_json else "\n".join(map(str, found)))


def _pixels(text: str, option: str) -> list[list[float]]:
    try:
        return [[float(x), float(y)] for x, y in (word.split(",") for word in text.split())]
    except ValueError:
        no_file = ", and there is no such file" if option == "--lesion" else ""
        raise typer.BadParameter(f'"{text}" is not "x,y x,y ..."{no_file}', param_hint=option) from None
