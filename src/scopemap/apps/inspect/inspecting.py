"""The one pass over a video: frames are measured once, in order, of a long video short parts; few are kept."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scopemap.apps.inspect import checks
from scopemap.apps.inspect.burned_in import InsetWatcher, Overlay, OverlayWatcher
from scopemap.apps.inspect.clip import Clip, VideoFinding
from scopemap.apps.inspect.container import read_container
from scopemap.apps.inspect.field_shape import Field, FieldWatcher, ShareBox
from scopemap.apps.inspect.frame_measures import FrameInspector, InspectedFrame
from scopemap.engine.config import InputSettings
from scopemap.engine.errors import InputError, ScopemapError
from scopemap.engine.frame import Frame
from scopemap.input.opening import open_reader, sequence_of_sampled
from scopemap.input.prepared import OF_UNKNOWN_VIEWS, sample_pairs, shows_two_fields
from scopemap.input.sequence import Sequence, in_thread
from scopemap.input.source import SourceFrame
from scopemap.input.video_format.stereo_packing import Packing, packing
from scopemap.result.wording import in_words

_PARTS = 12  # by hand: 300 frames, in about 4 s, show what concerns a whole video
_FRAMES_OF_PART = 25  # by hand: a second of most videos, for what lasts
_KEPT = 8
_NAMED = 3
_ORDER = ("error", "warning", "info")


@dataclass(frozen=True)
class Inspection:
    """What was found in a video.

    path : the file or folder. size : of a picture (of one view, if there are two), px. clip : measures of the pictures
    that were read. container : facts in the file's header, or None. packed : layout of two views in a picture, or
    None. findings : worst first. samples : a few frames.
    """

    path: Path
    size: tuple[int, int]
    clip: Clip
    container: dict[str, Any] | None
    packed: Packing | None
    field: Field
    overlays: tuple[Overlay, ...]
    insets: tuple[ShareBox, ...]
    findings: tuple[VideoFinding, ...]
    samples: tuple[InspectedFrame, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """What the video is, and the usual shares of its pictures; what is not known is left out."""
        facts = (self.container or {}) | {
            "width": self.size[0],
            "height": self.size[1],
            "pictures": self.clip.count,
            "pictures_read": len(self.clip),
            "span_s": float(np.diff(self.clip["time_s"][[0, -1]])[0]),
            "usual_rate_hz": self.clip.rate_hz,
            "motion_per_frame_share": float(np.median(self.clip["motion"])),
            "motion_fastest_share": float(np.percentile(self.clip["motion"], 95)),
            "repeated": int(self.clip.repeats.sum()),
            "field": self.field.shape,
            "field_share": self.field.share,
            **checks.exposure_figures(self.clip),
        }
        return {name: value for name, value in facts.items() if value is not None}

    @property
    def forecast(self) -> str:
        """What a run can be expected to make of the video, in words."""
        return checks.forecast(self.clip)

    @property
    def report(self) -> dict[str, Any]:
        """All of it but the pictures, as JSON has it; boxes as left, top, right, bottom, shares of width and height."""
        return {
            "path": str(self.path),
            "facts": self.facts,
            "forecast": self.forecast,
            "findings": [asdict(finding) for finding in self.findings],
            "field": {"shape": self.field.shape, "share": self.field.share, "box": list(self.field.box)},
            "overlays": [asdict(overlay) for overlay in self.overlays],
            "insets": [list(box) for box in self.insets],
        }


def inspect(
    path: Path,
    *,
    dataset: str | None = None,
    camera: Path | None = None,
    frames: slice | None = None,
    listener: Callable[[int, int | None], None] | None = None,
) -> Inspection:
    """Read a video, a folder of images or a data set's folder and return what was found.

    Of more than 300 frames 12 parts of 25 are read, evenly spread; what lies between them is not seen. `dataset`,
    `camera` and `frames` as in `open_sequence`; `listener(pictures read, in all or None)` is called after each. Raises
    `InputError` and `CalibrationError` where it cannot be opened or holds fewer than two pictures.
    """
    sequence, packed, interlaced = _opened(path, dataset, camera, frames)
    media = sequence.source.media()
    container = None if media is None else read_container(media)
    field, overlays, insets, sampled = FieldWatcher(), OverlayWatcher(), InsetWatcher(), _Sampled()
    measures, stopped = [], ""
    due = None if sequence.count is None else sum(map(len, _parts(sequence)))
    try:
        for item in _inspected(sequence):
            for watcher in (field, overlays, insets, sampled):
                watcher.add(item)
            measures.append(item.measures)
            if listener is not None:
                listener(len(measures), due)
    except ScopemapError as error:
        stopped = str(error)
    if len(measures) < 2:
        found = stopped or f"{len(measures)} picture(s) could be read, two are needed"
        raise InputError(f"inspecting {sequence.path}: {found}")
    is_whole = due is None or due == sequence.count
    count = len(measures) if is_whole or sequence.count is None else sequence.count
    clip = Clip(tuple(measures), sequence.source.stamped, sequence.selection, count)
    size = sequence.source.width, sequence.source.height
    findings = [
        *([VideoFinding("error", "reading-stopped", stopped)] if stopped else []),
        *_of_source(list(map(in_words, sequence.warnings))),
        *checks.check_rate(clip),
        *checks.check_packing(packed, interlaced=interlaced),
        *checks.check_repeats(clip),
        *(finding for watcher in (field, overlays, insets) for finding in watcher.findings()),
        *([] if sequence.calibrated else checks.check_scope(field.field(), size, stereo=packed is not None)),
        *checks.check_frames(clip),
        *checks.check_dangers(clip),
    ]
    return Inspection(
        path=sequence.path,
        size=size,
        clip=clip,
        container=container,
        packed=packed,
        field=field.field(),
        overlays=tuple(overlays.overlays()),
        insets=tuple(insets.boxes()),
        findings=tuple(sorted(findings, key=lambda finding: _ORDER.index(finding.severity))),
        samples=tuple(sampled.kept),
    )


def _opened(
    path: Path, dataset: str | None, camera: Path | None, frames: slice | None
) -> tuple[Sequence, Packing | None, bool]:
    """Return the pictures as they are in the input, of two views the first; their layout; whether they have fields."""
    plain = InputSettings(stereo="none", skip_duplicates=False, deinterlace="off")
    # Whether there are two views comes first: the camera may be that of one.
    reader = open_reader(path, dataset=dataset, frames=frames)
    unknown = reader.name in OF_UNKNOWN_VIEWS  # the readers of data sets know what a picture holds
    pairs = sample_pairs(reader)
    packed = packing([rgb for rgb, _ in pairs], reader.pixel_aspect) if unknown else None
    settings = plain if packed is None else plain.model_copy(update={"stereo": packed.layout})
    sequence = sequence_of_sampled(reader, pairs, camera=camera, frames=frames, settings=settings)
    return sequence, packed, shows_two_fields(reader, pairs)


def _inspected(sequence: Sequence) -> Iterator[InspectedFrame]:
    """Yield the frames of the parts, measured, with their positions in the input.

    Unreadable images and damaged frames of a video have a position, too.
    """
    known = sequence.source.stamps(slice(None)) or []
    positions = {index: position for position, (index, _) in enumerate(known)}
    inspector = FrameInspector(frames_only_resize=sequence.rectifier.only_resizes)
    is_video = sequence.source.media() is not None
    # Decoding and measuring take about the same time.
    for part, number, item in in_thread(_read(sequence), "read"):
        rgb, valid = sequence.rectifier.image(item.rgb), sequence.rectifier.valid
        frame = Frame(item.index, item.time_s, rgb, sequence.camera, valid, name=item.name)
        place = item.index if is_video else positions.get(item.index, number)
        yield inspector(place, part, item.rgb, frame)


def _read(sequence: Sequence) -> Iterator[tuple[int, int, SourceFrame]]:
    """Yield the frames of the parts, each with the number of its part and about its position in the input."""
    source, selection = sequence.source, sequence.selection
    parts, (start, _, step) = _parts(sequence), selection.indices(source.count or sys.maxsize)
    if len(parts) == 1 or source.entry(start + step * parts[-1].start):
        for part, numbers in enumerate(parts):
            first = selection.start if len(parts) == 1 else start + step * numbers.start
            # The last one is read to the end of the input, for its reader to say where that breaks off.
            stop = selection.stop if part == len(parts) - 1 else start + step * numbers.stop
            read = source.frames(slice(first, stop, selection.step))
            yield from ((part, start + step * number, item) for number, item in enumerate(read, numbers.start))
        return
    part_of = {number: part for part, numbers in enumerate(parts) for number in numbers}
    for number, item in enumerate(source.frames(selection)):
        if number in part_of:
            yield part_of[number], start + step * number, item


def _parts(sequence: Sequence) -> list[range]:
    """Return which of the selected frames are read: short parts, evenly spread; all where they are few or uncounted.

    Parts between the first and the last begin at a key picture, where there is one after the part before: nothing else
    has to be decoded for them.
    """
    count = sequence.count
    if count is None or count <= _PARTS * _FRAMES_OF_PART:
        return [range(count or 0)]
    start, _, step = sequence.selection.indices(sequence.source.count or sys.maxsize)
    parts, end = list[range](), 0
    for first in np.linspace(0, count - _FRAMES_OF_PART, _PARTS).round().astype(int).tolist():
        entry = -((start - sequence.source.entry(start + step * first)) // step)
        begin = entry if end <= entry and len(parts) + 1 < _PARTS else first
        end = begin + _FRAMES_OF_PART
        parts.append(range(begin, end))
    return parts


def _of_source(warnings: list[str]) -> list[VideoFinding]:
    """Return a finding for each of the reader's warnings, those after the third counted."""
    more = len(warnings) - _NAMED
    messages = warnings[:_NAMED] + ([f"and {more} more warnings of the reader"] if more > 0 else [])
    return [VideoFinding("warning", "source", message) for message in messages]


class _Sampled:
    """Keeps a few frames of a video of unknown length, evenly spread."""

    def __init__(self) -> None:
        self._step, self._seen = 1, 0
        self.kept: list[InspectedFrame] = []

    def add(self, item: InspectedFrame) -> None:
        if self._seen % self._step == 0:
            self.kept.append(item)
        if len(self.kept) > _KEPT:
            self.kept, self._step = self.kept[::2], 2 * self._step
        self._seen += 1
