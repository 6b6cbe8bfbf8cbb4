"""Opens the input of a run again, or a data set for its truth: same size, view of a stereo picture, camera, masks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.config import Config, InputSettings
from scopemap.engine.errors import CalibrationError, InputError, SettingsError
from scopemap.engine.frame import Frame
from scopemap.engine.masking.masker import Masker
from scopemap.input.decoding import read_decoded
from scopemap.input.mask_files import masks_of
from scopemap.input.opening import open_sequence, open_source
from scopemap.input.prepared import OF_UNKNOWN_VIEWS
from scopemap.input.sequence import Sequence
from scopemap.input.trajectory.trajectory import SKIPPED
from scopemap.report.frame_pictures import WHOLLY_USABLE, FramePictures
from scopemap.result.result import Result
from scopemap.result.run_input import find_input
from scopemap.runner.texturing import read_again

_SAME_CAMERA_PX = 0.01
_MOST_ENLARGED = 1.25
"""Size of the frames over that of the pictures which a run kept, 320 px wide at most."""


def open_truth(run: Path, truth: Path, frames: str = "") -> Sequence:
    """Return the data set in `truth`, rectified as the run in folder `run` rectified its input.

    The camera is the data set's own. Where that is unknown, does not fit or is not the run's, it is the camera that the
    run kept, so that depth is compared pixel by pixel. `run` may be any folder or file: what it does not state is taken
    from the data set. frames : which ones, as `--frames` has them, by default all. Raises as `open_sequence`.
    """
    camera, settings = _camera_of(run), _input_settings(run).model_copy(update={"frames": frames})
    size = None if camera is None else (camera.width, camera.height)
    if settings.stereo != "auto" and open_source(truth).name not in OF_UNKNOWN_VIEWS:
        settings = settings.model_copy(update={"stereo": "auto"})  # a data set's reader chooses the view
    kept = Result(run).source_camera_file
    try:
        sequence = open_sequence(truth, size=size, settings=settings)
    except CalibrationError:
        if kept is None:
            raise
    else:
        if kept is None or (sequence.calibrated and is_camera_of(run, sequence)):
            return sequence
    exact = settings.model_copy(update={"camera_fit": "exact"})
    return open_sequence(truth, camera=kept, size=size, settings=exact)


def is_camera_of(run: Path, sequence: Sequence) -> bool:
    """Whether the working camera of a run is that of the sequence; raises `InputError` where the run's is unknown."""
    camera = _camera_of(run)
    if camera is None:
        raise InputError(f"cannot read the camera of the run {run} from its provenance.json")
    return all(
        abs(getattr(camera, name) - getattr(sequence.camera, name)) <= _SAME_CAMERA_PX
        for name in ("fx", "fy", "cx", "cy")
    )


def open_input(run: Path, given: Path | None = None) -> tuple[Sequence, Masker]:
    """Return the input of a run, rectified as the run had it, and what masks its frames as the run did.

    given : where it is now; else it is looked for. Raises `InputError` as `find_input`, and where it gives another
    camera.
    """
    source, config = find_input(run, given), Result(run).config
    # The run's part alone: the rest of a long video need not be decoded, and may be of another size.
    sequence = open_truth(run, source, config.input.frames)
    if not is_camera_of(run, sequence):
        raise InputError(f"the input {source} of the run {run} gives another camera now")
    return sequence, Masker(config.mask, masks_of(config.mask, sequence))


def reread_frames(run: Path, indices: set[int], given: Path | None = None) -> Iterator[Frame]:
    """Yield the frames with these numbers from the input of the run, rectified and masked. Raises as `open_input`.

    Where the input is gone, and the run kept pictures of all these frames that need little enlarging, they are used.
    """
    try:
        sequence, mask = open_input(run, given)
    except InputError as fault:
        if given is not None:
            raise
        yield from _kept_frames(run, indices, fault)
        return
    left = indices.copy()
    for frame in sequence.frames():
        if frame.index in left:
            left.discard(frame.index)
            yield mask(frame)
        if not left:
            return


def sharp_picture(run: Path, index: int) -> np.ndarray | None:
    """Return the picture (H, W, 3) uint8 of a frame, rectified as the run's, at the resolution of the run's input.

    None where the input has no such frame any more. Raises as `open_input`.
    """
    sequence, _ = open_input(run)
    source, working = sequence.rectifier.source, sequence.camera
    enlarged = max(1.0, max(source.width, source.height) / max(working.width, working.height))
    size = round(enlarged * working.width), round(enlarged * working.height)
    for frame in read_again(sequence.source, sequence.selection, [index]):
        if frame.index == index:
            return np.asarray(sequence.rectifier.enlarged(*size).image(frame.rgb))
    return None


def tracked_frames(run: Result) -> Iterator[Frame]:
    """Yield the tracked frames of a run, or of one of its submaps, in order, as `reread_frames` has them.

    Raises `InputError` where the input is gone, or has not all of them any more.
    """
    missing = set(run.tracked["index"].tolist())
    for frame in reread_frames(run.folder, missing.copy(), run.input_path):
        missing.discard(frame.index)
        yield frame
    if missing:
        raise InputError(f"the input of the run {run.path} has no frame {min(missing)} any more")


def _kept_frames(run: Path, indices: set[int], fault: InputError) -> Iterator[Frame]:
    """Yield frames by the pictures that a run kept. Raises `fault` where these are smaller or of fewer frames."""
    folder = Result(run)
    kept = Result(run.parent.parent) if run.parent.name == "maps" else folder
    if missing := len(indices - set(kept.pictured)):
        raise InputError(f"{fault}; frames/ has no picture of {missing} of the {len(indices)} frames") from None
    camera = folder.camera
    for row in folder.frames.rows[np.isin(folder.frames["index"], list(indices))]:
        index = int(row["index"])
        picture, levels = read_decoded(kept.picture_file(index)), read_decoded(kept.mask_file(index))
        if picture is None or levels is None or camera.width > _MOST_ENLARGED * picture.shape[1]:
            raise InputError(f"{fault}; frames/ has no picture of frame {index} that is large enough") from None
        rgb = cv2.resize(picture, (camera.width, camera.height))[..., ::-1]
        mask = cv2.resize(levels, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        yield Frame(
            index, float(row["time_s"]), np.ascontiguousarray(rgb), camera, mask == WHOLLY_USABLE, name=str(row["name"])
        )


def keep_pictures_again(run: Path) -> None:
    """Write the pictures of a run that kept none, from its input. Raises `InputError` where that is not possible."""
    frames, pictures = Result(run).checked().frames, FramePictures(timed=False)
    indices, (sequence, mask) = set(frames["index"][frames["status"] != SKIPPED].tolist()), open_input(run)
    for frame in (mask(frame) for frame in sequence.frames() if frame.index in indices):
        pictures.put(frame.index, frame.rgb, frame.valid)
    pictures.save(run)


def _camera_of(run: Path) -> PinholeCamera | None:
    """Return the working camera of a run, whose size its depth maps have; None where it is unknown."""
    try:
        return Result(run).camera
    except InputError:
        return None


def _input_settings(run: Path) -> InputSettings:
    """Return how the run read its input, but for skipped frames: the truth is needed for every frame number."""
    file = run / "config.toml"
    try:
        settings = Config.load(file=file, unknown=[]).input if file.is_file() else InputSettings()
    except SettingsError:  # of another version
        settings = InputSettings()
    left = {"stereo": "none"} if settings.second_view else {}
    return settings.model_copy(update={"frames": "", "fps": None, "skip_duplicates": False} | left)
