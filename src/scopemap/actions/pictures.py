"""The frames of a run, read from its input again, and their small pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from scopemap.actions.inputs import is_camera_of, open_truth
from scopemap.errors import InputError
from scopemap.frame import Frame
from scopemap.io.run_folder import RunFolder
from scopemap.masking.mask_files import create_masks
from scopemap.masking.masker import Masker
from scopemap.report.frame_pictures import FramePictures
from scopemap.trajectory.trajectory import SKIPPED


def frames_again(run: Path, indices: set[int]) -> Iterator[Frame]:
    """Yield the frames with these numbers from the input of the run, as the run rectified and masked them.

    Raises `InputError` where the input is gone or gives another camera.
    """
    source = Path(RunFolder(run).provenance.get("input", ""))
    if not source.exists():
        raise InputError(f"the input {source} of the run {run} is not there any more")
    config, sequence = RunFolder(run).config, open_truth(run, source)
    if not is_camera_of(run, sequence):
        raise InputError(f"the input {source} of the run {run} gives another camera now")
    mask = Masker(config.mask, create_masks(config.mask, sequence.rectifier, sequence.source.masks))
    for frame in sequence.frames():
        if frame.index in indices:
            yield mask(frame)


def keep_pictures_again(run: Path) -> None:
    """Write the pictures of a run that kept none, from its input. Raises `InputError` where that is not possible."""
    frames, pictures = RunFolder(run).checked().frames, FramePictures(timed=False)
    for frame in frames_again(run, set(frames["index"][frames["status"] != SKIPPED].tolist())):
        pictures.put(frame.index, frame.rgb, frame.valid)
    pictures.save(run)
