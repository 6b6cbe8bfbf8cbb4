"""What is used of each picture: boxes blackened first; then one view and one field of it, as set or detected."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from scopemap.config import InputSettings
from scopemap.config.input import Box
from scopemap.errors import CalibrationError, InputError
from scopemap.io.images import ImageFolder, use_first_calibration
from scopemap.io.source import Source, SourceFrame
from scopemap.io.video import VideoFile
from scopemap.io.video_format.interlacing import deinterlaced, is_interlaced
from scopemap.io.video_format.stereo_packing import Packing, packing, squeezed_views, suspected
from scopemap.notices import Notice

UNKNOWN_MAKE = ("video", "images", "dicom")
"""Readers without a data set: stereo packing and interlacing are detected, repeated frames are skipped."""

OF_UNKNOWN_VIEWS = (*UNKNOWN_MAKE, "rosbag", "live")
"""Readers for which `input.stereo` may name the stereo packing; other data sets define their view."""

_SAMPLES, _SAMPLED_EVERY = 8, 10
_FEWEST_SAMPLES, _SAMPLES_BYTES = 2, 100_000_000
# Attributes and methods of a source that are the same for one view of it.
_KEPT = (
    *("name", "width", "height", "pixel_aspect", "count", "numbers", "stamped", "rate_hz", "notes", "warnings"),
    "frame_limit_s",
    *("quality", "depth_scale_mm", "depth_sensor", "masks", "stamps", "media", "pose", "truth"),
)
_LEFT = {"left-right": "the left half", "top-bottom": "the upper half"}


def prepared(source: Source, settings: InputSettings) -> Source:
    """Return the source with boxes blackened, one view and one field per picture; the source itself where it is so.

    With `stereo` = auto, the packing is detected in videos and folders of images of no data set; a warning names
    interlaced ones. Raises `InputError` where `stereo` names the views of a data set, whose reader defines them, and
    for a box outside of the pictures.
    """
    if settings.stereo in _LEFT and source.name not in OF_UNKNOWN_VIEWS:
        defines = f"the reader of the data set '{source.name}' defines the view"
        raise InputError(f"reading {source.path}: {defines}; leave input.stereo={settings.stereo} (--stereo) out")
    for box in settings.redact:
        if box[0] >= source.width or box[1] >= source.height:
            outside = f"is outside of the pictures of {source.width}x{source.height} px"
            named = f"the box {','.join(map(str, box))} to blacken (--redact, X,Y,WIDTH,HEIGHT)"
            raise InputError(f"reading {source.path}: {named} {outside}")
    samples = sample_pictures(source) if source.name in UNKNOWN_MAKE else []
    samples = [redacted(rgb, settings.redact) for rgb in samples]
    packed, note = _packing(source, settings, samples)
    if not settings.deinterlace and is_interlaced(samples):
        source.warnings.append(Notice("input-interlaced"))
    if note:
        source.notes.append(note)
    if packed is None and not (settings.deinterlace or settings.redact):
        return source
    return PreparedSource(source, packed, settings)


class PreparedSource(Source):
    """A source of which a part of each picture is used, of the views `packed` the left eye's; None: one view."""

    def __init__(self, source: Source, packed: Packing | None, settings: InputSettings) -> None:
        self._source, self.packed, self._settings = source, packed, settings
        super().__init__(source.path)
        for attribute in _KEPT:
            setattr(self, attribute, getattr(source, attribute))
        if settings.redact:
            self.notes.append(f"redacted: {len(settings.redact)} box(es) of each picture are black (input.redact)")
        if settings.deinterlace:
            self.notes.append("deinterlaced: the even rows of each picture are used, the odd ones interpolated")
        if packed is not None:
            self.width, self.height = packed.view_size(source.width, source.height)
            self.pixel_aspect *= packed.pixel_aspect
        if packed is None:
            self.calibration, self.camera, self.camera_source = source.calibration, source.camera, source.camera_source
            self.camera_fault = source.camera_fault
        elif source.calibration is not None and source.calibration.file is not None:
            # Without a size of its own, the file beside the images is for one view; any other camera is of both.
            try:
                use_first_calibration(self, Path(source.calibration.file))
            except CalibrationError as fault:
                self.camera_fault = fault
        elif isinstance(source, ImageFolder):
            self.camera_fault = source.camera_fault  # of that file

    def frames(self, selection: slice) -> Iterator[SourceFrame]:
        """Yield the selected frames, each with what is used of its picture."""
        for frame in self._source.frames(selection):
            rgb = redacted(frame.rgb, self._settings.redact)
            rgb = deinterlaced(rgb) if self._settings.deinterlace else rgb
            yield replace(frame, rgb=rgb if self.packed is None else self.packed.first(rgb))


def redacted(rgb: np.ndarray, boxes: tuple[Box, ...]) -> np.ndarray:
    """Return a picture (h, w, 3) with black boxes; the picture itself without any."""
    if not boxes:
        return rgb
    rgb = rgb.copy()
    for x, y, width, height in boxes:
        rgb[y : y + height, x : x + width] = 0
    return rgb


def of_one_view(source: Source) -> str:
    """Return what an error about a camera of another size adds where pictures hold two views, else ""."""
    if not isinstance(source, PreparedSource) or source.packed is None:
        return ""
    one = f"the camera must be that of one, {source.width}x{source.height} px"
    return f"; the pictures hold two views, and {one} (--stereo none uses the whole picture)"


def sample_pictures(source: Source) -> list[np.ndarray]:
    """Return a few pictures from all parts of the input, fewer where they are large: all are held at once."""
    picture_bytes = max(1, 3 * source.width * source.height)
    count = max(_FEWEST_SAMPLES, min(_SAMPLES, _SAMPLES_BYTES // picture_bytes))
    found: list[np.ndarray] = []
    warnings = len(source.warnings)
    # Errors and warnings here may concern frames that the run does not read; it reports those that it meets.
    with suppress(InputError):
        if isinstance(source, VideoFile):
            found.extend(source.samples(count))
        else:
            step = max(1, (source.count or 0) // count) if isinstance(source, ImageFolder) else _SAMPLED_EVERY
            found.extend(frame.rgb for frame in islice(source.frames(slice(0, None, step)), count))
    del source.warnings[warnings:]
    return found


def _packing(source: Source, settings: InputSettings, samples: list[np.ndarray]) -> tuple[Packing | None, str]:
    """Return the stereo packing, None for one view, and a note about it or ""."""
    width, height, aspect = source.width, source.height, source.pixel_aspect
    packed, why = None, "as asked"
    if settings.stereo in ("left-right", "top-bottom"):
        packed = Packing(settings.stereo, squeezed_views(width, height, settings.stereo, aspect), float("nan"))
    elif settings.stereo == "auto" and (packed := packing(samples, aspect)) is not None:
        why = f"the halves correlate by {packed.correlation:.2f}; --stereo none (input.stereo) uses the whole picture"
    if packed is not None:
        pixels = "twice as wide" if packed.layout == "left-right" else "half as wide"
        squeezed = f", of pixels that are {pixels} as the picture has them" if packed.squeezed else ""
        return packed, f"stereo, {packed.layout}: {_LEFT[packed.layout]} of each picture is used{squeezed}: {why}"
    layout = suspected(width, height, aspect) if settings.stereo == "auto" and samples else None
    if layout is None:
        return None, ""
    return None, (
        f"stereo: pictures of {width}x{height} px have the shape of two views, {layout}, but their halves do not show "
        f"the same; used as one view (--stereo {layout} uses {_LEFT[layout]})"
    )
