"""Opening an input: which data set it is, which camera took it, which size to work at."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.rectification import Rectifier, StereoPair, working_camera, working_size
from scopemap.engine.config import InputSettings
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.input.camera_files.calibration import Calibration, fitted
from scopemap.input.camera_files.pair import NEEDS_PAIR, read_pair
from scopemap.input.camera_files.reading import read_calibration
from scopemap.input.datasets.colmap import ColmapFolder
from scopemap.input.datasets.dicom import Dicom
from scopemap.input.datasets.rosbag import RosBag
from scopemap.input.decoding import most_pixels
from scopemap.input.frame_choice import FrameChoice, selection_text, slice_of
from scopemap.input.images import ImageFolder
from scopemap.input.pair_check import check_pair
from scopemap.input.plugins import plugins
from scopemap.input.prepared import UNKNOWN_MAKE, of_one_view, prepared
from scopemap.input.sampling import SAMPLED_EVERY, SampledPair
from scopemap.input.scopes import SCOPES
from scopemap.input.sequence import Sequence
from scopemap.input.source import Source, assumed_camera
from scopemap.input.video import VideoFile

_OWN_KINDS: tuple[type[Source], ...] = (ColmapFolder, RosBag, Dicom, VideoFile, ImageFolder)
_OF_FILES = (RosBag.name, Dicom.name, VideoFile.name)
# Those that need no folder inside that of the input.
_WITHOUT_LAYOUT = (RosBag, Dicom, VideoFile, ImageFolder)
_IMAGES = "images"
VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".wmv", ".webm", ".ts", ".mts", ".m2ts")
_MOST_NAMED = 5
_PAIRS = 4  # of views are looked at
_USUAL_FOV_DEG = 70.0
_SMALLEST_SIDE_PX = 32  # OpenCV's `remap` ends at 32767
_LARGEST_SIDE_PX = 32_000
_LEAST_SEEN_SHARE = 0.05
_SEARCH_DEPTH = 5
_DEEPEST_CLOSED = 4
_MOST_FOLDERS = 500


@cache
def readers() -> dict[str, type[Source]]:
    """Return the readers by name, in the order in which `recognises` is called: those of plug-ins come first."""
    added = [kind for _, kinds in plugins("scopemap.readers") for kind in kinds]
    return {kind.name: kind for kind in (*added, *_OWN_KINDS)}


def open_sequence(
    path: Path | str,
    *,
    dataset: str | None = None,
    camera: Path | str | None = None,
    fov_deg: float | None = None,
    size: tuple[int, int] | None = None,
    frames: slice | str | None = None,
    settings: InputSettings | None = None,
) -> Sequence:
    """Return the frames of a video file, a folder of images or a data set's folder, rectified to a pinhole camera.

    Raises `InputError`, `CalibrationError` and `SettingsError`.

    Parameters
    ----------
    path : of the file or folder.
    dataset : name of the reader (`scopemap datasets list`; `rosbag:TOPIC` names the topic, too), None: the first that
        recognises it.
    camera : calibration file, or the numbers "fx fy cx cy [k1 k2 p1 p2 [k3]]", px of the input's pictures; None: the
        data set's own, else a pinhole by `fov_deg`.
    fov_deg : horizontal field of view of an unknown camera, degrees; None: that of the settings' `scope`, else 70,
        until a run estimates it.
    size : working size (width, height), px; None: by `settings.longest_side_px`.
    frames : which frames, by their positions in the input, a slice or "0:100:2"; None: those of the settings.
    settings : how the input is read, by default `Config().input`.
    """
    settings = settings or InputSettings()
    frames = _selection(settings.frames or None if frames is None else frames)
    if size is not None and not (isinstance(size, tuple | list) and len(size) == 2):
        raise InputError(f"the working size {str(size)[:80]!r} is invalid: give (width, height), such as (320, 256)")
    with _errors_of_the_system(path):
        reader = _reader(Path(path), dataset)
    sequence = sequence_of(reader, camera=camera, fov_deg=fov_deg, size=size, frames=frames, settings=settings)
    _check_count(sequence, reader)
    return sequence


def sequence_of(
    reader: Source,
    *,
    camera: Path | str | None = None,
    fov_deg: float | None = None,
    size: tuple[int, int] | None = None,
    frames: slice | None = None,
    settings: InputSettings | None = None,
) -> Sequence:
    """Return the frames of a reader as `open_sequence` returns those of a path."""
    settings = settings or InputSettings()
    with _errors_of_the_system(reader.path):
        reader.begin_at(frames or slice(None))
        source = _prepared(reader, settings, size)
    return _of_prepared(source, camera, fov_deg, size, frames or slice(None), settings)


def open_reader(path: Path | str, *, dataset: str | None = None, frames: slice | None = None) -> Source:
    """Return the frames of an input as in the file, for `sequence_of_sampled`; raises `InputError`.

    What may change within the input, such as the pictures' size, is as at the first of `frames`.
    """
    frames = _selection(frames)
    with _errors_of_the_system(path):
        reader = _reader(Path(path), dataset)
        reader.begin_at(frames)
        return reader


def sequence_of_sampled(
    reader: Source,
    pairs: list[SampledPair],
    *,
    camera: Path | str | None,
    frames: slice | None,
    settings: InputSettings,
) -> Sequence:
    """Return the frames of an `open_reader`, as `open_sequence` returns those of a path.

    pairs : what `sample_pairs` has returned of it, from which `settings` may have been chosen.
    """
    with _errors_of_the_system(reader.path):
        source = prepared(reader, settings, pairs=pairs)
    sequence = _of_prepared(source, camera, None, None, frames or slice(None), settings)
    _check_count(sequence, reader)
    return sequence


def _selection(frames: slice | str | None) -> slice:
    frames = slice_of(frames)
    if frames.step is not None and frames.step <= 0:
        raise InputError(f"selecting frames: the step must be positive, got {frames.step}")
    return frames


def _check_count(sequence: Sequence, reader: Source) -> None:
    """Raise `InputError` where fewer than two frames are selected; of a video only reading tells how many there are."""
    if sequence.count is not None and sequence.count < 2 and not isinstance(reader, VideoFile):
        frames = sequence.selection
        of = f" of its {reader.count}, by --frames {selection_text(frames)}" if frames != slice(None) else ""
        raise InputError(f"reading {sequence.path}: {sequence.count} frame(s) selected{of}, two are needed")


def _of_prepared(
    source: Source,
    camera: Path | str | None,
    fov_deg: float | None,
    size: tuple[int, int] | None,
    frames: slice,
    settings: InputSettings,
) -> Sequence:
    """Return the frames of what `prepared` returned."""
    with _errors_of_the_system(source.path):
        calibration, calibrated = _calibration_of(source, camera, fov_deg, settings)
    pair = _pair_of(source, camera, settings.camera_fit, frames) if settings.uses_both_views else None
    size_source = "chosen" if size is None else "given (--size)"
    size = size or working_size(source.width, source.height, settings.longest_side_px)
    working = f"the working size {size[0]}x{size[1]} px"
    if min(size) < _SMALLEST_SIDE_PX:
        raise InputError(f"{working} is too small: {_SMALLEST_SIDE_PX} px a side at least")
    if max(size) > _LARGEST_SIDE_PX or size[0] * size[1] > most_pixels():
        most = f"{_LARGEST_SIDE_PX} px a side and {most_pixels() / 1e6:g} million pixels at most"
        raise InputError(f"{working} is too large: {most}; give another by --size")
    size_source = f"{size[0]}x{size[1]} px {size_source} for input of {source.width}x{source.height} px"
    rectifier = Rectifier(calibration.camera, working_camera(calibration.camera, size))
    if (seen := float(rectifier.valid.mean())) < _LEAST_SEEN_SHARE:
        rest = f"{seen:.1%} of the picture remains without its distortion; check the distortion coefficients"
        raise CalibrationError(f"{calibration.name} is that of no lens: {rest}")
    return Sequence(
        source,
        source.path,
        rectifier,
        camera_source=calibration.source,
        size_source=size_source,
        calibrated=calibrated,
        focal_is_stated=fov_deg not in (None, _USUAL_FOV_DEG),
        selection=frames,
        depth_scale_mm=calibration.depth_scale_mm or source.depth_scale_mm,
        choice=FrameChoice(settings.fps, settings.skip_duplicates and source.name in UNKNOWN_MAKE),
        pair=pair,
    )


def open_source(path: Path | str, *, dataset: str | None = None, settings: InputSettings | None = None) -> Source:
    """Return the frames of an input as in the file, one view and field by `settings`; raises `InputError`."""
    with _errors_of_the_system(path):
        reader = _reader(Path(path), dataset)
        # Nothing is averaged in pictures as they are in the file.
        return _prepared(reader, settings or InputSettings(), (reader.width, reader.height))


def _prepared(reader: Source, settings: InputSettings, size: tuple[int, int] | None) -> Source:
    second = settings.second_view
    return prepared(reader, settings, None if second is None else _reader(second, None), size)


@contextmanager
def _errors_of_the_system(path: Path | str) -> Iterator[None]:
    try:
        yield
    except PermissionError as error:
        raise InputError(f"reading {error.filename or path}: no permission to look into it") from None
    except OSError as error:  # names that no file system allows, a share that is gone
        raise InputError(f"reading {error.filename or path}: {error.strerror or error}") from None


def _reader(path: Path, dataset: str | None) -> Source:
    dataset, _, part = (dataset or "").partition(":")
    if dataset and dataset not in readers():
        raise InputError(f"unknown data set '{dataset}': choose one of {', '.join(readers())}")
    if not path.is_dir() and not path.is_file():
        what = "it is no file and no folder" if path.exists() else "no such file or folder"
        raise InputError(f"reading {path}: {what}")
    closed = _closed_folders(path) if path.is_dir() else []
    path = _innermost(path, dataset) if path.is_dir() else path
    kind = dataset or next((name for name, kind in readers().items() if kind.recognises(path)), "")
    if not kind:
        _refuse_videos(path)
    kind = kind or ImageFolder.name
    if (kind not in _OF_FILES) if path.is_file() else kind == VideoFile.name:
        raise InputError(f"reading {path} as {kind}: it is a {'file' if path.is_file() else 'folder'}")
    if part and kind != RosBag.name:
        raise InputError(f"reading {path} as {kind}: only {RosBag.name}:TOPIC has something after a colon")
    within = next((folder for folder in closed if folder.is_relative_to(path)), None)
    if within is not None and readers()[kind] not in _WITHOUT_LAYOUT:
        raise InputError(f"reading {path}: no permission to look into {within}")
    reader = RosBag(path, part or None) if kind == RosBag.name else readers()[kind](path)
    reader.warnings += [f"left out: no permission to look into {folder}" for folder in closed[:_MOST_NAMED]]
    return reader


def _refuse_videos(folder: Path) -> None:
    """Raise `InputError` where a folder without images holds videos: one of them is meant."""
    if videos := sorted(file for file in folder.iterdir() if file.suffix.lower() in VIDEO_ENDINGS and file.is_file()):
        held = f"{len(videos)} video(s) ({_named([file.name for file in videos])})"
        raise InputError(f"reading {folder}: it holds {held} and no images; give one of them, such as {videos[0]}")


def _named(names: list[str]) -> str:
    return ", ".join(names[:_MOST_NAMED]) + ", ..." * (len(names) > _MOST_NAMED)


def _closed_folders(folder: Path) -> list[Path]:
    """Return the folders in `folder` without permission: whether they hold truth cannot be told."""
    if not _may_enter(folder):
        raise InputError(f"reading {folder}: no permission to look into it")
    level, closed = [folder], list[Path]()
    for _ in range(_DEEPEST_CLOSED):
        level = [inner for outer in level if _may_enter(outer) for inner in _folders_in(outer)][:_MOST_FOLDERS]
        closed += [inner for inner in level if not _may_enter(inner)]
    return closed


def _may_enter(folder: Path) -> bool:
    return os.access(folder, os.R_OK | os.X_OK)


def _innermost(path: Path, dataset: str) -> Path:
    """Return the folder in `path` that the reader `dataset` ("": any) recognises, `path` where none does."""
    if dataset:
        return _recognised_below(path, [readers()[dataset]]) or path
    others = [kind for kind in readers().values() if kind not in (RosBag, Dicom)]
    found = _recognised_below(path, others)
    is_alone = found is not None and found != path and found.name != _IMAGES
    if found is None or (is_alone and not any(k.recognises(found) for k in others if k not in _WITHOUT_LAYOUT)):
        found = _recognised_below(path, list(readers().values()))
    return found or path


def _recognised_below(path: Path, kinds: list[type[Source]]) -> Path | None:
    """Return the folder that one of `kinds` recognises, `path` or the only one some levels below it; or None.

    Images alone are found in a folder around them that holds nothing else, or in `images`. Raises `InputError` where
    there are several sequences of a data set.
    """
    level, alone = [path], True
    for _ in range(_SEARCH_DEPTH):
        alone = alone and len(level) == 1
        sought = kinds if alone else [kind for kind in kinds if kind not in (VideoFile, ImageFolder)]
        level = [folder for folder in level[:_MOST_FOLDERS] if _may_enter(folder)]
        found = [folder for folder in level if any(kind.recognises(folder) for kind in sought)]
        if len(found) > 1:
            names = _named([str(folder.relative_to(path)) for folder in found])
            raise InputError(f"reading {path}: it holds {len(found)} sequences ({names}); give one of them")
        if found:
            return found[0]
        inner = [inner for folder in level for inner in _folders_in(folder)]
        images = [folder for folder in inner if folder.name == _IMAGES]
        level = images if len(level) == len(images) == 1 else inner
    return None


def _folders_in(path: Path) -> list[Path]:
    """Return the folders in one, without hidden ones, the system's, and links to a folder around them."""
    with os.scandir(path) as entries:  # it knows folders without asking for each file
        found = [entry for entry in entries if entry.is_dir(follow_symlinks=False) or entry.is_symlink()]
        names = [entry.name for entry in found if os.path.isdir(entry)]  # a link may lead in a circle
    inner = (path / n for n in names if not n.startswith(".") and n not in ("lost+found", "__MACOSX"))
    return sorted(i for i in inner if not (i.is_symlink() and path.resolve().is_relative_to(i.resolve())))


