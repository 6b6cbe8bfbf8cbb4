"""A folder with one video and true poses by frame number: what the data sets share that come as video."""

from __future__ import annotations

from collections.abc import Iterator
from math import log
from pathlib import Path

import numpy as np

from scopemap.cameras.camera import CameraModel
from scopemap.cameras.formats.calibration import Calibration, fitted
from scopemap.cameras.formats.reading import stated_calibration
from scopemap.errors import InputError
from scopemap.frame import TruthQuality
from scopemap.io.images import OWN_CALIBRATION
from scopemap.io.source import SourceDefaults, SourceFrame, SourceTruth
from scopemap.io.video import VideoFile

# Even a frame that repeats the one before it takes more, with its entry in the file's index.
_SMALLEST_FRAME_BYTES = 16


class PosedVideo(SourceDefaults):
    """One view of a folder's video, with `poses` by frame number, which a reader fills in; no depth.

    path : the folder. video : the file. aspect : width over height of one view, of which the video may hold two, above
    or beside each other, the left one first; None: the whole image. A frame's time stamp is its number over the
    video's rate, so that it is known before anything is decoded. `camera.yaml` in the folder is its calibration.
    Where the header claims more frames than the file has room for, `count` is None.

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
        self.poses: dict[int, np.ndarray] = {}
        claimed, size = self._video.count, video.stat().st_size
        if claimed is not None and claimed > size / _SMALLEST_FRAME_BYTES:
            self._video.count = None
            self.warnings.append(
                f"{video.name} claims {claimed} frames, for which its {size} bytes have no room: its number of frames "
                "is unknown, and so is a true trajectory before it is read"
            )
        self.count = self._video.count
        own = path / OWN_CALIBRATION
        if own.is_file():
            self._use_calibration(stated_calibration(own, (self.width, self.height)))

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames of the view, decoded in order."""
        for frame in self._video.frames(selection):
            rgb = np.ascontiguousarray(frame.rgb[: self.height, : self.width])
            yield SourceFrame(frame.index, frame.index / self._video.rate_hz, rgb)

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return number and time of the selected frames, as the header counts; None without poses or count."""
        if self.count is None or not self.poses:
            return None
        return [(number, number / self._video.rate_hz) for number in range(self.count)[selection]]

    def pose(self, index: int) -> np.ndarray | None:
        """Return the frame's pose, or None where it has none."""
        return self.poses.get(index)

    def truth(self, index: int) -> SourceTruth | None:
        """Return the pose, without depth; None where the frame has none."""
        pose = self.pose(index)
        return None if pose is None else SourceTruth(pose, None, self.quality)

    def _set_camera(self, camera: CameraModel, file: Path) -> None:
        """Take `camera`, read from `file`, brought to the size of the view."""
        stated = Calibration(camera, None, f"calibration of the data set, {file.name}", file=file)
        calibration = fitted(stated, (self.width, self.height), "scale")
        self.camera, self.camera_source = calibration.camera, calibration.source

    def _beyond(self) -> int:
        return sum(self.count is not None and number >= self.count for number in self.poses)


def videos_in(path: Path, suffix: str) -> list[Path]:
    """Return the videos with this suffix in a folder, none where it is no folder; no hidden files."""
    files = path.iterdir() if path.is_dir() else ()
    found = (file for file in files if file.suffix.lower() == suffix and not file.name.startswith("."))
    return sorted(file for file in found if file.is_file())


def only_video(path: Path, videos: list[Path], what: str) -> Path:
    """Return the only one of `videos`; `InputError`, with `what` the folder should hold, for another number."""
    if len(videos) != 1:
        found = ", ".join(file.name for file in videos[:3]) or "none"
        raise InputError(f"reading {path}: {what}, found {len(videos)} ({found})")
    return videos[0]


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
