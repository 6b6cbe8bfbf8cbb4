"""A folder with one video and true poses by frame number: what the data sets share that come as video."""

from __future__ import annotations

from collections.abc import Iterator
from math import log
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.formats.calibration import check_plausible, fitted_to, rescaled_note
from scopemap.cameras.formats.reading import stated_calibration
from scopemap.frame import TruthQuality
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth
from scopemap.io.video import VideoFile

_OWN_CALIBRATION = "camera.yaml"
# Even a picture that repeats the one before it takes more, with its place in the file's tables.
_SMALLEST_FRAME_BYTES = 16


class PosedVideo(SourceDefaults):
    """One view of a folder's video, with the poses that a data set fills in; no depth.

    path : the folder. video : the file. aspect : width over height of one view, of which the video may hold two, above
    or beside each other, the left one first; None: the whole image. A frame's time stamp is its number over the
    video's rate, so that it is known before anything is decoded. `camera.yaml` in the folder is its calibration.
    A header that claims more frames than the file has room for is not believed: `count` is None then.

    Raises `InputError` for a video that cannot be read, `CalibrationError` for a calibration that does not fit.
    """

    quality: TruthQuality = "kinematic"

    def __init__(self, path: Path, video: Path, aspect: float | None = None) -> None:
        self.path = path
        self._video = VideoFile(video)
        self.width, self.height, view = _view(self._video.width, self._video.height, aspect)
        self.pixel_aspect = self._video.pixel_aspect
        self.notes = [f"time stamps: frame number / {self._video.rate_hz:g} s", f"the view used: {view}"]
        self.warnings = self._video.warnings
        self.count = self._believed_count(video)
        self.poses: dict[int, np.ndarray] = {}
        own = path / _OWN_CALIBRATION
        if own.is_file():
            self._use_calibration(stated_calibration(own, (self.width, self.height)))

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames of the view, decoded in order."""
        for frame in self._video.frames(selection):
            rgb = np.ascontiguousarray(frame.rgb[: self.height, : self.width])
            yield SourceFrame(frame.index, self._time_s(frame.index), rgb)

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return number and time of the selected frames, as the header counts; None without poses or count."""
        if self.count is None or not self.poses:
            return None
        return [(number, self._time_s(number)) for number in range(self.count)[selection]]

    def pose(self, index: int) -> np.ndarray | None:
        """Return the frame's pose, or None where it has none."""
        return self.poses.get(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return the pose, without depth; None where the frame has none."""
        pose = self.pose(index)
        return None if pose is None else SourceTruth(pose, None, self.quality)

    def _believed_count(self, video: Path) -> int | None:
        """Return the header's count of frames, None (for the video, too) where the file has no room for so many."""
        claimed, size = self._video.count, video.stat().st_size
        if claimed is not None and claimed > size / _SMALLEST_FRAME_BYTES:
            self._video.count = None
            self.warnings.append(
                f"{video.name} claims {claimed} frames, for which its {size} bytes have no room: how many it holds is "
                "not known, nor a true trajectory before it is read"
            )
        return self._video.count

    def _calibrate(self, camera: CameraModel, file: Path) -> None:
        """Take `camera`, read from `file`, brought to the size of the view."""
        fitted = fitted_to(camera, (self.width, self.height), str(file))
        check_plausible(fitted, f"the calibration {file}")
        self.camera = fitted
        self.camera_source = f"calibration of the data set, {file.name}{rescaled_note(camera, fitted)}"

    def _time_s(self, index: int) -> float:
        return index / self._video.rate_hz


def _view(width: int, height: int, aspect: float | None) -> tuple[int, int, str]:
    """Return size and name of the view whose aspect comes nearest; the three differ by factors of two."""
    views = [
        (width, height, "the whole image"),
        (width, height // 2, "left, the upper half"),
        (width // 2, height, "left, the left half"),
    ]
    if aspect is None or min(width, height) < 2:
        return views[0]
    return min(views, key=lambda view: abs(log(view[0] / (view[1] * aspect))))