def _pair_of(source: Source, file: Path | str | None, camera_fit: str, frames: slice) -> StereoPair | CalibrationError:
    """Return the cameras of both views, of a file or of that beside the images, or why they are not known.

    Some of the frames must fit them.
    """
    beside = None if source.calibration is None else source.calibration.file
    if (file or beside) is None:
        return CalibrationError(NEEDS_PAIR)
    try:
        pair = read_pair(Path(file or beside or ""), (source.width, source.height), camera_fit)
        samples = islice(source.frames(frames), 0, _PAIRS * SAMPLED_EVERY, SAMPLED_EVERY)
        if doubt := check_pair(pair, [(one.rgb, one.second) for one in samples if one.second is not None]):
            source.warnings.append(doubt)
    except CalibrationError as fault:
        return fault
    source.notes.append(f"stereo: depth is measured from both views: {pair.source}")
    return pair


def _calibration_of(
    source: Source, file: Path | str | None, fov_deg: float | None, settings: InputSettings
) -> tuple[Calibration, bool]:
    """Return the calibration, and whether the camera is known by it or only assumed."""
    size, camera_fit = (source.width, source.height), settings.camera_fit
    try:
        if file is not None:
            return read_calibration(file, size, camera_fit), True
        if source.calibration is not None:
            return fitted(source.calibration, size, camera_fit), True
    except CalibrationError as fault:
        raise CalibrationError(f"{fault}{of_one_view(source)}") from None
    if source.camera_fault is not None:
        raise source.camera_fault
    if camera_fit.startswith("crop"):
        nothing = f"there is no calibration file out of which to cut the images (--camera-fit {camera_fit})"
        raise CalibrationError(f"{nothing}: give the one that was made before they were cut (--camera)")
    unfitted = f" (no calibration file: --camera-fit {camera_fit} has no effect)" if camera_fit != "exact" else ""
    if source.camera is not None:
        return Calibration(source.camera, source.depth_scale_mm, source.camera_source + unfitted), True
    if settings.scope and fov_deg is None:
        prior = SCOPES[settings.scope]
        assumed = f"assumed: as of a {settings.scope}, fx {prior.focal:g} of the width ({prior.source}){unfitted}"
        return Calibration(assumed_camera(source, prior.focal * source.width), None, assumed), False
    known, fov_deg, option = ("assumed", _USUAL_FOV_DEG, "") if fov_deg is None else ("stated", fov_deg, " (--fov)")
    known = "assumed" if fov_deg == _USUAL_FOV_DEG else known
    if not 1 <= fov_deg <= 170:
        raise InputError(f"the horizontal field of view must be 1 to 170 deg, got {fov_deg:g}")
    focal_px = source.width / 2 / np.tan(np.radians(fov_deg) / 2)
    assumed = f"{known}: horizontal field of view {fov_deg:g} deg{option}{unfitted}"
    return Calibration(assumed_camera(source, float(focal_px)), None, assumed), False
