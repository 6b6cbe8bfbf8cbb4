"""What is used of each picture: boxes blackened first; then one view and one field of it, as set or detected."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from scopemap.engine.cameras.rectification import working_size
from scopemap.engine.config import InputSettings
from scopemap.engine.config.input import Box
from scopemap.engine.errors import CalibrationError, InputError
from scopemap.engine.notices import Notice
from scopemap.input.images import ImageFolder, use_first_calibration
from scopemap.input.sampling import SampledPair
from scopemap.input.source import Source, SourceFrame
from scopemap.input.video import VideoFile
from scopemap.input.video_format.interlacing import deinterlaced, is_interlaced, is_shortly_after
from scopemap.input.video_format.stereo_packing import Packing, packing, squeezed_views, suspected

UNKNOWN_MAKE = ("video", "images", "dicom")
"""Readers without a data set: stereo packing and interlacing are detected, repeated frames are skipped."""

OF_UNKNOWN_VIEWS = (*UNKNOWN_MAKE, "rosbag", "live")
"""Readers for which `input.stereo` may name the stereo packing; other data sets define their view."""

_SAMPLES = 8
_FEWEST_SAMPLES = 2
_SAMPLES_BYTES = 100_000_000
# Attributes and methods of a source that are the same for one view of it.
_KEPT = (
    "name", "width", "height", "pixel_aspect", "count", "numbers", "stamped", "rate_hz", "notes", "warnings",
    "frame_limit_s", "left_out", "resized", "quality", "depth_scale_mm", "depth_sensor", "masks", "stamps", "media",
    "entry", "pose", "truth", "picture_files",
)  # fmt: skip
_LEFT = {"left-right": "the left half", "top-bottom": "the upper half"}


def prepared(
    source: Source,
    settings: InputSettings,
    second: Source | None = None,
    size: tuple[int, int] | None = None,
    pairs: list[SampledPair] | None = None,
) -> Source:
    """Return the source with boxes blackened, one view and one field per picture; the source itself where it is so.

    With `stereo` = auto, the packing is detected in videos and folders of images of no data set, and with `deinterlace`
    = auto, whether they are interlaced. Both views are kept where they are used; `second` holds the right one where it
    is another file. size : working size (width, height), px; None: by the settings. pairs : what `sample_pairs` has
    returned of the source, None: it is called.
    Raises `InputError` where `stereo` names the views of a data set, whose reader defines them, where there are no two
    views to be used, and for a box outside of the pictures.
    """
    if (settings.layout in _LEFT or settings.uses_both_views) and source.name not in OF_UNKNOWN_VIEWS:
        defines = f"the reader of the data set '{source.name}' defines the view"
        raise InputError(f"reading {source.path}: {defines}; leave input.stereo={settings.stereo} (--stereo) out")
    for box in settings.redact:
        if box[0] >= source.width or box[1] >= source.height:
            outside = f"is outside of the pictures of {source.width}x{source.height} px"
            named = f"the box {','.join(map(str, box))} to blacken (--redact, X,Y,WIDTH,HEIGHT)"
            raise InputError(f"reading {source.path}: {named} {outside}")
    if source.name not in UNKNOWN_MAKE:
        pairs = []
    elif pairs is None:
        pairs = sample_pairs(source)
    pairs = [(redacted(rgb, settings.redact), redacted(later, settings.redact)) for rgb, later in pairs]
    packed, note = _packing(source, settings, [rgb for rgb, _ in pairs])
    one_field = _uses_one_field(source, settings, packed, pairs, size)
    if note:
        source.notes.append(note)
    if second is not None:
        _check_second(source, second)
    elif settings.uses_both_views and packed is None:
        remedy = "give use:left-right, use:top-bottom or use:FILE, the right camera's video or folder"
        raise InputError(f"reading {source.path}: --stereo use finds no two views in its pictures; {remedy}")
    if packed is None and second is None and not (one_field or settings.redact):
        return source
    return PreparedSource(source, packed, settings, second, one_field=one_field)


class PreparedSource(Source):
    """A source of which a part of each picture is used, of the views `packed` the left eye's; None: one view.

    Frames carry the right eye's view, too, where the settings use it: that of `packed`, or of `second`. one_field :
    odd rows are interpolated.
    """

    def __init__(
        self,
        source: Source,
        packed: Packing | None,
        settings: InputSettings,
        second: Source | None = None,
        *,
        one_field: bool = False,
    ) -> None:
        self._source, self.packed, self._settings, self._second = source, packed, settings, second
        self._one_field = one_field
        super().__init__(source.path)
        for attribute in _KEPT:
            setattr(self, attribute, getattr(source, attribute))
        if settings.redact:
            self.notes.append(f"redacted: {len(settings.redact)} box(es) of each picture are black (input.redact)")
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
        others = iter(()) if self._second is None else self._second.frames(selection)
        other = next(others, None)
        for frame in self._source.frames(selection):
            while other is not None and other.index < frame.index:
                other = next(others, None)
            rgb, right = self._used(frame.rgb), None
            if self.packed is not None:
                rgb, right = self.packed.views(rgb)
                right = right if self._settings.uses_both_views else None
            elif other is not None and other.index == frame.index:
                right = self._used(other.rgb)
            yield replace(frame, rgb=rgb, second=right)

    def _used(self, rgb: np.ndarray) -> np.ndarray:
        rgb = redacted(rgb, self._settings.redact)
        return deinterlaced(rgb) if self._one_field else rgb


def _uses_one_field(
    source: Source,
    settings: InputSettings,
    packed: Packing | None,
    pairs: list[SampledPair],
    size: tuple[int, int] | None,
) -> bool:
    """Return whether one field of each picture is used, and let the source say so, or that it is interlaced.

    At a working size of half the height or less a pixel holds rows of both fields, so that nothing is gained.
    """
    if settings.deinterlace == "on":
        source.notes.append(Notice("input-deinterlaced", {"why": "as asked"}))
    if settings.deinterlace == "on" or not shows_two_fields(source, pairs):
        return settings.deinterlace == "on"
    width, height = (source.width, source.height) if packed is None else packed.view_size(source.width, source.height)
    used = size or working_size(width, height, settings.longest_side_px)
    if height >= 2 * used[1]:
        source.notes.append(Notice("input-interlaced-averaged"))
        return False
    if settings.deinterlace == "off":
        source.warnings.append(Notice("input-interlaced"))
        return False
    source.notes.append(Notice("input-deinterlaced", {"why": "the video is interlaced"}))
    return True


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


def shows_two_fields(source: Source, pairs: list[SampledPair]) -> bool:
    """Return whether the pictures of a source are interlaced, by pairs from `sample_pairs`."""
    # Those of a folder may be some of a video only, too far apart to tell anything of time.
    is_video = isinstance(source, VideoFile)
    later = [after if is_video or is_shortly_after(rgb, after) else None for rgb, after in pairs]
    return is_interlaced([rgb for rgb, _ in pairs], later)


def sample_pairs(source: Source) -> list[SampledPair]:
    """Return a few pictures from all parts of the input, fewer where they are large, each with the next other one."""
    picture_bytes = max(1, 3 * source.width * source.height)
    count = max(_FEWEST_SAMPLES, min(_SAMPLES, _SAMPLES_BYTES // picture_bytes))
    found: list[SampledPair] = []
    warnings = len(source.warnings)
    # Errors and warnings here may concern frames that the run does not read; it reports those that it meets.
    with suppress(InputError):
        found.extend(source.sample_pairs(count))
    del source.warnings[warnings:]
    source.left_out.clear()
    source.resized.clear()
    return found


def _check_second(source: Source, second: Source) -> None:
    """Let `source` tell what is found in the right view; `InputError` where its pictures have another size."""
    sizes = [f"{one.width}x{one.height} px" for one in (source, second)]
    if sizes[0] != sizes[1]:
        raise InputError(f"reading {second.path}: the right view's pictures are {sizes[1]}, the left one's {sizes[0]}")
    source.notes.append(f"stereo: the right view is {second.path}, its frames paired by their numbers")
    if source.count != second.count:
        source.warnings.append(f"stereo: {source.count} frames of the left view, {second.count} of the right one")
    second.warnings = source.warnings


def _packing(source: Source, settings: InputSettings, samples: list[np.ndarray]) -> tuple[Packing | None, str]:
    """Return the stereo packing, None for one view, and a note about it or ""."""
    width, height, aspect = source.width, source.height, source.pixel_aspect
    packed, why, shape = None, "as asked", suspected(width, height, aspect)
    if settings.layout in ("left-right", "top-bottom"):
        packed = Packing(settings.layout, squeezed_views(width, height, settings.layout, aspect), float("nan"))
    elif settings.layout == "auto" and (packed := packing(samples, aspect)) is not None:
        why = f"the halves correlate by {packed.correlation:.2f}; --stereo none (input.stereo) uses the whole picture"
    elif settings.stereo == "use" and shape is not None:
        packed, why = Packing(shape, squeezed_views(width, height, shape, aspect), float("nan")), "by their shape"
    if packed is not None:
        pixels = "twice as wide" if packed.layout == "left-right" else "half as wide"
        squeezed = f", of pixels that are {pixels} as the picture has them" if packed.squeezed else ""
        use = "left view, the other one the right" if settings.uses_both_views else "used"
        return packed, f"stereo, {packed.layout}: {_LEFT[packed.layout]} of each picture is {use}{squeezed}: {why}"
    if shape is None or settings.layout != "auto" or not samples:
        return None, ""
    return None, (
        f"stereo: pictures of {width}x{height} px have the shape of two views, {shape}, but their halves do not show "
        f"the same; used as one view (--stereo {shape} uses {_LEFT[shape]})"
    )
