"""A folder with one video and true poses by frame number: what the data sets share that come as video."""

from __future__ import annotations

from collections.abc import Iterator
from math import log
from pathlib import Path

import numpy as np

from scopemap.engine.errors import InputError
from scopemap.engine.frame import TruthQuality
from scopemap.input.images import use_first_calibration
from scopemap.input.source import OWN_CALIBRATION, Source, SourceFrame
from scopemap.input.video import VideoFile

# Even a frame that repeats the one before it takes more, with its entry in the file's index.
_SMALLEST_FRAME_BYTES = 16


class PosedVideo(Source):
    """One view of a folder's video, with `poses` by frame number, which a reader fills in; no depth.

    videos : its one file. aspect : width over height of one view, of which the video may hold two, the left one above
    or first; None: the whole image. A time stamp is the frame's number over the video's rate. Where the header claims
    more frames than the file has room for, `count` is None. `InputError` for a video that cannot be read,
    `CalibrationError` for a `camera.yaml` that does not fit.
    """

    quality: TruthQuality = "kinematic"

    def __init__(self, path: Path, videos: list[Path], aspect: float | None = None) -> None:
        super().__init__(path)
        if len(videos) != 1:
            found = ", ".join(file.name for file in videos[:3]) or "none"
            raise InputError(f"reading {path}: a folder of {self.name} holds one video, found {len(videos)} ({found})")
        video = videos[0]
        self._video = VideoFile(video)
        self.width, self.height, view = _view(self._video.width, self._video.height, aspect)
        self.pixel_aspect = self._video.pixel_aspect
        self.notes = [f"time stamps: frame number / {self._video.rate_hz:g} s", f"the view used: {view}"]
        self.warnings = self._video.warnings
        self.rate_hz, self.count = self._video.rate_hz, self._video.count
        if self.count is not None and self.count > video.stat().st_size / _SMALLEST_FRAME_BYTES:
            self.warnings.append(f"{video.name} claims {self.count} frames, for which it has no room: count unknown")
            self.count = self._video.count = None
        self.numbers = None if self.count is None else range(self.count)
        use_first_calibration(self, path / OWN_CALIBRATION)

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames of the view, decoded in order."""
        for frame in self._video.frames(selection):
            rgb = np.ascontiguousarray(frame.rgb[: self.height, : self.width])
            yield SourceFrame(frame.index, self._time_s(frame.index), rgb)

    def stamps(self, selection: slice) -> list[tuple[int, float]] | None:
        """Return number and time of the selected frames, as the header counts; None without poses or count."""
        return super().stamps(selection) if self.poses else None

    def _warn_of_poses_beyond(self, file: Path) -> None:
        beyond = sum(self.count is not None and number >= self.count for number in self.poses)
        if beyond:
            what = f"{beyond} of {len(self.poses)} poses belong to frames beyond the {self.count} of the video"
            self._warn(f"{file}: {what}; poses may belong to other frames")


def videos_in(path: Path, suffix: str) -> list[Path]:
    """Return the videos with this suffix in a folder, none where it is no folder; no hidden files."""
    files = path.iterdir() if path.is_dir() else ()
    found = (file for file in files if file.suffix.lower() == suffix and not file.name.startswith("."))
    return sorted(file for file in found if file.is_file())


def _view(width: int, height: int, aspect: float | None) -> tuple[int, int, str]:
    """Return size and name of the view whose aspect comes nearest; the three differ by factors of two."""
    views = [(width, height, "the whole image")]
    if aspect is None or min(width, height) < 2:
        return views[0]
    views += [(width, height // 2, "left, the upper half"), (width // 2, height, "left, the left half")]
    return min(views, key=lambda view: abs(log(view[0] / (view[1] * aspect))))
