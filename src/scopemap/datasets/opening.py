"""Opening an input: which data set it is, which camera took it, which size to work at."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np

from scopemap.calibration import Calibration, read_calibration
from scopemap.datasets.c3vd import C3vdFolder
from scopemap.datasets.colmap import ColmapFolder
from scopemap.datasets.endomapper import EndoMapperSequence
from scopemap.datasets.endomapper_sim import EndoMapperSimFolder
from scopemap.datasets.endonerf import EndoNerfFolder
from scopemap.datasets.endoslam import EndoSlamFolder
from scopemap.datasets.hamlyn import HamlynFolder, HamlynTrackingFolder
from scopemap.datasets.images import ImageFolder
from scopemap.datasets.oneslam import OneSlamFolder
from scopemap.datasets.scared import ScaredKeyframe
from scopemap.datasets.scared_c import ScaredCKeyframe
from scopemap.datasets.sequence import Sequence, Source, assumed_camera
from scopemap.datasets.servct import ServCtFolder
from scopemap.datasets.sevenscenes import SevenScenesFolder
from scopemap.datasets.simcol import SimColFolder
from scopemap.datasets.stereomis import StereoMisFolder
from scopemap.datasets.tum import TumRgbdFolder
from scopemap.datasets.video import VideoFile
from scopemap.errors import InputError
from scopemap.rectification import Rectifier, working_camera, working_size

# Data sets of folders of images are ImageFolders.
Reader: TypeAlias = ScaredCKeyframe | ScaredKeyframe | EndoMapperSequence | StereoMisFolder | VideoFile | ImageFolder

_KINDS: tuple[type[Reader], ...] = (
    ScaredCKeyframe,
    ScaredKeyframe,
    HamlynFolder,
    HamlynTrackingFolder,
    EndoSlamFolder,
    SimColFolder,
    EndoMapperSequence,
    EndoMapperSimFolder,
    StereoMisFolder,
    C3vdFolder,
    EndoNerfFolder,
    ServCtFolder,
    SevenScenesFolder,
    TumRgbdFolder,
    OneSlamFolder,
    ColmapFolder,
    VideoFile,
    ImageFolder,
)
DATASETS: dict[str, type[Reader]] = {kind.name: kind for kind in _KINDS}
"""The readers by name, in the order in which they are asked whether they recognise an input."""

_SMALLEST_SIDE_PX = 32
_DEEPEST_NESTING = 3
_SEARCH_DEPTH = 2
_LEAVINGS = "__MACOSX"


def open_sequence(
    path: Path | str,
    *,
    dataset: str | None = None,
    camera: Path | str | None = None,
    fov_deg: float = 70.0,
    size: tuple[int, int] | None = None,
    frames: slice | None = None,
) -> Sequence:
    """Return the frames of a video file, a folder of images or a data set's folder, rectified to a pinhole camera.

    `dataset` names the reader (`DATASETS`), None: told from what lies there. The camera comes from the calibration
    file `camera`, else from the data set, else it is a pinhole with horizontal field of view `fov_deg`. `size` is the
    working size (width, height), px; None: the input's, divided by the smallest whole number that brings it to 400 px.
    `frames` selects positions in the input. Raises `InputError` and `CalibrationError`.
    """
    selection = slice(None) if frames is None else frames
    if selection.step is not None and selection.step <= 0:
        raise InputError(f"selecting frames: the step must be positive, got {selection.step}")
    source = _open_source(Path(path), dataset)
    calibration, calibrated = _calibration_of(source, camera, fov_deg)
    if size is None:
        size, size_source = working_size(source.width, source.height), "chosen"
    else:
        size_source = "given (--size)"
    if min(size) < _SMALLEST_SIDE_PX:
        raise InputError(
            f"the working size {size[0]}x{size[1]} px is too small: {_SMALLEST_SIDE_PX} px a side at least"
        )
    size_source = f"{size[0]}x{size[1]} px {size_source} for input of {source.width}x{source.height} px"
    rectifier = Rectifier(calibration.camera, working_camera(calibration.camera, size))
    sequence = Sequence(
        source,
        source.path,
        rectifier,
        camera_source=calibration.source,
        size_source=size_source,
        calibrated=calibrated,
        selection=selection,
        depth_scale_mm=calibration.depth_scale_mm or source.depth_scale_mm,
    )
    if sequence.count is not None and sequence.count < 2 and not isinstance(source, VideoFile):
        raise InputError(f"reading {source.path}: {sequence.count} frame(s) selected, two are needed")
    return sequence


def _open_source(path: Path, dataset: str | None) -> Reader:
    if dataset is not None and dataset not in DATASETS:
        raise InputError(f"unknown data set '{dataset}': choose one of {', '.join(DATASETS)}")
    if not path.exists():
        raise InputError(f"reading {path}: no such file or folder")
    try:
        path = _innermost(path, dataset) if path.is_dir() else path
    except PermissionError as error:
        raise InputError(f"reading {error.filename}: no permission to look into it") from None
    kind = dataset or next((name for name, kind in DATASETS.items() if kind.recognises(path)), "images")
    if (kind == VideoFile.name) != path.is_file():
        raise InputError(f"reading {path} as {kind}: it is a {'file' if path.is_file() else 'folder'}")
    return DATASETS[kind](path)


def _innermost(path: Path, dataset: str | None) -> Path:
    """Return the folder that the reader `dataset` recognises in `path`, `path` where none; None: that any reader does.

    Raises `InputError` where a folder holds several sequences of a data set.
    """
    if dataset is None:
        return _stepped_into(path, list(DATASETS.values()))
    found = _stepped_into(path, [DATASETS[dataset]])
    return found if DATASETS[dataset].recognises(found) else path


def _stepped_into(path: Path, kinds: list[type[Reader]]) -> Path:
    """Step into a folder that holds nothing but one folder, that keeps its frames in `images`, or one sequence only."""
    for _ in range(_DEEPEST_NESTING):
        if any(kind.recognises(path) for kind in kinds):
            return path
        inner = _folders_in(path)
        images = [folder for folder in inner if folder.name == "images"]
        if len(images or inner) != 1:
            return _only_sequence_below(path, kinds) or path
        path = (images or inner)[0]
    return path


def _only_sequence_below(path: Path, kinds: list[type[Reader]]) -> Path | None:
    """Return the one sequence of a data set in the folders below, or None; several are an error that names them."""
    kinds = [kind for kind in kinds if kind not in (VideoFile, ImageFolder)]
    level = _folders_in(path)
    for _ in range(_SEARCH_DEPTH):
        found = [folder for folder in level if any(kind.recognises(folder) for kind in kinds)]
        if len(found) > 1:
            names = ", ".join(str(folder.relative_to(path)) for folder in found[:5]) + (", ..." * (len(found) > 5))
            raise InputError(f"reading {path}: it holds {len(found)} sequences ({names}); give one of them")
        if found:
            return found[0]
        level = [inner for folder in level for inner in _folders_in(folder)]
    return None


def _folders_in(path: Path) -> list[Path]:
    folders = (folder for folder in path.iterdir() if folder.is_dir())
    return sorted(folder for folder in folders if not folder.name.startswith(".") and folder.name != _LEAVINGS)


def _calibration_of(source: Source, file: Path | str | None, fov_deg: float) -> tuple[Calibration, bool]:
    """Return the calibration, and whether the camera is known by it or only assumed."""
    if file is not None:
        return read_calibration(file, (source.width, source.height)), True
    if source.camera_fault is not None:
        raise source.camera_fault
    if source.camera is not None:
        return Calibration(source.camera, source.depth_scale_mm, source.camera_source), True
    if not 1 <= fov_deg <= 170:
        raise InputError(f"the horizontal field of view must be 1 to 170 deg, got {fov_deg:g}")
    focal_px = source.width / 2 / np.tan(np.radians(fov_deg) / 2)
    assumed = f"assumed: horizontal field of view {fov_deg:g} deg (--fov)"
    return Calibration(assumed_camera(source, float(focal_px)), None, assumed), False
