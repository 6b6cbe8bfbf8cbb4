"""The sequence of rectified frames that everything above works on, and reading them ahead of their use."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from collections.abc import Sequence as Numbers
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Literal, TypeVar

from scopemap.engine.cameras.camera import CameraModel, PinholeCamera
from scopemap.engine.cameras.lenses import FisheyeCamera
from scopemap.engine.cameras.rectification import Rectifier, StereoPair, working_camera
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.engine.frame import Frame, Truth
from scopemap.engine.notices import Notice
from scopemap.input.frame_choice import FrameChoice, selection_text
from scopemap.input.source import SkippedFrame, Source, SourceFrame, assumed_camera

CameraOrigin = Literal["calibrated", "stated", "estimated", "assumed"]
_Item = TypeVar("_Item")
_END = object()
_MOST_ASPECT = 0.05  # by hand: share by which fx and fy differ, of pixels that are nearly square


@dataclass(frozen=True)
class Sequence:
    """Frames of one input, rectified to a pinhole camera of the working size, with their truth where it is known.

    Iterating yields `(Frame, Truth | None)`; frames are decoded one at a time, and it may be iterated again. Raises
    `InputError` at the end where fewer than two frames could be read.

    Attributes
    ----------
    source, path : where the frames come from; its file or folder.
    rectifier : from the source's camera to the working camera.
    camera_source, size_source : how the camera is known, and where the working size comes from, one phrase each.
    calibrated : whether the camera is known; False: assumed, `with_focal` may better it.
    focal_is_stated : whether a field of view other than the assumed one was given. is_estimated : whether `with_focal`
        found it.
    selection : slice over the input's frames.
    depth_scale_mm : mm per unit of the input's depth files by its calibration, or None.
    focal_sigma_px : standard deviation of an estimated focal length at the working size, None where none is known.
    choice : which of the selected frames are left out.
    pair : the cameras of both views that each frame carries, or why they are not known; None where it carries one.
    """

    source: Source
    path: Path
    rectifier: Rectifier
    camera_source: str
    size_source: str
    calibrated: bool
    focal_is_stated: bool = False
    is_estimated: bool = False
    selection: slice = field(default_factory=lambda: slice(None))
    depth_scale_mm: float | None = None
    focal_sigma_px: float | None = None
    choice: FrameChoice = field(default_factory=FrameChoice)
    pair: StereoPair | CalibrationError | None = None

    @property
    def name(self) -> str:
        """The input's own name: of its file or folder."""
        return self.path.stem if self.path.is_file() else self.path.name

    @property
    def camera(self) -> PinholeCamera:
        """The working camera, which every frame carries."""
        return self.rectifier.target

    @property
    def camera_origin(self) -> CameraOrigin:
        """How the camera is known: by a calibration, the stated field of view, an estimate, or not at all."""
        if self.calibrated:
            return "calibrated"
        return "estimated" if self.is_estimated else "stated" if self.focal_is_stated else "assumed"

    @cached_property
    def depth_rectifier(self) -> Rectifier:
        """From the depth files beside the frames to the working camera."""
        sensor = self.source.depth_sensor
        return self.rectifier if sensor is None else Rectifier(self.rectifier.source, self.camera, sensor)

    @property
    def count(self) -> int | None:
        """Number of selected frames, skipped ones too, by a video's header; None where only reading on would tell."""
        return None if self.source.count is None else len(range(*self.selection.indices(self.source.count)))

    @property
    def numbers(self) -> Numbers[int] | None:
        """Numbers of all frames of the input, selected or not, by a video's header; None where they are unknown."""
        count = self.source.count
        return self.source.numbers if self.source.numbers is not None else None if count is None else range(count)

    @property
    def used_count(self) -> int | None:
        """About how many frames are used: those selected, thinned by the header's rate; repeats show on the way."""
        rate_hz = self.source.rate_hz / (self.selection.step or 1)
        share = 1.0 if self.choice.fps is None else min(1.0, self.choice.fps / rate_hz)
        return None if self.count is None else math.ceil(share * self.count)

    @property
    def skipped(self) -> list[SkippedFrame]:
        """The selected frames that were left out so far, as `choice` has it or for their size, in order."""
        return [frame for _, frame in sorted((self.choice.skipped | self.source.left_out).items())]

    @property
    def notes(self) -> list[str | Notice]:
        """What had to be assumed about the input."""
        assumed = [] if self.calibrated else [Notice("camera-assumed", {"source": self.camera_source})]
        return [*self.source.notes, *assumed]

    @property
    def _lens_doubts(self) -> list[Notice]:
        """That the focal lengths across and down differ by more than those of real cameras."""
        lens = self.rectifier.source.central
        share = abs(lens.fx / lens.fy - 1)
        return [Notice("camera-aspect", {"share": share, "fx": lens.fx, "fy": lens.fy})] if share > _MOST_ASPECT else []

    @property
    def warnings(self) -> list[str | Notice]:
        """What was found wrong while reading, so far."""
        return [*self.source.warnings, *self.source.size_notices, *self._lens_doubts]

    def __iter__(self) -> Iterator[tuple[Frame, Truth | None]]:
        """Yield each frame, rectified, with its truth."""
        for frame in self._rectified(self.source.frames(self.selection), -1):
            if (truth := self.source.truth(frame.index)) is None:
                yield frame, None
                continue
            depth_mm = None if truth.depth_mm is None else self.depth_rectifier.nearest(truth.depth_mm)
            yield frame, Truth(frame.index, truth.T_world_camera, depth_mm, truth.quality)

    def frames(self, after: int = -1) -> Iterator[Frame]:
        """Yield each frame, rectified; its truth is not read. Raises `InputError` at the end of fewer than two.

        The frames end with a warning where a picture does not come in time. after : number of a frame; it and those
        before are read, so that the choice of later ones stays the same, but not yielded.
        """
        return self._rectified(self._in_time(), after)

    def _rectified(self, pictures: Iterable[SourceFrame], after: int) -> Iterator[Frame]:
        found = 0
        for item in self.choice(pictures):
            if item.index > after:
                rgb, valid = self.rectifier.image(item.rgb), self.rectifier.valid
                views = None if item.second is None else (item.rgb, item.second)
                yield Frame(item.index, item.time_s, rgb, self.camera, valid, name=item.name, views=views)
            found += 1
        self.source.check_sizes(found + len(self.choice.skipped))
        if found < 2:
            skipped = "".join(f"; frame {frame.index} {frame.reason}" for frame in self.skipped[-1:])
            remedy = "; a higher input.fps or input.skip_duplicates=false uses more" * bool(skipped)
            few = f"{found} readable frame(s){self._selected_of}, two are needed"
            raise InputError(f"reading {self.path}: {few}{skipped}{remedy}")

    @property
    def _selected_of(self) -> str:
        """What an error about too few frames adds: the selection, where there is one, and how many frames there are."""
        if self.selection == slice(None):
            return ""
        of = "" if self.source.count is None else f" of its {self.source.count} frames, 0 to {self.source.count - 1}"
        return f" in the selection {selection_text(self.selection)}{of}"

    def _in_time(self) -> Iterator[SourceFrame]:
        """Yield the selected pictures until one does not come in time."""
        pictures, limit_s = iter(self.source.frames(self.selection)), self.source.frame_limit_s
        if limit_s is None or not isinstance(pictures, Generator):
            yield from pictures
            return
        # Pictures that are passed over are decoded, too.
        step_s, start_s, read, last = self.selection.step or 1, abs(self.selection.start or 0), 0, -1
        try:
            for picture in _in_time(pictures, limit_s + start_s, limit_s + step_s):
                yield picture
                read, last = read + 1, picture.index
        except _HangingError as error:
            which = f"picture after frame {last}" if read else "first picture"
            late = f"{self.path}: its {which} did not come within {error}: a decoder or a disk hangs"
            if read < 2:
                raise InputError(f"reading {late}") from None
            self.source.warnings.append(f"{late}; the frames until then were used")

    def with_focal(
        self,
        focal_px: float,
        source: str,
        sigma_px: float | None = None,
        fisheye: tuple[float, ...] = (),
        *,
        is_estimated: bool = True,
    ) -> Sequence:
        """Return the sequence with another guess of an unknown camera.

        `focal_px` is the horizontal focal length at the working size, `sigma_px` its standard deviation where one is
        known; `source` says how it is known. `fisheye` : coefficients of a `FisheyeCamera`; none: a pinhole.
        is_estimated : False: still assumed. Raises `CalibrationError` where the camera is known.
        """
        if self.calibrated:
            raise CalibrationError(f"the focal length of {self.path} is known ({self.camera_source}); it stays")
        camera: CameraModel = assumed_camera(self.source, focal_px * self.source.width / self.camera.width)
        if fisheye:
            camera = FisheyeCamera(camera.central, fisheye)
        target = working_camera(camera, (self.camera.width, self.camera.height))
        changed = replace(self, rectifier=Rectifier(camera, target), camera_source=source, is_estimated=is_estimated)
        return replace(changed, focal_sigma_px=sigma_px)


