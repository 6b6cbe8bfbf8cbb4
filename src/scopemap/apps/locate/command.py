"""`scopemap locate`: the frames of another video in the map of a result."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scopemap.terminal import options
from scopemap.terminal.figures import print_json


def locate(
    run: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder of a run.")],
    path: options.Input,
    out: Annotated[Path, typer.Option(metavar="FILE", help="CSV table to write: one row with a pose for each frame.")],
    camera: options.CameraFile = None,
    camera_fit: options.CameraFit = None,
    dataset: options.Dataset = None,
    frames: options.Frames = None,
    source: options.InputNow = None,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the frames of another video in the map of a result.

    Without --camera, the camera of the result is used.
    """
    options.check_output(out, (".csv",), overwrite)
    import numpy as np

    from scopemap.apps.locate import locate as locating
    from scopemap.result.result import Result
    from scopemap.terminal.progress import count_progress

    options.warn_of_damage(run, silent=quiet)
    result = Result(run, source).checked()
    found, sequence = [], locating.open_other(result, path, camera, dataset, frames, camera_fit)
    with count_progress("locating", "located", silent=quiet or as_json) as show:
        for one in locating.locate(result, sequence):
            found.append(one)
            if show is not None:
                show(len(found), sequence.count)
    locating.write_located(found, out)
    inliers = [one.inliers for one in found if one.status != locating.NOT_FOUND]
    facts = {"frames": len(found), "found": len(inliers), "inliers": float(np.median(inliers or [0])), "out": str(out)}
    if as_json:
        print_json(facts)
    elif not quiet:
        median = f", by {facts['inliers']:.0f} features (median)" if inliers else ""
        typer.echo(f"camera: {sequence.camera_source}")
        typer.echo(f"{out}: {len(inliers)} of {len(found)} frames found{median}")
