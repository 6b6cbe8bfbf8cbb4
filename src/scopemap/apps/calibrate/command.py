"""`scopemap calibrate`: the camera from a video of a checkerboard or a ChArUco board."""

from __future__ import annotations

import os
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from scopemap.engine.errors import InputError, SettingsError
from scopemap.terminal import options
from scopemap.terminal.figures import print_json, print_table
from scopemap.terminal.progress import count_progress

if TYPE_CHECKING:
    from scopemap.apps.calibrate.camera_calibration import CameraCalibration
    from scopemap.apps.calibrate.targets import Target
    from scopemap.engine.config import InputSettings

# All else about the input is for runs: the camera is not known yet, and frames are chosen by --frames and --every.
_SETTINGS = ("input.stereo", "input.deinterlace")


def calibrate(
    source: Annotated[Path, typer.Argument(metavar="INPUT", help="Video or folder of images of the board.")],
    board: Annotated[
        str,
        typer.Option(metavar="CxR", help="Size of the board: inner corners, such as 9x6; for a ChArUco board squares."),
    ],
    square_mm: Annotated[float, typer.Option(help="Side of a square, mm.")],
    charuco: Annotated[
        bool, typer.Option("--charuco", help="Use a ChArUco board, with markers in its white squares.")
    ] = False,
    marker_mm: Annotated[float | None, typer.Option(help="Side of a ChArUco board's marker, mm.")] = None,
    dictionary: Annotated[
        str | None, options.advanced(metavar="NAME", help="OpenCV's name of the ChArUco markers; default: DICT_4X4_50.")
    ] = None,
    legacy: Annotated[bool, options.advanced("--legacy", help="Use the ChArUco layout of OpenCV before 4.6.")] = False,
    model: Annotated[
        Literal["auto", "pinhole", "fisheye"],
        typer.Option(help="Camera model; auto: the one that predicts held-out views best."),
    ] = "auto",
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE", help="Calibration file to write; a picture of its residuals is written beside it."
        ),
    ] = Path("calibration.yaml"),
    frames: options.Frames = None,
    every: Annotated[
        int | None, options.advanced(min=1, metavar="N", help="Use every N-th frame; default: about 300 in all.")
    ] = None,
    dataset: options.Dataset = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help=f"How pictures are read: {_SETTINGS[0]}=..., {_SETTINGS[1]}=on."
        ),
    ] = None,
    overwrite: options.Overwrite = False,
    as_json: options.AsJson = False,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate the camera from images of a board.

    Every command takes the file that this writes as --camera.
    """
    picture = out.with_suffix(".png")
    options.check_output(out, (".yaml", ".yml"), overwrite)
    options.check_output(picture, (".png",), overwrite)
    if not os.access(out.parent, os.W_OK):
        raise InputError(f"writing the calibration: the folder {out.parent} is not there or not writable")
    target = _board(board, square_mm, charuco=charuco, marker_mm=marker_mm, dictionary=dictionary, legacy=legacy)
    reading = _reading(settings or [])
    # Imported here, so that --help does not wait for it.
    from scopemap.apps.calibrate import camera_calibration
    from scopemap.apps.calibrate.residual_picture import draw_calibration
    from scopemap.apps.calibrate.targets import find_views
    from scopemap.input.opening import open_source
    from scopemap.result.wording import in_words

    silent = quiet or as_json
    pictures = open_source(source, dataset=dataset, settings=reading)
    with count_progress("looking for the board", "looked at", silent=silent) as listener:
        search = find_views(pictures, target, frames, every, listener)
    if not silent:
        typer.echo(f"the board was found in {len(search.views)} of {search.looked_at} frames; fitting", err=True)
    done = camera_calibration.calibrate(search, target, model)
    camera_calibration.save_calibration(done, out)
    draw_calibration(done, picture)
    for note in [] if silent else pictures.notes:
        typer.echo(f"note: {in_words(note)}", err=True)
    for warning in [] if quiet else [*pictures.warnings, *done.warnings]:
        typer.echo(f"warning: {in_words(warning)}", err=True)
    if as_json:
        looked = {"looked_at": search.looked_at, "every": search.every, "found": len(search.views)}
        places = {"calibration": str(out), "picture": str(picture), "board": target.described}
        print_json(places | looked | done.summary())
    elif not quiet:
        _print(done)
        typer.echo(f"calibration: {out} (use it as --camera {out}); picture: {picture}")


def _reading(pairs: list[str]) -> InputSettings:
    from scopemap.engine.config import Config

    chosen = options.parse_settings(pairs)
    other = [key for key in chosen if key not in _SETTINGS]
    if other:
        raise SettingsError(f"the setting '{other[0]}' has no part in a calibration: only {' and '.join(_SETTINGS)} do")
    return Config.load(settings=chosen).input


def _board(
    text: str, square_mm: float, *, charuco: bool, marker_mm: float | None, dictionary: str | None, legacy: bool
) -> Target:
    from scopemap.apps.calibrate.targets import CharucoBoard, Checkerboard

    columns, rows = options.parse_board(text)
    if charuco and marker_mm is None:
        raise SettingsError("a ChArUco board needs the side of its markers: give --marker-mm")
    if charuco and marker_mm is not None:
        return CharucoBoard(columns, rows, square_mm, marker_mm, dictionary or "DICT_4X4_50", legacy)
    if marker_mm is not None or dictionary is not None or legacy:
        raise SettingsError("--marker-mm, --dictionary and --legacy are for a ChArUco board: give --charuco, too")
    return Checkerboard(columns, rows, square_mm)


def _print(done: CameraCalibration) -> None:
    facts = done.summary()
    forms = {"frame": "", "name": "", "corners": "", "rms_px": ".3f", "tilt_deg": ".0f", "distance_mm": ".1f"}
    views = [[format(view[key], form) for key, form in forms.items()] for view in facts["views"]]
    print_table(("frame", "name"), views, numbers=("corners", "error (px RMS)", "tilt (deg)", "distance (mm)"))
    values = [(name, f"{facts['parameters'][name]:.5g}", f"{sd:.2g}") for name, sd in facts["deviations"].items()]
    print_table(("camera",), values, numbers=("value", "standard deviation"))
    for out in facts["left_out"]:
        typer.echo(f"left out: frame {out['frame']}, {out['reason']}")
    typer.echo(f"left out besides: {len(done.blurred)} blurred view(s), and views that show what another one shows")
    typer.echo(
        f"model: {done.fit.form.described}; {done.fit.rms_px:.3f} px RMS over {len(done.views)} views, which cover "
        f"{100 * done.coverage:.0f} % of the picture"
    )
    tried = sorted(done.held_out_px.items(), key=lambda item: item[1])
    errors = [f"{form.described} " + (f"{error:.3f} px" if error < inf else "impossible") for form, error in tried]
    typer.echo("error in held-out views: " + "; ".join(errors))