class _HangingError(Exception):
    """A picture has not come in time."""


def _in_time(
    pictures: Generator[SourceFrame, None, None], first_s: float, next_s: float
) -> Generator[SourceFrame, None, None]:
    """Yield pictures, read in a thread; `_HangingError` where one takes longer than so many seconds."""
    asked, found = SimpleQueue[bool](), SimpleQueue[SourceFrame | BaseException | None]()

    def answer() -> None:
        while asked.get():
            try:
                found.put(next(pictures, None))
            except BaseException as error:
                found.put(error)
        pictures.close()

    reader, limit_s, hangs = Thread(target=answer, name="read", daemon=True), first_s, False
    reader.start()
    try:
        while True:
            asked.put(True)
            try:
                picture = found.get(timeout=limit_s)
            except Empty:
                hangs = True
                raise _HangingError(f"{limit_s:g} s") from None
            if picture is None:
                return
            if isinstance(picture, BaseException):
                raise picture
            yield picture
            limit_s = next_s
    finally:
        asked.put(False)
        if not hangs:
            reader.join()


def in_thread(items: Iterable[_Item], thread: str, count: int = 2) -> Generator[_Item, None, None]:
    """Yield items in order, computed in a thread of their own, at most `count` ahead of their use.

    thread : its name. An error of an item is raised where the item would come. Closed early, the thread ends after the
    item that it computes.
    """
    source = iter(items)
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix=thread)
    try:
        coming = deque(worker.submit(next, source, _END) for _ in range(count))
        while (item := coming.popleft().result()) is not _END:
            coming.append(worker.submit(next, source, _END))
            yield item  # type: ignore[misc]
    finally:
        worker.shutdown(cancel_futures=True)
        if hasattr(source, "close"):
            source.close()
