"""The formats of `scopemap export`: what each is written to, and in which units and axes.

Nothing is loaded of a format that is not written: the help of the command reads the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

from scopemap.engine.errors import InputError, SettingsError

if TYPE_CHECKING:
    from scopemap.apps.export.surfaces import Axes
    from scopemap.input.trajectory.trajectory import Unit
    from scopemap.result.result import Result

    Write = Callable[[Result, Path, Unit, Axes], None]


@dataclass(frozen=True)
class ExportFormat:
    """A format: how it is written, its possible units and axes, the default first, and the ending of its file.

    Without an ending it is a folder, or, where `write_file` is there, that file if the name is a file's. `is_text`:
    programs recognise it by its content, so that any ending will do that is not of another format. `of_frames`: it
    holds all frames, whichever segment they are in, not the main surface.
    """

    write: Write
    units: tuple[Unit, ...]
    axes: tuple[Axes, ...] = ("opencv",)
    ending: str = ""
    is_text: bool = False
    write_file: Write | None = None
    of_frames: bool = False


def _by(function: str, *needs: Literal["unit", "axes"]) -> Write:
    """Return what calls a function of this package, MODULE.NAME, with result, path, and of unit and axes what it needs.

    Its module is loaded by the call.
    """

    def write(run: Result, out: Path, unit: Unit, axes: Axes) -> None:
        module, _, name = function.partition(".")
        given = {"unit": unit, "axes": axes}
        getattr(import_module(f"scopemap.apps.export.{module}"), name)(run, out, *(given[need] for need in needs))

    return write


# Files of poses without numbers, in a folder of their format.
_UNNUMBERED = {"kitti": "poses.txt", "endogslam": "pose.txt"}
_ANY_AXES: tuple[Axes, ...] = ("lps", "ras", "opencv", "gltf")
FORMATS: dict[str, ExportFormat] = {
    "nerfstudio": ExportFormat(_by("image_layouts.write_nerfstudio"), ("m",), of_frames=True),
    "colmap": ExportFormat(_by("image_layouts.write_colmap", "unit"), ("mm", "m"), of_frames=True),
    "endogslam": ExportFormat(_by("image_layouts.write_endogslam"), ("mm",), of_frames=True),
    "endonerf": ExportFormat(_by("image_layouts.write_endonerf"), ("mm",), of_frames=True),
    "tum": ExportFormat(
        _by("trajectories.write_tum_file", "unit"), ("m", "mm"), ending=".txt", is_text=True, of_frames=True
    ),
    "kitti": ExportFormat(
        _by("trajectories.write_kitti_folder", "unit"),
        ("m", "mm"),
        is_text=True,
        write_file=_by("trajectories.write_kitti_file", "unit"),
        of_frames=True,
    ),
    "euroc": ExportFormat(_by("trajectories.write_euroc_file"), ("m",), ending=".csv", is_text=True, of_frames=True),
    "ply": ExportFormat(_by("surfaces.write_surface", "unit", "axes"), ("mm", "m"), _ANY_AXES, ".ply"),
    "surfaces": ExportFormat(_by("surfaces.write_surfaces", "unit", "axes"), ("mm", "m"), _ANY_AXES, of_frames=True),
    "obj": ExportFormat(_by("surfaces.write_surface", "unit", "axes"), ("mm", "m"), _ANY_AXES, ".obj"),
    "stl": ExportFormat(_by("surfaces.write_surface", "unit", "axes"), ("mm", "m"), _ANY_AXES, ".stl"),
    "glb": ExportFormat(_by("surfaces.write_glb"), ("m",), ("gltf",), ".glb"),
    "slicer": ExportFormat(_by("surfaces.write_slicer"), ("mm",), ("lps",)),
    "pointcloud": ExportFormat(_by("points.write_points", "unit"), ("mm", "m"), ending=".ply"),
    "gaussians": ExportFormat(_by("points.write_gaussians", "unit"), ("mm", "m"), ending=".ply"),
    "mcap": ExportFormat(_by("mcap_bag.write_mcap"), ("m",), ending=".mcap", of_frames=True),
    "dicom": ExportFormat(_by("dicom_stl.write_dicom_stl", "unit", "axes"), ("mm", "m"), ("lps",), ".dcm"),
}
_NO_TEXT = {form.ending for form in FORMATS.values() if form.ending and not form.is_text}
# Of files; other names with a point in them, such as exam.2, may be folders'.
_FILE_ENDINGS = _NO_TEXT | {
    *(".txt", ".csv", ".tum", ".kitti", ".json", ".yaml", ".yml", ".xml", ".html", ".npz", ".npy", ".bin", ".db"),
    *(".zip", ".tar", ".gz", ".tgz", ".png", ".jpg", ".mp4"),
}


def export_run(
    folder: Path,
    name: str,
    out: Path,
    unit: Unit | None = None,
    axes: Axes | None = None,
    *,
    source: Path | None = None,
) -> str:
    """Write the run in `folder` as the format with this name, and return what is known of its scale, in words.

    unit, axes : None for the format's own. source : where the run's input is now; else it is looked for. Frames that
    are lost or in another submap are left out. Lengths are in mm by the reference that was set by hand, where one is
    kept and gives the scale of what is written (`in_mm`). Raises `SettingsError` for units and axes that the format
    does not have, `InputError` where `out` is there already, cannot be written, or the run lacks what it needs.
    """
    from scopemap.report.reference_scale import in_mm
    from scopemap.result.result import Result

    form = FORMATS[name]
    for option, given, possible in (("units", unit, form.units), ("axes", axes, form.axes)):
        if given is not None and given not in possible:
            raise SettingsError(f"--{option} {given}: {name} has {' or '.join(possible)}")
    form = _named(form, name, out)
    if out.is_file() or (out.is_dir() and (form.ending or any(out.iterdir()))):
        raise InputError(f"{out} exists; give another name with --out")
    whole = Result(folder, source).checked(with_poses=True)
    run = in_mm(whole, None if form.of_frames else whole.main_segment)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # An export that fails or is stopped leaves nothing.
        with TemporaryDirectory(dir=out.parent, prefix=".unfinished-") as place:
            unfinished = Path(place) / out.name
            form.write(run, unfinished, unit or form.units[0], axes or form.axes[0])
            beside = [path for path in Path(place).iterdir() if path != unfinished]
            for path in beside:
                if (out.parent / path.name).exists():
                    raise InputError(f"{out.parent / path.name} exists; give another name with --out")
            if out.is_dir():
                out.rmdir()
            for path in [*beside, unfinished]:
                path.rename(out.parent / path.name)
    except OSError as error:
        raise InputError(f"cannot write {out}: {error.strerror or error}") from None
    return run.scale


def frames_of_lines(folder: Path, name: str, out: Path) -> str:
    """Return which frames the lines of an export's file of poses belong to; "" where their numbers, or names, say so.

    folder, name, out : as of `export_run`.
    """
    if name not in _UNNUMBERED:
        return ""
    from scopemap.apps.export.trajectories import lines_in_words
    from scopemap.result.result import Result

    return lines_in_words(Result(folder), out / _UNNUMBERED[name] if out.is_dir() else out)


def _named(form: ExportFormat, name: str, out: Path) -> ExportFormat:
    """Return the format as a file where `out` is a file's name and it has one; `InputError` for a name of another."""
    ending = out.suffix.lower()
    if form.is_text and (form.ending or (form.write_file and ending in _FILE_ENDINGS)):
        if ending in _NO_TEXT:
            raise InputError(f"cannot write {out}: {ending} is the ending of another format than {name}, give .txt")
        return replace(form, write=form.write_file or form.write, ending=ending or form.ending)
    if not form.ending and ending in _FILE_ENDINGS:
        raise InputError(f"cannot write {out}: {name} is a folder of files; give --out a name without {ending}")
    if form.ending and ending != form.ending:
        raise InputError(f"cannot write {out}: its name must end in {form.ending}")
    return form
