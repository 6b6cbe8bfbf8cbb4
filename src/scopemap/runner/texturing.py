"""Gives the surfaces of a run a texture: pieces of its frames, which are read again at the input's own resolution."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import trimesh

from scopemap.engine.cameras.camera import PinholeCamera
from scopemap.engine.errors import ScopemapError
from scopemap.engine.frame import Frame
from scopemap.engine.fusion.texture import MOST_UNSEEN, textured_mesh
from scopemap.engine.fusion.texture_views import choose_views, spread
from scopemap.engine.pipeline import Pipeline
from scopemap.input.sequence import Sequence as InputSequence
from scopemap.input.source import Source, SourceFrame
from scopemap.result.frame_table import FrameTable
from scopemap.result.result import Result

Progress = Callable[[str, int, int], None]
# Frames of a surface, spread over its time, of which its views are chosen: each is rendered once.
# 12 and 20 gave the same SSIM to .001 on all four clips of `scopemap_bench.scripts.texture`.
_CANDIDATES = 12
_ALIGNED_TO = 5  # by hand, for time: of these, the frames to whose common place views are aligned
_ONCE_ONLY = ("live", "pictures")
"""Names of sources whose pictures cannot be read a second time."""


def put_textures(result: Result, sequence: InputSequence, pipeline: Pipeline, progress: Progress) -> None:
    """Give the surface of a run's result, and those of its other submaps, a texture, where stored frames show it.

    Without stored frames, and where the settings ask for none, the surfaces keep the colours of their vertices.
    progress : called before.
    """
    if pipeline.config.fusion.colours != "texture" or not pipeline.fusion.at_end:
        return
    progress("texturing", 0, 0)
    started = time.perf_counter()
    for one in result.submaps:
        one.textured = textured(one.mesh, frames_of_surface(one), pipeline.fusion.store.frame, sequence)
    elapsed_s = round(time.perf_counter() - started, 3)
    seconds = result.provenance["seconds"]
    seconds |= {"texture": elapsed_s, "total": round(seconds["total"] + elapsed_s, 3)}


def frames_of_surface(result: Result) -> FrameTable:
    """Return the frames whose surface `result.mesh` is: those that are tracked in its segment."""
    frames = result.tracked
    return frames.only(frames["segment"] == result.main_segment) if len(result.segments) > 1 else frames


def textured(
    mesh: trimesh.Trimesh, frames: FrameTable, frame_of: Callable[[int], Frame], sequence: InputSequence
) -> trimesh.Trimesh | None:
    """Return the mesh, world mm, with a texture of some of these frames; None where none of them shows it.

    frames : with poses, of this surface alone. frame_of : returns the frame with a number and its mask.
    """
    if not len(mesh.faces) or not len(frames):
        return None
    pose_of = dict(zip(frames["index"].tolist(), frames["T_world_camera"], strict=True))
    quality = np.nan_to_num(frames["quality"], nan=0.0).tolist()

    def posed(index: int) -> Frame:
        return replace(frame_of(index), T_world_camera=pose_of[index])

    candidates = spread(list(pose_of), quality, _CANDIDATES)
    numbers, label = choose_views(mesh, map(posed, candidates))
    if not numbers or np.sum(label < 0) > MOST_UNSEEN:
        return None
    views = [posed(index) for index in numbers]
    read = _Pictures(sequence, views)
    others = [posed(index) for index in spread(candidates, [1.0] * len(candidates), _ALIGNED_TO)]
    return textured_mesh(mesh, label, views, others, read, read.longest_px)


class _Pictures:
    """Reads pictures of some frames again; where the source cannot, they are those of the frames, enlarged."""

    def __init__(self, sequence: InputSequence, frames: Sequence[Frame]) -> None:
        self._sequence, self._frames = sequence, {frame.index: frame for frame in frames}
        self._can_be_read = sequence.source.name not in _ONCE_ONLY
        source, working = sequence.rectifier.source, sequence.camera
        size = (source.width, source.height) if self._can_be_read else (working.width, working.height)
        self.longest_px = max(*size)
        """Longer side of the pictures at the source's resolution."""

    def __call__(self, numbers: Sequence[int], camera: PinholeCamera) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each number with its picture as the camera sees it."""
        missing = set(numbers)
        if self._can_be_read:
            rectifier = self._sequence.rectifier.enlarged(camera.width, camera.height)
            try:
                for frame in read_again(self._sequence.source, self._sequence.selection, sorted(missing)):
                    if frame.index in missing:
                        missing.discard(frame.index)
                        yield frame.index, rectifier.image(frame.rgb)
                    if not missing:
                        return
            except (ScopemapError, OSError):
                pass  # what is gone by now is replaced by what was tracked
        for index in sorted(missing):
            yield (
                index,
                cv2.resize(self._frames[index].rgb, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC),
            )


def read_again(source: Source, selection: slice, numbers: Sequence[int]) -> Iterator[SourceFrame]:
    """Yield pictures of a source as it is: those with some ascending numbers, if there, and others between.

    A video is entered anew where that is nearer than to read on.
    """
    if source.numbers is None:
        if source.name == "video" and (selection.start or 0) >= 0:
            for first, last in _passes(source, numbers):
                yield from source.frames(slice(first, last + 1))
        else:
            yield from source.frames(slice(selection.start, selection.stop))
        return
    place = {number: place for place, number in enumerate(source.numbers)}
    for number in numbers:
        if number in place:
            yield from source.frames(slice(place[number], place[number] + 1))


def _passes(source: Source, numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Return first and last number of each pass over a video: another one begins where a key picture comes before."""
    passes = [(numbers[0], numbers[0])]
    for number in numbers[1:]:
        first, last = passes[-1]
        if source.entry(number) > last:
            passes.append((number, number))
        else:
            passes[-1] = first, number
    return passes
