"""Opens a data set for its truth as a run read it: same size, same view of a stereo picture, same camera."""

from __future__ import annotations

from pathlib import Path

from scopemap.cameras.camera import PinholeCamera
from scopemap.config import Config, InputSettings
from scopemap.errors import CalibrationError, InputError, SettingsError
from scopemap.io.opening import open_sequence, open_source
from scopemap.io.prepared import OF_UNKNOWN_VIEWS
from scopemap.io.run_folder import RunFolder
from scopemap.io.sequence import Sequence

_SAME_CAMERA_PX = 0.01


def open_truth(run: Path, truth: Path) -> Sequence:
    """Return the data set in `truth`, rectified as the run in folder `run` rectified its input.

    The camera is the data set's own. Where that is unknown, does not fit or is not the run's, it is the camera that the
    run kept, so that depth is compared pixel by pixel. `run` may be any folder or file: what it does not state is taken
    from the data set. Raises as `open_sequence`.
    """
    camera, settings = _camera_of(run), _input_settings(run)
    size = None if camera is None else (camera.width, camera.height)
    if settings.stereo != "auto" and open_source(truth).name not in OF_UNKNOWN_VIEWS:
        settings = settings.model_copy(update={"stereo": "auto"})  # a data set's reader chooses the view
    kept = RunFolder(run).source_camera_file
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


def _camera_of(run: Path) -> PinholeCamera | None:
    """Return the working camera of a run, whose size its depth maps have; None where it is unknown."""
    try:
        return RunFolder(run).camera
    except InputError:
        return None


def _input_settings(run: Path) -> InputSettings:
    """Return how the run read its input, but for skipped frames: the truth is needed for every frame number."""
    file = run / "config.toml"
    try:
        settings = Config.load(file=file).input if file.is_file() else InputSettings()
    except SettingsError:  # of another version
        settings = InputSettings()
    return settings.model_copy(update={"fps": None, "skip_duplicates": False})
